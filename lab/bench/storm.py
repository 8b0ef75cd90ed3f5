"""Does control work delay data? A relayed stream at 1 kHz while tools and nodes ask a master 200 times a second.

The same calls go nowhere, to the core inside the agent, and to an ``rmpa core`` in a process of its own on the same
host: that is one process against control in its own. Beside it direct roscpp, idle and while its rosmaster is asked,
which shows what the calls cost any program on so few processors.
"""

from __future__ import annotations

import sys
import time
from array import array
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from lab import samples
from lab.bed.agents import RMPA
from lab.bed.bench import Bed
from lab.bed.ros import NODES
from lab.bench import schedule
from lab.figures import shapes
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, ratio, table_of, us, usage_table
from lab.usage import Meter, Usage, add

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from lab.bed.processes import Process

_SIZE, _RATE = 64, 1000.0
_CALLS: Final = 200.0
"""A second."""
_QUEUE: Final = 1000
"""Messages: a second. A stall of the machine is to show as latency and not as loss."""
_AHEAD: Final = 0.3
"""Seconds of calls before the stream, and behind it."""
_LIMIT: Final = 1.3
_DEADLINE: Final = 1000.0
"""µs."""
_SEPARATE_PORT: Final = 11399
_FILL_DEADLINE: Final = 60.0


FULL: Final = schedule.Rounds(4.0, 12)
QUICK: Final = schedule.Rounds(2.6, 4)


@dataclass(slots=True)
class Case:
    """One way with one master under fire.

    Args:
        key: Its name in JSON.
        title: Its name in tables.
        stream: The messages.
        idle: The key of the case without calls that it is held against; its own if it is that.
        client: Makes the calls; ``None`` for none.
        port: Of the master that is called.
        others: Processes to be measured beside those of the stream.
    """

    key: str
    title: str
    stream: schedule.MeasuredStream
    idle: str
    client: Process | None = None
    port: int = 0
    others: dict[str, Process] | None = None


class Stormy(schedule.LatencyScore):
    """A stream's rounds, and the calls."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = array("d")
        self.failed = 0
        self.seconds = 0.0
        self.beside: dict[str, Usage] = {}

    def add_calls(self, event: dict[str, object], usage: dict[str, Usage]) -> None:
        """Take the client's report of one round."""
        took = event["took"]
        assert isinstance(took, list)
        self.calls.extend(took)
        self.failed += int(str(event["failed"]))
        self.seconds += float(str(event["seconds"]))
        self.beside = add(self.beside, usage)

    @property
    def rate(self) -> float:
        """Calls a second that were made."""
        return len(self.calls) / self.seconds if self.seconds else 0.0


Scores = dict[str, Stormy]


def measure(quick: bool, console: Console, json: Path | None = None, *, realtime: bool = False) -> dict[str, object]:
    """Measure, print the table, write the files; return the result."""
    plan = QUICK if quick else FULL
    host = schedule.HostLateness()
    scores: Scores = {}
    with Bed() as bed:
        cases, how = _cases(bed, realtime=realtime)
        console.print(how, style="dim")
        for turn in range(plan.rounds):
            console.print(f"round {turn + 1} of {plan.rounds}", style="dim")
            first = turn % len(cases)
            for case in [*cases[first:], *cases[:first]]:
                _take(case, plan.seconds, scores.setdefault(case.key, Stormy()))
    console.print(_table(cases, scores))
    rows = [
        (case.title, {**scores[case.key].usage, **scores[case.key].beside}, scores[case.key].messages)
        for case in cases
    ]
    console.print(usage_table("processes on the path and beside it", rows))
    result: dict[str, object] = {
        "rows": [_row(case, scores) for case in cases],
        "scheduling": how,
        **host.finish(console),
    }
    settings = {**asdict(plan), "bytes": _SIZE, "hz": _RATE, "calls_per_s": _CALLS}
    panels: dict[str, dict[str, array[float]]] = {}
    for case in cases:
        panels.setdefault(case.idle.partition("_")[0], {})[case.title] = scores[case.key].latencies
    return finish(
        console,
        schedule.named("storm", realtime=realtime),
        settings,
        result,
        json,
        claims=_targets(scores),
        panels=shapes.tails(panels, "from due to there, µs"),
    )


def _cases(bed: Bed, *, realtime: bool) -> tuple[list[Case], str]:
    (direct, agents), fifo, how = schedule.direct_and_agents(bed, realtime=realtime)
    classic, relayed = (way.stream(bed, "/command", queue=_QUEUE, fifo=fifo) for way in (direct, agents))
    # The sender's host: its core, its agent. The calls come from a process there, as its tools and nodes do.
    separate = agents.here.start(RMPA, "core", "--port", str(_SEPARATE_PORT), name="core")
    separate.wait_for("started core service")
    clients = [
        way.here.start(sys.executable, NODES / "storm.py", name="storm", commands=True) for way in (direct, agents)
    ]
    for client, port in (
        (clients[0], direct.here.port),
        (clients[1], agents.here.port),
        (clients[1], _SEPARATE_PORT),
    ):
        mark = client.mark_events()
        client.tell(f"fill {port}")
        filled = client.wait_event("filled", _FILL_DEADLINE, since=mark)
        assert filled["failed"] == 0, f"the master at {port} refused {filled['failed']} calls"
    own, apart = agents.here.port, _SEPARATE_PORT
    cases = [
        Case("direct_idle", "direct, no calls", classic, "direct_idle"),
        Case("direct_master", "direct, rosmaster asked", classic, "direct_idle", clients[0], direct.here.port),
        Case("agents_idle", "agents, no calls", relayed, "agents_idle"),
        Case("agents_own", "agents, own core asked", relayed, "agents_idle", clients[1], own),
        Case(
            "agents_apart",
            "agents, core apart asked",
            relayed,
            "agents_idle",
            clients[1],
            apart,
            {"core apart": separate},
        ),
    ]
    return cases, f"{how}; callers, rosmaster and core apart under SCHED_OTHER"


def _take(case: Case, seconds: float, score: Stormy) -> None:
    if case.client is None:
        score.add(case.stream.run(_SIZE, _RATE, seconds))
        return
    mark = case.client.mark_events()
    others = {"caller": case.client.pid, **{name: one.pid for name, one in (case.others or {}).items()}}
    meter = Meter(others)
    case.client.tell(f"{case.port} {_CALLS} {seconds + 2 * _AHEAD + schedule.LEAD_IN}")
    time.sleep(_AHEAD)
    score.add(case.stream.run(_SIZE, _RATE, seconds))
    event = case.client.wait_event("stormed", 60.0, since=mark)
    score.add_calls(event, meter.read())


def _targets(scores: Scores) -> list[Claim]:
    own, idle, apart = (scores[key] for key in ("agents_own", "agents_idle", "agents_apart"))
    return [
        Claim("p99.9 while its core is asked / idle, all rounds", ratio(own.summary.p999, idle.summary.p999), _LIMIT),
        Claim("the same, median of rounds", ratio(own.median_of_rounds(99.9), idle.median_of_rounds(99.9)), _LIMIT),
        Claim("p99.9, one process / core apart", ratio(own.summary.p999, apart.summary.p999), 1.0),
    ]


def _row(case: Case, scores: Scores) -> dict[str, object]:
    one, idle = scores[case.key], scores[case.idle]
    row: dict[str, object] = {
        "case": case.key,
        "title": case.title,
        **one.row(_DEADLINE),
        "p99_to_idle": ratio(one.summary.p99, idle.summary.p99),
        "p999_to_idle": ratio(one.summary.p999, idle.summary.p999),
    }
    if one.calls:
        row["calls"] = {"per_s": one.rate, "failed": one.failed, "took_ms": asdict(samples.summary(one.calls))}
    return row


def _table(cases: list[Case], scores: Scores) -> Table:
    heads = (
        "p50",
        "p99",
        "p99.9",
        "max",
        "count",
        "lost",
        "to idle",
        "of p99.9",
        "calls/s",
        "failed",
        "call p50, ms",
    )
    table = table_of(
        f"{_SIZE} B at {_RATE:.0f} Hz beside {_CALLS:.0f} calls/s, from due to there, µs; ratios of p99, p99.9",
        ("case",),
        heads,
    )
    for case in cases:
        one, idle = scores[case.key], scores[case.idle].summary
        row, calls = one.summary, samples.summary(one.calls)
        cells = [us(value) for value in (row.p50, row.p99, row.p999, row.largest)]
        ratios = [dash(ratio(row.p99, idle.p99)), dash(ratio(row.p999, idle.p999))]
        asked = [f"{one.rate:.0f}", str(one.failed), dash(calls.p50)] if one.calls else ["-"] * 3
        table.add_row(case.title, *cells, str(row.count), str(row.lost), *ratios, *asked)
    return table
