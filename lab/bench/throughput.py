"""How much goes through: a roscpp node that publishes, a roscpp node that counts, all processes on two cores.

*Flat out*, the publisher sends as fast as roscpp takes it, and what is too much is dropped where it first does not
fit: mostly in the publisher's own queue. What arrived is the figure; the share of what was sent that did not arrive
stands beside it.
"""

from __future__ import annotations

import os
import statistics
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Final

import psutil

from lab.bed.bench import Bed
from lab.bed.transport import require
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, ratio, size, table_of, usage_row, usage_table
from lab.usage import Meter, Usage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from lab.bed.agents import Agent
    from lab.bed.plan import Transport
    from lab.bed.ros import Ros

_MB: Final = 1024 * 1024
# Messages in the queues of publisher and subscriber: about 2 and 50 MB.
_QUEUE: Final = {64: 10_000, _MB: 50}
# What is to be reached of direct roscpp.
_LIMITS: Final = {64: 0.6, _MB: 0.4}
# What the direct transport is to reach of roscpp over the same cable.
_DIRECT_LIMIT: Final = 0.95
_TOPIC: Final = "/flood"
_CORES: Final = 2
# Seconds from the first message to the begin of a window, usually: queues are as full as they get.
_SETTLE: Final = 1.0
_FIRST_DEADLINE: Final = 30.0
# Percent of a core that the rest of the machine may use, soft interrupts included, which count for no process.
_QUIET: Final = 20.0


@dataclass(frozen=True, slots=True)
class ThroughputPlan:
    """How much is measured.

    Args:
        seconds: Of each window.
        rounds: Windows flat out, of each way in turn.
    """

    seconds: float
    rounds: int


FULL: Final = ThroughputPlan(5.0, 3)
QUICK: Final = ThroughputPlan(2.0, 1)


@dataclass(frozen=True, slots=True)
class Count:
    """What one node has counted at one moment.

    Args:
        ns: Of the steady clock, which all processes share.
        messages: So far.
        sequence: The last message's number.
    """

    ns: int
    messages: int
    sequence: int


@dataclass(frozen=True, slots=True)
class Window:
    """The messages of one window.

    Args:
        received: Messages a second that the receiver counted.
        sent: That the publisher gave to roscpp.
        lost: Share of the messages numbered in the window that never came.
        usage: By process.
        others: Percent of a core that the rest of the machine used on our cores.
        dropped: Messages of it that each agent says it has dropped, since it was first published.
    """

    received: float
    sent: float
    lost: float
    usage: dict[str, Usage]
    others: float
    dropped: dict[str, int] = field(default_factory=dict)


def rate_of(first: Count, last: Count) -> float:
    """Messages a second between two moments."""
    return 1e9 * (last.messages - first.messages) / (last.ns - first.ns)


def lost_between(first: Count, last: Count) -> float:
    """The share of the numbers between two moments that never came."""
    numbered = last.sequence - first.sequence
    return max(0.0, 1 - (last.messages - first.messages) / numbered) if numbered else 0.0


@dataclass(slots=True)
class FloodWay:
    """One way from publisher to receiver, freshly started.

    Args:
        here: The publisher's shell.
        there: The receiver's.
        agents: Those between them.
        transport: How messages cross where there are agents, which each window makes sure of.
        settle: Seconds from the first message to the begin of a window.
    """

    here: Ros
    there: Ros
    agents: list[Agent] = field(default_factory=list)
    transport: Transport | None = None
    settle: float = _SETTLE

    def window(self, bytes_each: int, seconds: float, rate: float = 0.0) -> Window:
        """Publish at ``rate`` Hz, or flat out; measure when that has settled."""
        queue = _QUEUE[bytes_each]
        sink = self.there.roscpp("counter", nodelay=True, queue=queue)
        sink.wait_event("up")
        flood = self.here.roscpp("flood", size=bytes_each, queue=queue, rate=rate)
        try:
            sink.wait_event("window", _FIRST_DEADLINE, where=lambda event: int(str(event["count"])) > 0)
            if self.transport:
                require(self.transport, [(flood, sink)])
            time.sleep(self.settle)
            between = {f"agent {number}": agent.pid for number, agent in enumerate(self.agents, 1)}
            meter = Meter({"publisher": flood.pid, **between, "receiver": sink.pid})
            busy = _busy()
            before = len(sink.events("window")), len(flood.events("sent"))
            time.sleep(seconds)
            usage = meter.read()
            if self.transport:
                require(self.transport, [(flood, sink)])
            others = _busy() - busy - sum(one.cpu for one in usage.values())
            came = [_count(event) for event in sink.events("window")[before[0] :]]
            sent = [_count(event) for event in flood.events("sent")[before[1] :]]
            dropped = {name: _dropped(agent) for name, agent in zip(between, self.agents, strict=True)}
        finally:
            flood.end()
            sink.end()
        return Window(
            received=rate_of(came[0], came[-1]),
            sent=rate_of(sent[0], sent[-1]),
            lost=lost_between(came[0], came[-1]),
            usage=usage,
            others=100 * others / seconds,
            dropped=dropped,
        )


def _busy() -> float:
    """Seconds so far in which the cores that we may use were busy, with whatever it was."""
    cores = os.sched_getaffinity(0)
    times = [one for number, one in enumerate(psutil.cpu_times(percpu=True)) if number in cores]
    return sum(sum(one) - one.idle - one.iowait - one.guest - one.guest_nice for one in times)


def _count(event: dict[str, object]) -> Count:
    ns, messages = int(str(event["ns"])), int(str(event["count"]))
    return Count(ns, messages, int(str(event.get("sequence", messages))))


def _dropped(agent: Agent) -> int:
    """What the agent counts as dropped of the topic, either way."""
    return sum(one.dropped for topic in agent.snapshot().topics if topic.name == _TOPIC for one in topic.routes)


def _direct(bed: Bed) -> FloodWay:
    shell = bed.shell()
    shell.master()
    return FloodWay(shell, shell)


def _direct_hosts(bed: Bed) -> FloodWay:
    return FloodWay(*bed.classic())


def _agents(bed: Bed, transport: Transport = "relay") -> FloodWay:
    hosts = bed.lab.hosts("a", "b")
    agents = [bed.agent(host, name=host.name, way=transport) for host in hosts]
    agents[0].wait_peer("b")
    here, there = (bed.shell(agent.host, agent.core_port) for agent in agents)
    return FloodWay(here, there, agents, transport)


WAYS: Final[dict[str, tuple[str, Callable[[Bed], FloodWay]]]] = {
    "direct": ("roscpp direct", _direct),
    "direct_hosts": ("roscpp direct, two hosts", _direct_hosts),
    "agents": ("two agents, two hosts", _agents),
    "agents_direct": ("RMPA direct, two hosts", partial(_agents, transport="direct")),
}


@dataclass(slots=True)
class ThroughputScore:
    """One way at one size.

    Args:
        windows: Flat out, one a round.
    """

    windows: list[Window] = field(default_factory=list)

    @property
    def received(self) -> float:
        """Messages a second, flat out; the median over rounds."""
        return statistics.median(window.received for window in self.windows)

    @property
    def middle(self) -> Window:
        """The window of the median, for the figures beside it."""
        return sorted(self.windows, key=lambda window: window.received)[len(self.windows) // 2]


Scores = dict[tuple[str, int], ThroughputScore]


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the tables, write the files; return the result."""
    plan = QUICK if quick else FULL
    scores: Scores = {(key, bytes_each): ThroughputScore() for bytes_each in _LIMITS for key in WAYS}
    with _on_cores(_CORES) as cores:
        for turn in range(plan.rounds):
            console.print(f"round {turn + 1} of {plan.rounds}", style="dim")
            for bytes_each in _LIMITS:
                for key, (_, start) in WAYS.items():
                    with Bed() as bed:
                        scores[key, bytes_each].windows.append(start(bed).window(bytes_each, plan.seconds))
    for bytes_each in _LIMITS:
        console.print(_table(bytes_each, scores))
        middles = [(title, scores[key, bytes_each].middle) for key, (title, _) in WAYS.items()]
        rows = [(title, window.usage, _messages(window)) for title, window in middles]
        console.print(usage_table(f"processes flat out, {size(bytes_each)}", rows, "message that arrived"))
    result: dict[str, object] = {
        "rows": [_row(key, bytes_each, scores) for key, bytes_each in scores],
    }
    if (others := max(score.middle.others for score in scores.values())) > _QUIET:
        console.print(f"other processes used up to {others:.0f} % of a core meanwhile: not to quote", style="yellow")
    return finish(
        console,
        "throughput",
        {**asdict(plan), "cores": cores, "queue": _QUEUE},
        result,
        json,
        claims=_targets(scores),
    )


@contextmanager
def _on_cores(count: int) -> Iterator[list[int]]:
    """Keep this process and all that it starts on so many cores."""
    before = os.sched_getaffinity(0)
    cores = sorted(before)[:count]
    os.sched_setaffinity(0, cores)
    try:
        yield cores
    finally:
        os.sched_setaffinity(0, before)


def _targets(scores: Scores) -> list[Claim]:
    def claim(text: str, bytes_each: int, ours: str, base: str, limit: float) -> Claim:
        value = ratio(scores[ours, bytes_each].received, scores[base, bytes_each].received)
        return Claim(f"{size(bytes_each)}, messages/s {text}", value, limit, at_least=True)

    through = "through two agents to direct roscpp"
    straight = "by RMPA direct to roscpp over the same cable"
    return [
        *(claim(through, one, "agents", "direct", limit) for one, limit in _LIMITS.items()),
        *(claim(straight, one, "agents_direct", "direct_hosts", _DIRECT_LIMIT) for one in _LIMITS),
    ]


def _messages(window: Window) -> int:
    """How many arrived while the usage was measured."""
    return round(window.received * next(iter(window.usage.values())).wall)


def _row(key: str, bytes_each: int, scores: Scores) -> dict[str, object]:
    score, base = scores[key, bytes_each], scores["direct", bytes_each]
    middle = score.middle
    return {
        "way": key,
        "title": WAYS[key][0],
        "bytes": bytes_each,
        "messages_per_s": score.received,
        "messages_per_s_by_round": [window.received for window in score.windows],
        "mb_per_s": score.received * bytes_each / 1e6,
        "sent_per_s": middle.sent,
        "lost_share": middle.lost,
        "agents_dropped": middle.dropped,
        "to_direct": ratio(score.received, base.received),
        "processes": {name: usage_row(usage, _messages(middle)) for name, usage in middle.usage.items()},
        "others_cpu_percent": middle.others,
    }


def _table(bytes_each: int, scores: Scores) -> Table:
    heads = ["messages/s", "to direct", "MB/s", "sent/s", "lost, %"]
    heads += ["agents dropped", "others' CPU, %"]
    table = table_of(f"{size(bytes_each)}: counted at the far node", ("way",), heads)
    base = scores["direct", bytes_each]
    for key, (title, _) in WAYS.items():
        score = scores[key, bytes_each]
        middle = score.middle
        cells = [f"{score.received:.0f}", dash(ratio(score.received, base.received))]
        cells += [f"{score.received * bytes_each / 1e6:.1f}", f"{middle.sent:.0f}", f"{100 * middle.lost:.1f}"]
        dropped = "-" if not middle.dropped else " + ".join(str(count) for count in middle.dropped.values())
        table.add_row(title, *cells, dropped, f"{middle.others:.0f}")
    return table
