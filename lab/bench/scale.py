"""What more peers and more topics cost one stream: 2 to 16 peers, 10 to 1,000 topics in the graph.

One 64 B stream runs between two agents. The other peers are only linked (``peers``), or each has a subscriber of the
stream (``subscribers``: one copy for each); or the first module's graph fills with topics that have no subscriber
(``topics``). Processor time a message is what an agent used while the stream ran, less what it used before with the
same configuration and a quiet stream. A direct roscpp connection beside each figure says what the machine did.
"""

from __future__ import annotations

import statistics
import sys
import time
from array import array
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Final

from lab import samples
from lab.bed import ros
from lab.bed.bench import Bed
from lab.bed.processes import eventually
from lab.bed.ros import NODES
from lab.bench import schedule
from lab.experiments import flow
from lab.figures import shapes
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, ratio, table_of, us
from lab.usage import Meter, Usage, add

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from lab.bed.agents import Agent
    from lab.bed.processes import Process

_SIZE: Final = 64
_LIMIT: Final = 1.1
_TOPIC: Final = "/stream"
_MESH_DEADLINE: Final = 60.0
_SETTLE: Final = 3.0
"""Seconds after the last change: first exchanges and the burst of beacons are over."""
_WARM_UP: Final = 1.0
"""Seconds of the stream and of its control before each step: the first ones after a pause cost more."""
_FAN_RATE: Final = 100.0
"""Hz where every peer subscribes: all receivers share this machine's cores, which is not what is measured."""
_RATE: Final = 1000.0


@dataclass(frozen=True, slots=True)
class ScalePlan:
    """How much is measured.

    Args:
        seconds: Of each slice of the stream, and of its control.
        slices: How many of each a step has, in turns.
        idle: Seconds without them: whole periods of what an agent does now and then, as the heartbeat's 5 s.
        rounds: How often each ladder is climbed, from fresh agents.
        peers: The steps of the ladders of peers.
        topics: Those of the ladder of topics.
    """

    seconds: float
    slices: int
    idle: float
    rounds: int
    peers: tuple[int, ...] = (2, 4, 8, 16)
    topics: tuple[int, ...] = (10, 100, 1000)


FULL: Final = ScalePlan(1.5, 4, 10.0, 3)
QUICK: Final = ScalePlan(1.2, 2, 5.0, 1)


@dataclass(slots=True)
class ScaleStep:
    """One step of one ladder, over all rounds.

    Args:
        latency: From due to there at the first receiver, µs.
        last: The same at the receiver that was added last.
        control: The same of roscpp direct.
        lost: Messages of the stream that never came.
        cpu: µs of processor time a message by agent, less the idle cost (``others``: the mean of the other agents;
            ``direct``: both nodes of the control, nothing taken off); one a round.
        idle: Percent of a core without the stream, likewise.
    """

    latency: array[float] = field(default_factory=lambda: array("d"))
    last: array[float] = field(default_factory=lambda: array("d"))
    control: array[float] = field(default_factory=lambda: array("d"))
    lost: int = 0
    cpu: dict[str, list[float]] = field(default_factory=dict)
    idle: dict[str, list[float]] = field(default_factory=dict)

    def p50(self, which: str = "latency") -> float | None:
        """The median of one of the three."""
        made: array[float] = getattr(self, which)
        return samples.summary(made).p50

    def note(self, name: str, cpu: float, idle: float = 0.0) -> None:
        """Take one round's figures of one process."""
        self.cpu.setdefault(name, []).append(cpu)
        self.idle.setdefault(name, []).append(idle)

    def cpu_of(self, name: str) -> float | None:
        """The median over rounds."""
        return statistics.median(self.cpu[name]) if self.cpu.get(name) else None

    @property
    def both(self) -> float | None:
        """Of the two agents that the stream runs through, together."""
        one, two = self.cpu_of("agent 1"), self.cpu_of("agent 2")
        return None if one is None or two is None else one + two


def per_message(busy: Usage, idle: Usage, messages: int) -> float:
    """µs of processor time that each message costs beyond what the process uses anyway."""
    resting = idle.cpu / idle.wall if idle.wall else 0.0
    return 1e6 * (busy.cpu - resting * busy.wall) / messages


class Fan(schedule.MeasuredStream):
    """A stream of which one more receiver, far from the first, may be asked as well.

    Args:
        bed: As of ``Stream``; so are the others.
        source: Publishes.
        target: The first receiver.
        topic: That both listen to.
        between: The two agents.
    """

    def __init__(
        self, bed: Bed, source: Process, target: Process, topic: str, between: Mapping[str, Process]
    ) -> None:
        super().__init__(bed, source, target, topic, between)
        self.far: Process | None = None
        self.far_latencies: list[float] = []

    def end(self, *, settle: float = schedule.SETTLE) -> schedule.Arrivals:
        """Also read what came to the other receiver."""
        arrivals = super().end(settle=settle)
        self.far_latencies = []
        if self.far is not None and self._begun is not None:
            came = flow.noted(self.far, self._topics, self._home, self._begun.number, settle=0)
            self.far_latencies = schedule.parse(came, [], self._lead).latencies()
        return arrivals


class MeasuredMesh:
    """Agents that are all linked, one stream between the first two, and its control.

    Args:
        bed: Ends them.
        peers: How many to begin with.
        rate: Of the stream, Hz.
    """

    def __init__(self, bed: Bed, peers: int, rate: float) -> None:
        self._bed = bed
        self._rate = rate
        self.agents: list[Agent] = []
        self.grow(peers)
        self._control = schedule.direct(bed, network=1).stream(bed, _TOPIC)
        first, second = self.agents[:2]
        target = self.receiver(second)
        shell = bed.shell(first.host, first.core_port)
        source = shell.start(ros.compiled("source"), "--topic", _TOPIC, name="source", commands=True)
        self.stream = Fan(bed, source, target, _TOPIC, {"agent 1": first.process, "agent 2": second.process})
        self.stream.wait_flowing()

    def grow(self, peers: int) -> list[Agent]:
        """Add agents until there are so many, all of them linked; return the new ones."""
        names = [f"m{number}" for number in range(len(self.agents), peers)]
        fresh = [self._bed.agent(host, name=host.name, start=False) for host in self._bed.lab.hosts(*names)]
        for agent in fresh:
            agent.start()
        for agent in fresh:
            agent.wait_ready(_MESH_DEADLINE)
        self.agents += fresh
        for agent in self.agents:
            for name in names:
                if name != agent.name:
                    agent.wait_peer(name, _MESH_DEADLINE)
        return fresh

    def receiver(self, agent: Agent) -> Process:
        """A subscriber of the stream in one module."""
        shell = self._bed.shell(agent.host, agent.core_port)
        words = ["--topics", _TOPIC, "--nodelay"]
        made = shell.start(ros.compiled("sink"), *words, name=f"sink@{agent.name}", commands=True)
        made.wait_event("up")
        return made

    def step(self, plan: ScalePlan, into: ScaleStep) -> None:
        """Measure as it is now: without the stream, with it, and its control."""
        time.sleep(_SETTLE)
        for stream in (self.stream, self._control):
            stream.run(_SIZE, self._rate, _WARM_UP)
        others = {agent.name: agent.pid for agent in self.agents[2:]}
        pids = {"agent 1": self.agents[0].pid, "agent 2": self.agents[1].pid, **others}
        meter = Meter(pids)
        time.sleep(plan.idle)
        idle = meter.read()
        busy: dict[str, Usage] = {}
        direct: dict[str, Usage] = {}
        messages = controls = 0
        for _ in range(plan.slices):
            meter = Meter(others)
            arrivals = self.stream.run(_SIZE, self._rate, plan.seconds)
            busy = add(busy, {**meter.read(), **arrivals.usage})
            control = self._control.run(_SIZE, self._rate, plan.seconds)
            direct = add(direct, control.usage)
            into.latency.extend(arrivals.latencies())
            into.last.extend(self.stream.far_latencies)
            into.control.extend(control.latencies())
            into.lost += arrivals.lost
            messages += arrivals.total
            controls += control.total
        costs = {name: per_message(busy[name], idle[name], messages) for name in pids}
        into.note("direct", 1e6 * sum(usage.cpu for usage in direct.values()) / controls)
        for name in ("agent 1", "agent 2"):
            into.note(name, costs[name], idle[name].percent)
        if others:
            rest = statistics.fmean(idle[name].percent for name in others)
            into.note("others", statistics.fmean(costs[name] for name in others), rest)


def climb_peers(plan: ScalePlan, bed: Bed) -> Iterator[tuple[int, MeasuredMesh]]:
    """The other peers are only linked."""
    mesh = MeasuredMesh(bed, plan.peers[0], _RATE)
    for peers in plan.peers:
        mesh.grow(peers)
        yield peers, mesh


def climb_subscribers(plan: ScalePlan, bed: Bed) -> Iterator[tuple[int, MeasuredMesh]]:
    """Each of the other peers subscribes too."""
    mesh = MeasuredMesh(bed, plan.peers[0], _FAN_RATE)
    for peers in plan.peers:
        for agent in mesh.grow(peers):
            mesh.stream.far = mesh.receiver(agent)
        yield peers, mesh


def climb_topics(plan: ScalePlan, bed: Bed) -> Iterator[tuple[int, MeasuredMesh]]:
    """The first module's graph grows, and with it what the second one shows."""
    mesh = MeasuredMesh(bed, 2, _RATE)
    first, second = (bed.shell(agent.host, agent.core_port) for agent in mesh.agents)
    crowd = first.start(sys.executable, NODES / "crowd.py", name="crowd", commands=True)
    for topics in plan.topics:
        mark = crowd.mark_events()
        crowd.tell(str(topics))
        crowd.wait_event("registered", _MESH_DEADLINE, since=mark)

        def shown(wanted: int = topics) -> bool:
            return second.tool("rostopic", "list").count("/crowd/topic") >= wanted

        eventually(shown, _MESH_DEADLINE, what=f"{topics} topics in the far graph", every=0.5)
        yield topics, mesh


LADDERS: Final[dict[str, Callable[[ScalePlan, Bed], Iterator[tuple[int, MeasuredMesh]]]]] = {
    "peers": climb_peers,
    "subscribers": climb_subscribers,
    "topics": climb_topics,
}
_TITLES: Final = {
    "peers": f"peers that are only linked; {_SIZE} B at {_RATE:.0f} Hz",
    "subscribers": f"peers that all subscribe; {_SIZE} B at {_FAN_RATE:.0f} Hz",
    "topics": f"topics in the graph; {_SIZE} B at {_RATE:.0f} Hz",
}
Steps = dict[str, dict[int, ScaleStep]]


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the tables, write the files; return the result."""
    plan = QUICK if quick else FULL
    host = schedule.HostLateness()
    steps: Steps = {ladder: {} for ladder in LADDERS}
    for turn in range(plan.rounds):
        for ladder, climb in LADDERS.items():
            console.print(f"round {turn + 1} of {plan.rounds}: {ladder}", style="dim")
            with Bed() as bed:
                for count, mesh in climb(plan, bed):
                    mesh.step(plan, steps[ladder].setdefault(count, ScaleStep()))
    for ladder, found in steps.items():
        console.print(_table(ladder, found))
    result: dict[str, object] = {
        "ladders": {
            ladder: [_row(ladder, n, one, found) for n, one in found.items()] for ladder, found in steps.items()
        },
        **host.finish(console),
    }
    settings = {**asdict(plan), "bytes": _SIZE, "hz": _RATE, "hz_subscribers": _FAN_RATE}
    return finish(
        console,
        "scale",
        settings,
        result,
        json,
        claims=list(_targets(steps)),
        panels=shapes.lines(_panels(steps), "times the figure of the first step"),
    )


def copies(ladder: str, count: int) -> int:
    """How many copies of each message leave the first agent."""
    return count - 1 if ladder == "subscribers" else 1


def _of_copy(ladder: str, count: int, step: ScaleStep) -> float | None:
    cpu = step.cpu_of("agent 1")
    return None if cpu is None else cpu / copies(ladder, count)


def _targets(steps: Steps) -> Iterator[Claim]:
    for ladder, found in steps.items():
        base, top = min(found), max(found)
        words = f"{ladder}, {base} → {top}"
        if ladder != "subscribers":
            yield Claim(f"{words}: latency p50", ratio(found[top].p50(), found[base].p50()), _LIMIT)
            yield Claim(f"{words}: CPU a message, both agents", ratio(found[top].both, found[base].both), _LIMIT)
        else:
            per_copy = [_of_copy(ladder, count, found[count]) for count in (top, base)]
            yield Claim(f"{words}: CPU a copy, sending agent", ratio(*per_copy), _LIMIT)


def _row(ladder: str, count: int, step: ScaleStep, found: dict[int, ScaleStep]) -> dict[str, object]:
    base = found[min(found)]
    return {
        ladder: count,
        "latency_us": asdict(samples.summary(step.latency, step.lost)),
        "latency_last_us": asdict(samples.summary(step.last)) if step.last else None,
        "direct_us": asdict(samples.summary(step.control)),
        "cpu_us_per_message": step.cpu,
        "cpu_us_per_copy": _of_copy(ladder, count, step),
        "idle_percent": step.idle,
        "p50_to_first_step": ratio(step.p50(), base.p50()),
        "direct_p50_to_first_step": ratio(step.p50("control"), base.p50("control")),
        "cpu_to_first_step": ratio(step.both, base.both),
        "direct_cpu_to_first_step": ratio(step.cpu_of("direct"), base.cpu_of("direct")),
    }


def _table(ladder: str, found: dict[int, ScaleStep]) -> Table:
    heads = ["p50, µs", "to first", "p99", "lost", "p50 at the last", "direct p50", "to first"]
    heads += [
        "CPU agent 1, µs",
        "a copy",
        "agent 2",
        "others",
        "1+2 to first",
        "CPU direct to first",
        "idle agent 1, %",
    ]
    table = table_of(_TITLES[ladder], (), heads)
    base = found[min(found)]
    for count, step in found.items():
        first = ratio(step.p50(), base.p50())
        control = step.p50("control")
        last = samples.summary(step.last).p50
        cells = [us(step.p50()), dash(first), us(samples.summary(step.latency).p99), str(step.lost), us(last)]
        cells += [us(control), dash(ratio(control, base.p50("control")))]
        cpu = [step.cpu_of("agent 1"), _of_copy(ladder, count, step), step.cpu_of("agent 2"), step.cpu_of("others")]
        cells += [us(value) for value in cpu]
        cells += [dash(ratio(step.both, base.both)), dash(ratio(step.cpu_of("direct"), base.cpu_of("direct")))]
        cells += [dash(statistics.median(step.idle["agent 1"]))]
        table.add_row(str(count), *cells)
    return table


def _panels(steps: Steps) -> dict[str, dict[str, list[tuple[float, float]]]]:
    panels: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for ladder, found in steps.items():
        base = found[min(found)]
        lines = {
            "latency p50": [(count, ratio(step.p50(), base.p50())) for count, step in found.items()],
            "direct roscpp p50": [(n, ratio(step.p50("control"), base.p50("control"))) for n, step in found.items()],
            "CPU a message, receiver": [
                (count, ratio(step.cpu_of("agent 2"), base.cpu_of("agent 2"))) for count, step in found.items()
            ],
            "CPU a copy, sender": [
                (count, ratio(_of_copy(ladder, count, step), _of_copy(ladder, min(found), base)))
                for count, step in found.items()
            ],
        }
        panels[ladder] = {
            title: [(count, value) for count, value in line if value is not None] for title, line in lines.items()
        }
    return panels
