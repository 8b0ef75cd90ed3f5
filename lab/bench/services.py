"""How long a service call takes through two agents, beside a direct one of roscpp: both ends are roscpp nodes.

A call of its own connection asks the master where the server is, connects, says its header and calls; a persistent
one only calls. Directly, both hosts have one rosmaster; through agents, each has its own core.
"""

from __future__ import annotations

from array import array
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from lab import samples, tables
from lab.bed.bench import TEST_NODES, Bed
from lab.findings import Claim
from lab.results import finish
from lab.tables import table_of

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from lab.bed.processes import Process
    from lab.bed.ros import Ros

_SIZES: Final = (64, 64 * 1024, 1024 * 1024)
_HOWS: Final = ("once", "persistent")
_TARGET: Final = 2.0
_WARM_UP: Final = 20
"""Calls of each turn that are thrown away."""


@dataclass(frozen=True, slots=True)
class ServicesPlan:
    """How much is measured.

    Args:
        calls: By size in bytes, over all rounds.
        rounds: Turns of each way.
    """

    calls: dict[int, int]
    rounds: int


FULL: Final = ServicesPlan(dict(zip(_SIZES, (3000, 1500, 400), strict=True)), 10)
QUICK: Final = ServicesPlan(dict(zip(_SIZES, (200, 100, 30), strict=True)), 2)


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure both ways in turns, print the table, write the file; return the result."""
    plan = QUICK if quick else FULL
    took: dict[tuple[str, str, int], list[float]] = {}
    failed = 0
    with Bed() as bed:
        ways = {"direct": _direct(bed), "agents": _agents(bed)}
        for turn in range(plan.rounds):
            for name in ways if turn % 2 else reversed(ways):
                for how in _HOWS:
                    for size, calls in plan.calls.items():
                        new, bad = _round(bed, ways[name], how, size, calls // plan.rounds)
                        took.setdefault((name, how, size), []).extend(new)
                        failed += bad
    result = _show(console, took)
    targets = [
        Claim(
            f"a call of {size} bytes ({how}), agents / direct, p50",
            tables.ratio(_p50(took["agents", how, size]), _p50(took["direct", how, size])),
            _TARGET,
        )
        for how in _HOWS
        for size in plan.calls
    ]
    document: dict[str, object] = {"calls": result, "failed": failed}
    return finish(console, "services", asdict(plan), document, json, claims=targets)


def _direct(bed: Bed) -> Process:
    """Two hosts with one master."""
    here, there = bed.classic()
    return _ends(there, here)


def _agents(bed: Bed) -> Process:
    """Two modules."""
    a, b = bed.lab.hosts("a", "b", network=1)
    first, second = bed.agent(a, name="a"), bed.agent(b, name="b")
    first.wait_peer(second.name)
    return _ends(bed.shell(a), bed.shell(b))


def _ends(serving: Ros, calling: Ros) -> Process:
    serving.roscpp("worker", nodes=TEST_NODES, quiet=True).wait_event("up")
    asker = calling.roscpp("asker", commands=True)
    asker.wait_event("ready")
    return asker


def _round(bed: Bed, asker: Process, how: str, size: int, calls: int) -> tuple[list[float], int]:
    """Microseconds of each call behind the warm-up, and how many failed."""
    path = bed.home / "calls"
    since = asker.mark_events()
    asker.tell(f"{size} {calls + _WARM_UP} {how} {path}")
    event = asker.wait_event("round", 120.0, since=since)
    times = array("Q", path.read_bytes())
    return [time / 1e3 for time in times[_WARM_UP:]], int(str(event["failed"]))


def _p50(times: list[float]) -> float | None:
    return samples.summary(times).p50


def _show(console: Console, took: dict[tuple[str, str, int], list[float]]) -> list[dict[str, object]]:
    table = table_of(
        "a call of rmpa_test/Work, µs", ("way", "connection", "bytes each way"), ("p50", "p99", "max", "calls")
    )
    rows: list[dict[str, object]] = []
    for (name, how, size), times in sorted(took.items(), key=lambda item: (item[0][2], item[0][1], item[0][0])):
        summary = samples.summary(times)
        table.add_row(name, how, str(size), *map(tables.us, (summary.p50, summary.p99, max(times))), str(len(times)))
        rows.append({"way": name, "connection": how, "bytes": size, "us": asdict(summary)})
    console.print(table)
    return rows
