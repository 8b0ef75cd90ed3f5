"""Streams on a fixed schedule: a roscpp node that publishes, and one that notes when each message came.

Latency runs from the moment at which a message was *due*, so that a path that holds the publisher back is charged for
it (no coordinated omission). All hosts are network namespaces of one machine and share its clock.
"""

from __future__ import annotations

import math
import os
import statistics
import time
from array import array
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Final

import psutil

from lab import machine, samples
from lab.bed.processes import BedError, Deadline, Process
from lab.bed.ros import Ros, compiled
from lab.bed.transport import require
from lab.experiments import flow
from lab.tables import usage_row
from lab.usage import Meter, Usage, add

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from pandas import DataFrame
    from rich.console import Console

    from lab.bed.agents import Agent
    from lab.bed.bench import Bed
    from lab.bed.plan import Transport

# Seconds of each round whose messages are thrown away: caches and the processor's clock come up.
LEAD_IN: Final = 0.2
# Seconds from the command to the first message.
_START: Final = 0.02
# Seconds without an arrival after which a round is over.
SETTLE: Final = 0.3
_FLOWING_DEADLINE: Final = 30.0
# Seconds of sleeps, before and after, that tell how late the machine itself wakes.
_HOST_LATENESS: Final = 2.0
# Of measuring nodes under SCHED_FIFO: below the agents', as a user's nodes would be.
NODE_PRIORITY: Final = 40


@dataclass(frozen=True, slots=True)
class Rounds:
    """How much is measured.

    Args:
        seconds: Of each round; short, so that a bad spell of the machine meets all that take turns.
        rounds: Turns of each.
    """

    seconds: float
    rounds: int


@dataclass(slots=True)
class Arrivals:
    """The arrivals of one round, without its lead-in.

    Args:
        sent: Messages that were given to roscpp.
        sequence: Of each that came, in the order of arrival.
        due: When each was due to leave, ns.
        came: When each was there, ns of the same clock.
        late: How late the publisher itself was with each that it sent, ns.
        usage: What the processes on the way used, lead-in included.
        total: How many messages that was for.
        lead: The sequence of the first that counts.
    """

    sent: int
    sequence: Sequence[int]
    due: Sequence[int]
    came: Sequence[int]
    late: Sequence[int] = ()
    usage: dict[str, Usage] = field(default_factory=dict)
    total: int = 0
    lead: int = 0

    @property
    def lost(self) -> int:
        """How many never came."""
        return self.sent - len(set(self.sequence))

    @property
    def doubled(self) -> int:
        """How many came more than once."""
        return len(self.sequence) - len(set(self.sequence))

    def latencies(self) -> list[float]:
        """From due to there, µs."""
        return [(came - due) / 1000 for came, due in zip(self.came, self.due, strict=True)]

    def from_send(self) -> list[float]:
        """From when the publisher did send to there, µs: without what kept the publisher from its processor."""
        late = (self.late[sequence - self.lead] for sequence in self.sequence)
        return [value - by / 1000 for value, by in zip(self.latencies(), late, strict=True)]

    def bytes_per_second(self, size: int, begin: int, end: int) -> float:
        """What came of messages of ``size`` bytes between two moments of the clock."""
        inside = [came for came in self.came if begin <= came <= end]
        return size * (len(inside) - 1) / (inside[-1] - inside[0]) * 1e9 if len(inside) > 1 else 0.0


class MeasuredStream:
    """A publisher and a receiver of one topic, and their rounds.

    Args:
        bed: Where scratch files go.
        source: Runs the package's ``source``.
        target: Runs its ``sink``.
        topic: That the target listens to.
        between: The processes between them, by name.
        transport: How its messages are to cross, which each round makes sure of; ``None`` where there are no agents.
    """

    def __init__(
        self,
        bed: Bed,
        source: Process,
        target: Process,
        topic: str,
        between: Mapping[str, Process],
        transport: Transport | None = None,
    ) -> None:
        self.source, self.target = source, target
        self._transport = transport
        self.pids = {
            "publisher": source.pid,
            **{name: process.pid for name, process in between.items()},
            "receiver": target.pid,
        }
        self._topics = [topic]
        self._home = bed.home
        self._begun: flow.Round | None = None
        self._lead = 0
        self._rate = 0.0
        self._meter = Meter({})

    def wait_flowing(self) -> None:
        """Return when messages come through, and connections are as they will be.

        Raises:
            Deadline: None came.
            BedError: They come by another transport.
        """
        deadline = time.monotonic() + _FLOWING_DEADLINE
        flow.wait_connected(self.source, timeout=_FLOWING_DEADLINE)
        self._require_transport()
        while not self.run(64, 100.0, 0.1).sequence:
            if time.monotonic() > deadline:
                raise Deadline(f"nothing of {self.source.name} came to {self.target.name}")

    def run(self, size: int, rate: float, seconds: float, *, settle: float = SETTLE) -> Arrivals:
        """Send for so long; return what came."""
        self.begin(size, rate, seconds)
        return self.end(settle=settle)

    def begin(self, size: int, rate: float, seconds: float) -> None:
        """Start a round; ``end`` returns what came of it."""
        self._lead = max(2, round(rate * LEAD_IN))
        count = self._lead + max(2, round(rate * seconds))
        self._rate = rate
        self._meter = Meter(self.pids)
        self._begun = flow.begin(self.source, self._home, size=size, rate=rate, count=count)

    def wait_lead_in(self, seconds: float) -> None:
        """Let so much of a round that was begun go by."""
        time.sleep(_START + self._lead / self._rate + seconds)

    def end(self, *, settle: float = SETTLE) -> Arrivals:
        """Wait until all is sent, and nothing more arrives for ``settle`` seconds; return what came."""
        if self._begun is None:
            raise BedError("begin() comes first")
        late = _numbers(flow.sent(self._begun), "late_ns")
        usage = self._meter.read()
        self._require_transport()
        came = flow.noted(self.target, self._topics, self._home, self._begun.number, settle=settle)
        arrivals = parse(came, late, self._lead)
        arrivals.usage, arrivals.total = usage, len(late)
        return arrivals

    def _require_transport(self) -> None:
        if self._transport:
            require(self._transport, [(self.source, self.target)])


def parse(came: DataFrame, late: Sequence[int], lead: int) -> Arrivals:
    """Read what a sink noted and how late its source was (``flow``), without the first ``lead`` messages."""
    columns = [_numbers(came, name) for name in ("sequence", "due_ns", "came_ns")]
    counted = [at for at, sequence in enumerate(columns[0]) if sequence >= lead]
    sequence, due, there = (array("Q", [column[at] for at in counted]) for column in columns)
    return Arrivals(max(0, len(late) - lead), sequence, due, there, late[lead:], lead=lead)


def _numbers(table: DataFrame, name: str) -> Sequence[int]:
    return array("Q", table[name].tolist())


@dataclass(slots=True)
class Way:
    """One way from host to host.

    Args:
        key: Its name in JSON.
        title: Its name in tables.
        here: The publisher's shell.
        there: The receiver's.
        agents: The agents between them; none in classic ROS.
        transport: How messages cross where there are agents.
    """

    key: str
    title: str
    here: Ros
    there: Ros
    agents: list[Agent] = field(default_factory=list)
    transport: Transport | None = None

    def stream(self, bed: Bed, topic: str, *, queue: int = 100, fifo: int = 0) -> MeasuredStream:
        """Start both nodes of one topic, under SCHED_FIFO if ``fifo`` is a priority."""
        prefix = ["chrt", "-f", str(fifo)] if fifo else []

        def node(shell: Ros, program: str, *words: str) -> Process:
            argv: list[str | Path] = [*prefix, compiled(program), *words, "--queue", str(queue), "--nodelay"]
            return shell.start(*argv, name=program, commands=True)

        between = {f"agent {number}": agent.process for number, agent in enumerate(self.agents, 1)}
        target = node(self.there, "sink", "--topics", topic)
        source = node(self.here, "source", "--topic", topic)
        made = MeasuredStream(bed, source, target, topic, between, self.transport)
        made.wait_flowing()
        return made


def direct(bed: Bed, network: int = 0) -> Way:
    """Classic ROS at its best: roscpp with tcpNoDelay across the cable, one master."""
    return Way("direct", "roscpp direct", *bed.classic(network))


@dataclass(frozen=True, slots=True)
class AgentPair:
    """Two agents as a way from host to host.

    Args:
        key: Its name in JSON.
        title: Its name in tables.
        transport: Of what no contract in ``config`` gives another one.
        config: Further text of their ``rmpa.toml``.
    """

    key: str
    title: str
    transport: Transport = "relay"
    config: str = ""


RELAYED: Final = AgentPair("agents", "two agents")


def agents(bed: Bed, kind: AgentPair = RELAYED, *, network: int = 0, flags: Sequence[str] = ()) -> Way:
    """Two agents on two hosts of a network of their own, linked."""
    hosts = bed.lab.hosts(f"{kind.key}_a", f"{kind.key}_b", network=network)
    pair = [bed.agent(host, name=host.name, flags=flags, way=kind.transport, config=kind.config) for host in hosts]
    pair[0].wait_peer(pair[1].name)
    here, there = (bed.shell(agent.host, agent.core_port) for agent in pair)
    return Way(kind.key, kind.title, here, there, pair, transport=kind.transport)


def realtime_agents(
    bed: Bed, kind: AgentPair = AgentPair("agents_realtime", "agents, --realtime"), *, network: int = 0
) -> tuple[Way, str]:
    """Two agents with ``--realtime``, and what they got."""
    way = agents(bed, kind, network=network, flags=["--realtime"])
    return way, f"rmpa up --realtime; {', '.join(sorted({_policy(agent.pid) for agent in way.agents}))}"


def _policy(pid: int) -> str:
    names = {os.SCHED_OTHER: "SCHED_OTHER", os.SCHED_FIFO: "SCHED_FIFO", os.SCHED_RR: "SCHED_RR"}
    policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
    return f"{names.get(policy, str(policy))} {os.sched_getparam(pid).sched_priority}"


class LatencyScore:
    """One way under one condition, over all rounds."""

    def __init__(self) -> None:
        self.latencies = array("d")
        self.source_late = array("d")
        self.from_send = array("d")
        self.lost = self.doubled = 0
        self.usage: dict[str, Usage] = {}
        self.messages = 0
        self.rounds: list[list[float]] = []

    def add(self, arrivals: Arrivals) -> None:
        """Take one round."""
        self.rounds.append(arrivals.latencies())
        self.latencies.extend(self.rounds[-1])
        self.source_late.extend(late / 1000 for late in arrivals.late)
        self.from_send.extend(arrivals.from_send())
        self.lost += arrivals.lost
        self.doubled += arrivals.doubled
        self.usage = add(self.usage, arrivals.usage)
        self.messages += arrivals.total

    @property
    def summary(self) -> samples.Summary:
        """All rounds together, µs."""
        return samples.summary(self.latencies, self.lost)

    def median_of_rounds(self, percent: float) -> float | None:
        """The median over rounds of their own percentile, whatever one bad moment of the machine did; µs."""
        kept = [sorted(one) for one in self.rounds if one]
        return statistics.median(samples.percentile(one, percent) for one in kept) if kept else None

    def later_than(self, deadline: float) -> float:
        """The share of what was sent that came later than ``deadline`` µs, or never."""
        sent = len(self.latencies) - self.doubled + self.lost
        return (sum(late > deadline for late in self.latencies) + self.lost) / sent if sent else math.nan

    def row(self, deadline: float) -> dict[str, object]:
        """For the result."""
        return {
            "latency_us": asdict(self.summary),
            "latency_from_send_us": asdict(samples.summary(self.from_send)),
            "p99_median_of_rounds_us": self.median_of_rounds(99.0),
            "p999_median_of_rounds_us": self.median_of_rounds(99.9),
            "doubled": self.doubled,
            "deadline_us": deadline,
            "share_past_deadline": self.later_than(deadline),
            "publisher_late_us": asdict(samples.summary(self.source_late)),
            "processes": {name: usage_row(usage, self.messages) for name, usage in self.usage.items()},
        }


def turns(ways: Sequence[Way], rounds: int, console: Console) -> Iterator[list[Way]]:
    """The order of each round; each starts with another way, so that none always follows the same one."""
    for turn in range(rounds):
        console.print(f"round {turn + 1} of {rounds}", style="dim")
        first = turn % len(ways)
        yield [*ways[first:], *ways[:first]]


class HostLateness:
    """How late the machine itself wakes, before and after a measurement, and what the hypervisor took in between."""

    def __init__(self) -> None:
        self._late = machine.lateness(_HOST_LATENESS)
        self._times = psutil.cpu_times()

    def finish(self, console: Console) -> dict[str, object]:
        """Measure again, print what came out, return it for the result."""
        times = psutil.cpu_times()
        stolen = 1000 * (times.steal - self._times.steal)
        self._late += machine.lateness(_HOST_LATENESS)
        histogram = machine.histogram(self._late)
        console.print(f"late wake-ups of this machine (1 ms sleeps, µs): {histogram}")
        console.print(f"taken by the hypervisor while processes wanted to run: {stolen:.0f} ms, over all processors")
        return {
            "late_wake_ups_us": asdict(samples.summary(self._late)),
            "late_histogram": histogram,
            "stolen_ms": stolen,
        }


def lateness_under_fifo(seconds: float, priority: int) -> list[float]:
    """As ``machine.lateness``, under SCHED_FIFO: what the kernel and the hypervisor add to real-time processes."""
    policy, before = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    try:
        return machine.lateness(seconds)
    finally:
        os.sched_setscheduler(0, policy, before)
