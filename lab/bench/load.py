"""A command while every core is busy with something else: direct, through agents, through agents with ``--realtime``.

The measuring nodes run under SCHED_FIFO in every case, so that what they wait for is the path and not themselves.
"""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from lab import machine, samples
from lab.bed.bench import Bed
from lab.bed.processes import Process
from lab.bench import schedule
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, percentiles, ratio, table_of, us, usage_table

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

_SIZE, _RATE = 64, 100.0
_HOGS: Final = max(2, os.cpu_count() or 2)
# µs.
_DEADLINE: Final = 1000.0
_CONDITIONS: Final = ("idle", "hogs")


@dataclass(frozen=True, slots=True)
class LoadPlan:
    """How much is measured.

    Args:
        idle: Seconds of each round without hogs.
        hogs: Seconds of each round with them.
        rounds: Turns of each way.
    """

    idle: float
    hogs: float
    rounds: int


FULL: Final = LoadPlan(5.0, 20.5, 5)
QUICK: Final = LoadPlan(5.5, 5.5, 2)

Scores = dict[tuple[str, str], schedule.LatencyScore]


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the files; return the result."""
    plan = QUICK if quick else FULL
    host = schedule.HostLateness()
    scores: Scores = {}
    with Bed() as bed:
        realtime, how = schedule.realtime_agents(bed, network=2)
        ways = [schedule.direct(bed), schedule.agents(bed, network=1), realtime]
        console.print(f"real time: {how}", style="dim")
        streams = {way.key: way.stream(bed, "/command", fifo=schedule.NODE_PRIORITY) for way in ways}
        for order in schedule.turns(ways, plan.rounds, console):
            for way in order:
                _take(scores, way, "idle", streams[way.key], plan.idle)
            with hogs(_HOGS):
                for way in order:
                    _take(scores, way, "hogs", streams[way.key], plan.hogs)
    with hogs(_HOGS):
        kernel = schedule.lateness_under_fifo(plan.hogs / 2, schedule.NODE_PRIORITY)
    titles = {way.key: way.title for way in ways}
    console.print(_table(scores, titles))
    rows = [(titles[key], one.usage, one.messages) for (key, condition), one in scores.items() if condition == "hogs"]
    console.print(usage_table("processes on the path beside hogs", rows))
    console.print(
        f"late wake-ups under SCHED_FIFO beside the hogs, of a sleeper alone, µs: {machine.histogram(kernel)}"
    )
    ours = scores["agents_realtime", "hogs"].summary
    target = Claim("p99.9 beside hogs with --realtime, ms", ours.p999 and ours.p999 / 1000, 1.0)
    result: dict[str, object] = {
        "rows": [_row(key, condition, one, scores) for (key, condition), one in scores.items()],
        "realtime": how,
        "fifo_wake_ups_beside_hogs_us": asdict(samples.summary(kernel)),
        **host.finish(console),
    }
    settings = {**asdict(plan), "bytes": _SIZE, "hz": _RATE, "hogs": _HOGS, "node_priority": schedule.NODE_PRIORITY}
    return finish(console, "load", settings, result, json, claims=[target])


@contextmanager
def hogs(count: int) -> Iterator[None]:
    """Keep so many busy loops running, as any user's processes do (SCHED_OTHER, nice 0)."""
    started = [Process([sys.executable, "-c", "while True: pass"], name=f"hog {number}") for number in range(count)]
    try:
        yield
    finally:
        for hog in started:
            hog.end()


def _take(scores: Scores, way: schedule.Way, condition: str, stream: schedule.MeasuredStream, seconds: float) -> None:
    scores.setdefault((way.key, condition), schedule.LatencyScore()).add(stream.run(_SIZE, _RATE, seconds))


def _row(key: str, condition: str, one: schedule.LatencyScore, scores: Scores) -> dict[str, object]:
    return {
        "way": key,
        "condition": condition,
        **one.row(_DEADLINE),
        "p50_to_direct": ratio(one.summary.p50, scores["direct", condition].summary.p50),
        "p99_to_direct": ratio(one.summary.p99, scores["direct", condition].summary.p99),
        "p99_to_idle": ratio(one.summary.p99, scores[key, "idle"].summary.p99),
    }


def _table(scores: Scores, titles: dict[str, str]) -> Table:
    what = f"{_SIZE} B at {_RATE:.0f} Hz, nodes under SCHED_FIFO {schedule.NODE_PRIORITY}"
    heads = ("p50", "p95", "p99", "p99.9", "max", "count", "lost", ">1 ms", "to idle", "to direct", "p99.9 from send")
    table = table_of(f"{what}, from due to there, µs; ratios of p99", ("way", "beside"), heads)
    for condition in _CONDITIONS:
        for key, name in titles.items():
            one = scores[key, condition]
            row = one.summary
            cells = percentiles(row)
            counts = [str(row.count), str(row.lost), f"{100 * one.later_than(_DEADLINE):.2f} %"]
            bases = (scores[key, "idle"].summary.p99, scores["direct", condition].summary.p99)
            beside = f"{_HOGS} hogs" if condition == "hogs" else "nothing"
            ratios = [dash(ratio(row.p99, base)) for base in bases]
            table.add_row(name, beside, *cells, *counts, *ratios, us(samples.summary(one.from_send).p999))
    return table
