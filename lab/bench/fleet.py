"""A fleet on this machine: 2 to 64 modules, each an agent and some topics in a network namespace of its own.

For each number of modules: from the start of all agents until each has a link to all others, and until each knows
the topics of all; then, at rest, processor time, wake-ups, memory and traffic of each agent; a stream between two of
them; and the time until all others know that a module was killed, and that one was cut off. The same stream runs in
classic ROS with as many modules and one rosmaster. All modules share this machine's cores.
"""

from __future__ import annotations

import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

import psutil

from lab.bed.bench import Bed
from lab.bed.neighbours import room_for
from lab.bed.processes import CommandFailed, Deadline
from lab.bed.ros import NODES
from lab.bench import schedule
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, ratio, table_of, us
from lab.usage import Meter, wakeups
from rmpa.core.errors import RmpaError
from rmpa.observe.control_client import ControlClient

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from lab import samples
    from lab.bed.agents import Agent
    from lab.bed.ros import Ros
    from rmpa.observe.peer_info import PeerInfo
    from rmpa.observe.snapshot import Snapshot

_DEADLINE: Final = 300.0
_LOOK: Final = 0.2
"""Seconds between looks at an agent that does not know all yet."""
_WATCHERS: Final = 8
"""Agents that are asked whether they know of a loss: to ask all of them is work on the same cores."""
_TOPIC: Final = "/stream"
_SIZE: Final = 64
_RATE: Final = 100.0
_CPU_LIMIT: Final = 15.0
_CPU_AT: Final = 32
_RATIO_LIMIT: Final = 1.2
_TRAFFIC_LIMIT: Final = 5000.0


@dataclass(frozen=True, slots=True)
class FleetPlan:
    """How much is measured.

    Args:
        modules: The numbers of modules; one that does not fit into this machine's memory is left out.
        topics: Of each module.
        settle: Seconds until links are at rest.
        idle: Seconds at rest.
        stream: Seconds of the stream, in each of the rounds.
        rounds: Of the stream.
    """

    modules: tuple[int, ...] = (2, 8, 32, 64)
    topics: int = 5
    settle: float = 25.0
    idle: float = 20.0
    stream: float = 5.0
    rounds: int = 3


FULL: Final = FleetPlan()
QUICK: Final = FleetPlan(modules=(2, 8), idle=10.0, stream=3.0, rounds=1)
_MODULE_BYTES: Final = 80e6
"""Memory of a module: its agent, and the node that holds its topics."""


@dataclass(frozen=True, slots=True)
class FleetRow:
    """One number of modules; each list has a figure of each agent.

    Args:
        linked: Seconds from the start of the first agent until all have links to all others.
        known: Seconds from the registration of the last topic until all agents know all topics.
        cpu: Percent of a core, at rest.
        wakeups: A second, at rest, of all threads.
        rss: Megabytes, at rest.
        packets: A second, in and out, at rest.
        traffic: Bytes a second, in and out, at rest.
        p50: Of the stream, µs.
        p99: Likewise.
        lost: Of the stream.
        classic_p50: Of the stream in classic ROS, µs.
        classic_p99: Likewise.
        killed: Seconds until all that were asked knew that a module was killed.
        cut_user: Seconds until the module that it sends the stream to was known to be cut off.
        cut: Seconds until all that were asked knew it, which have no use for it.
        load: The machine's load average over the last minute, before this row and after it.
    """

    linked: float
    known: float
    cpu: list[float]
    wakeups: list[float]
    rss: list[float]
    packets: list[float]
    traffic: list[float]
    p50: float | None
    p99: float | None
    lost: int
    classic_p50: float | None
    classic_p99: float | None
    killed: float
    cut_user: float
    cut: float
    load: tuple[float, float]


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the file; return the result."""
    plan = QUICK if quick else FULL
    rows: dict[int, FleetRow] = {}
    failed: dict[int, str] = {}
    for count in plan.modules:
        if psutil.virtual_memory().available < count * _MODULE_BYTES:
            console.print(f"{count} modules do not fit into this machine's memory", style="yellow")
            continue
        console.print(f"{count} modules", style="dim")
        try:
            with room_for(count):
                rows[count] = _row(plan, count)
        except (CommandFailed, Deadline) as error:
            failed[count] = str(error)
            console.print(f"{count} modules: {error}", style="red")
    if not rows:
        raise CommandFailed("; ".join(failed.values()) or "no fleet fits into this machine's memory")
    console.print(_table(rows, plan))
    result: dict[str, object] = {
        "modules": {str(count): asdict(row) for count, row in rows.items()},
        "failed": {str(count): text for count, text in failed.items()},
    }
    result = finish(console, "fleet", asdict(plan), result, json, claims=list(_claims(rows)))
    if failed:
        raise CommandFailed("; ".join(failed.values()))
    return result


# --- one number of modules ------------------------------------------------------------------------------------


def _row(plan: FleetPlan, count: int) -> FleetRow:
    load = psutil.getloadavg()[0]
    classic = _classic(plan, count)
    with Bed() as bed:
        agents, linked = _start(bed, count)
        shells = [bed.shell(agent.host, agent.core_port) for agent in agents]
        registered = populate(shells, plan.topics)
        known = _when_all(agents, lambda found: knows(found, count - 1, plan.topics)) - registered
        time.sleep(plan.settle)
        cpu, wakes, rss, packets, traffic = at_rest(agents, plan.idle)
        way = schedule.Way("fleet", "two of the fleet", shells[0], shells[1], agents[:2], transport="relay")
        found = _stream(bed, way, plan)
        killed, cut_user, cut = _losses(agents)
        load_after = psutil.getloadavg()[0]
    return FleetRow(
        round(linked, 2),
        round(known, 2),
        cpu,
        wakes,
        rss,
        packets,
        traffic,
        found.p50,
        found.p99,
        found.lost,
        classic.p50,
        classic.p99,
        round(killed, 2),
        round(cut_user, 2),
        round(cut, 2),
        (round(load, 2), round(load_after, 2)),
    )


def _start(bed: Bed, count: int) -> tuple[list[Agent], float]:
    """Start all agents at once; return them, and the seconds until all are linked with all others."""
    hosts = bed.lab.hosts(*(f"m{number}" for number in range(count)))
    agents = [bed.agent(host, name=host.name, start=False) for host in hosts]
    for agent in agents:
        agent.start()
    with ThreadPoolExecutor(count) as waiting:
        list(waiting.map(lambda agent: agent.wait_ready(_DEADLINE), agents))
    whole = _when_all(agents, lambda found: len(_present(found)) >= count - 1)
    return agents, whole - min(agent.process.started for agent in agents)


def populate(shells: Sequence[Ros], topics: int) -> float:
    """Have each module publish some topics; return the monotonic time at which the last one was registered."""
    crowds = [shell.start(sys.executable, NODES / "crowd.py", name="crowd", commands=True) for shell in shells]
    for crowd in crowds:
        crowd.wait_event("up", _DEADLINE)
    for crowd in crowds:
        crowd.tell(str(topics))
    return max(int(str(crowd.wait_event("registered", _DEADLINE)["at_ns"])) for crowd in crowds) / 1e9


def at_rest(
    agents: Sequence[Agent], seconds: float
) -> tuple[list[float], list[float], list[float], list[float], list[float]]:
    """Percent of a core, wake-ups a second, megabytes, packets and bytes a second, of each agent."""
    traffic = [agent.host.traffic() for agent in agents]
    meter, woken = Meter({agent.name: agent.pid for agent in agents}), [wakeups(agent.pid) for agent in agents]
    begun = time.monotonic()
    time.sleep(seconds)
    usage, woken_then = meter.read(), [wakeups(agent.pid) for agent in agents]
    span = time.monotonic() - begun
    moved = [agent.host.traffic() for agent in agents]

    def rate(unit: str) -> list[float]:
        keys = (f"rx_{unit}", f"tx_{unit}")
        pairs = zip(traffic, moved, strict=True)
        return [round(sum(after[key] - before[key] for key in keys) / span, 1) for before, after in pairs]

    return (
        [round(one.percent, 3) for one in usage.values()],
        [round((after - before) / span, 2) for before, after in zip(woken, woken_then, strict=True)],
        [round(one.rss / 1e6, 1) for one in usage.values()],
        rate("packets"),
        rate("bytes"),
    )


def _stream(bed: Bed, way: schedule.Way, plan: FleetPlan) -> samples.Summary:
    stream = way.stream(bed, _TOPIC)
    score = schedule.LatencyScore()
    for _ in range(plan.rounds):
        score.add(stream.run(_SIZE, _RATE, plan.stream))
    return score.summary


def _classic(plan: FleetPlan, count: int) -> samples.Summary:
    """The stream in classic ROS: one rosmaster, and as many hosts with as many topics."""
    with Bed() as bed:
        hosts = bed.lab.hosts(*(f"c{number}" for number in range(count)))
        shells = [bed.shell(host) for host in hosts]
        for shell in shells:
            shell.env["ROS_MASTER_URI"] = f"http://{hosts[0].address}:{shells[0].port}"
        shells[0].master()
        populate(shells, plan.topics)
        return _stream(bed, schedule.Way("classic", "classic ROS", shells[0], shells[1]), plan)


# --- losses ---------------------------------------------------------------------------------------------------


def _losses(agents: Sequence[Agent]) -> tuple[float, float, float]:
    """Seconds until others know that the last module was killed, and that the second one was cut off.

    The latter first at the first module, which sends it the stream.
    """
    last, second = agents[-1], agents[1]
    others = [agent for agent in agents if agent is not last]
    begun = time.monotonic()
    last.kill()
    killed = _when_all(others[:_WATCHERS], lambda found: last.name not in _present(found)) - begun
    if second is last:
        last.restart()
        _when_all(agents[:1], lambda found: second.name in _present(found))
    begun = time.monotonic()
    second.host.cut()
    watchers = [agent for agent in others if agent is not second][:_WATCHERS]
    user = _when_all(watchers[:1], lambda found: second.name not in _present(found)) - begun
    return killed, user, _when_all(watchers, lambda found: second.name not in _present(found)) - begun


# --- what agents know -----------------------------------------------------------------------------------------


def _when_all(agents: Sequence[Agent], knows: Callable[[Snapshot], bool]) -> float:
    """Wait until this is so of every agent; the monotonic time at which the last one was found to know it."""
    deadline = time.monotonic() + _DEADLINE
    latest = time.monotonic()
    for agent in agents:
        while (found := snapshot_of(agent)) is None or not knows(found):
            if time.monotonic() > deadline:
                raise Deadline(f"{agent.name} does not know all of the fleet after {_DEADLINE:g} s")
            time.sleep(_LOOK)
        latest = time.monotonic()
    return latest


def _present(found: Snapshot) -> dict[str, PeerInfo]:
    return {peer.name: peer for peer in found.peers if peer.state == "linked"}


def knows(found: Snapshot, peers: int, topics: int) -> bool:
    return sum(peer.topics_in >= topics for peer in _present(found).values()) >= peers


def snapshot_of(agent: Agent) -> Snapshot | None:
    try:
        with ControlClient(agent.sockets()[0]) as client:
            return client.snapshot()
    except (RmpaError, IndexError):
        return None


# --- tables ---------------------------------------------------------------------------------------------------


def _claims(rows: dict[int, FleetRow]) -> Iterator[Claim]:
    if (row := rows.get(_CPU_AT)) is not None:
        yield Claim(f"{_CPU_AT} idle agents in all, % of a core", sum(row.cpu), _CPU_LIMIT)
        yield Claim(
            f"stream's p50, 2 → {_CPU_AT} modules, to that of classic", _to_classic(rows, _CPU_AT), _RATIO_LIMIT
        )
    most = max(rows)
    yield Claim(f"{most} modules: bytes a second of an agent at rest, worst", max(rows[most].traffic), _TRAFFIC_LIMIT)


def _to_classic(rows: dict[int, FleetRow], count: int) -> float | None:
    """By how much more the stream's p50 grew than classic's own."""
    row, base = rows[count], rows[min(rows)]
    return ratio(ratio(row.p50, base.p50), ratio(row.classic_p50, base.classic_p50))


def _table(rows: dict[int, FleetRow], plan: FleetPlan) -> Table:
    heads = ["modules", "linked, s", "topics known, s", "CPU of all, %", "of one", "wake-ups/s", "RSS, MB"]
    heads += ["packets/s", "bytes/s", "p50, µs", "p99", "classic p50", "p99", "growth to classic's"]
    heads += ["killed, s", "cut in use, s", "cut, s", "load"]
    title = (
        f"a fleet of modules with {plan.topics} topics each, {plan.idle:.0f} s at rest; {_SIZE} B at {_RATE:.0f} Hz"
    )
    table = table_of(title, (), heads)
    for count, row in rows.items():
        cells = [f"{row.linked:.1f}", f"{row.known:.1f}", f"{sum(row.cpu):.1f}", f"{statistics.fmean(row.cpu):.2f}"]
        cells += [f"{statistics.fmean(row.wakeups):.1f}", f"{max(row.rss):.1f}"]
        cells += [f"{statistics.fmean(row.packets):.1f}", f"{statistics.fmean(row.traffic):.0f}"]
        cells += [us(row.p50), us(row.p99), us(row.classic_p50), us(row.classic_p99)]
        cells += [
            dash(_to_classic(rows, count)),
            f"{row.killed:.1f}",
            f"{row.cut_user:.1f}",
            f"{row.cut:.1f}",
            f"{row.load[1]:.1f}",
        ]
        table.add_row(str(count), *cells)
    return table
