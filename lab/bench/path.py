"""One-way latency, as half of the round trip, of every path in one run.

The contenders take turns in rounds, so that whatever else the machine does hits all alike.
"""

from __future__ import annotations

from array import array
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from rich.table import Table

from lab import machine, plot, results, samples, tables
from lab.bed.bench import Bed, why_no_hosts, why_no_ros
from lab.bed.processes import Deadline
from lab.bench import contenders
from lab.usage import Usage, add

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

_WARM_UP: Final = 20
"""Round trips of each round that are thrown away: caches and the processor's clock come up."""
_BASE: Final = "roscpp_nodelay"


@dataclass(frozen=True, slots=True)
class Plan:
    """How much is measured.

    Args:
        trips: Round trips by size in bytes, over all rounds.
        rounds: Turns of each contender.
        only: Keys of contenders; empty for all.
    """

    trips: dict[int, int]
    rounds: int
    only: tuple[str, ...] = ()


FULL: Final = Plan({64: 12_000, 64 * 1024: 3_000, 1024 * 1024: 1_000}, 10)
QUICK: Final = Plan({64: 1_000, 64 * 1024: 400, 1024 * 1024: 100}, 2)


class _Score:
    """One contender at one size: its samples (ns), losses and usage."""

    def __init__(self) -> None:
        self.trips = array("Q")
        self.lost = 0
        self.usage: dict[str, Usage] = {}


Scores = dict[tuple[str, int], _Score]


def run(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure every contender."""
    return measure(QUICK if quick else FULL, console, json)


def measure(plan: Plan, console: Console, json: Path | None = None) -> dict[str, object]:
    """Run the plan, print the tables, write the files; return the result."""
    if not machine.facts()["python_optimised"]:
        console.print(
            "this Python was built without optimisations: agents are slower than with the system's", style="yellow"
        )
    late = machine.lateness(2.0)
    scores: Scores = {}
    with Bed() as bed:
        field = _start(bed, plan.only, console)
        for turn in range(plan.rounds):
            console.print(f"round {turn + 1} of {plan.rounds}", style="dim")
            for size, trips in plan.trips.items():
                # Every round starts with another one, so that nobody is always behind the same neighbour.
                for contender in field[turn % len(field) :] + field[: turn % len(field)]:
                    _turn(contender, size, trips // plan.rounds, bed.home / "samples", scores)
    late += machine.lateness(2.0)
    titles = {contender.key: contender.title for contender in field}
    result = _result(scores, titles, late)
    for size in plan.trips:
        console.print(_table(size, scores, titles))
    console.print(_usage_table(scores, titles, min(plan.trips)))
    console.print(f"late wake-ups of this machine (1 ms sleeps, µs): {machine.histogram(late)}")
    written = results.write("path", asdict(plan), result, json)
    image = written.with_suffix(".png")
    plot.path(image, {key: [t / 2000 for t in score.trips] for key, score in scores.items()}, titles)
    console.print(f"written: {written} and {image.name}")
    return result


def _start(bed: Bed, only: tuple[str, ...], console: Console) -> list[contenders.Contender]:
    field = []
    for key, start in contenders.ALL.items():
        needs = "" if key.startswith("floor") else why_no_ros()
        needs = needs or (why_no_hosts() if key == "agents_hosts" else "")
        if only and key not in only:
            continue
        if needs:
            console.print(f"left out: {key}: {needs}", style="yellow")
            continue
        try:
            contender = start(bed)
        except Deadline as error:
            console.print(f"left out: {key} did not start: {error}", style="red", markup=False)
            continue
        for process in contender.still:
            process.freeze()
        field.append(contender)
    return field


def _turn(contender: contenders.Contender, size: int, trips: int, scratch: Path, scores: Scores) -> None:
    score = scores.setdefault((contender.key, size), _Score())
    with contender.awake():
        contender.round(size, _WARM_UP, scratch)
        times, lost, usage = contender.round(size, trips, scratch)
    score.trips.extend(times)
    score.lost += lost
    score.usage = add(score.usage, usage)


def _one_way(score: _Score) -> samples.Summary:
    """In µs."""
    return samples.summary([trip / 2000 for trip in score.trips], score.lost)


def _ratio(value: float | None, scores: Scores, base: str, size: int) -> float | None:
    other = scores.get((base, size))
    median = _one_way(other).p50 if other else None
    return tables.ratio(value, median)


def _result(scores: Scores, titles: dict[str, str], late: list[float]) -> dict[str, object]:
    rows = []
    for (key, size), score in scores.items():
        row = _one_way(score)
        rows.append(
            {
                "contender": key,
                "title": titles[key],
                "bytes": size,
                "one_way_us": asdict(row),
                "to_roscpp": _ratio(row.p50, scores, _BASE, size),
                "to_relays": _ratio(row.p50, scores, "relays", size),
                "processes": {name: tables.usage_row(usage, len(score.trips)) for name, usage in score.usage.items()},
            }
        )
    return {
        "rows": rows,
        "late_wake_ups_us": asdict(samples.summary(late)),
        "late_histogram": machine.histogram(late),
    }


def _table(size: int, scores: Scores, titles: dict[str, str]) -> Table:
    table = Table(title=f"one way, {tables.size(size)}, µs")
    table.add_column("path")
    for head in ("p50", "p95", "p99", "p99.9", "max", "trips", "lost", "to roscpp", "to relays"):
        table.add_column(head, justify="right")
    for key, title in titles.items():
        if score := scores.get((key, size)):
            row = _one_way(score)
            cells = [tables.us(value) for value in (row.p50, row.p95, row.p99, row.p999, row.largest)]
            ratios = [_ratio(row.p50, scores, base, size) for base in (_BASE, "relays")]
            table.add_row(title, *cells, str(row.count), str(row.lost), *[tables.dash(ratio) for ratio in ratios])
    return table


def _usage_table(scores: Scores, titles: dict[str, str], size: int) -> Table:
    measured = [(title, scores[key, size]) for key, title in titles.items() if (key, size) in scores]
    rows = [(title, score.usage, len(score.trips)) for title, score in measured]
    return tables.usage_table(f"processes on the path, {tables.size(size)}", rows, "round trip")
