"""How evenly messages arrive: the period at the far end of the same unmodified nodes, by classic ROS and by RMPA.

The paper's Table 1: its jitter at 10 Hz was 1.9 times that of classic ROS. Two relays in C++ tell what two more
wake-ups cost by themselves. All take turns in short rounds, and the standard deviation is the median over rounds,
because one bad moment of a shared machine would decide it alone.
"""

from __future__ import annotations

import statistics
from array import array
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from lab import samples
from lab.bed.bench import Bed
from lab.bench import schedule
from lab.figures import shapes
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, ratio, table_of, us, usage_row, usage_table
from lab.usage import Usage, add

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

_SIZE: Final = 64
_LIMIT: Final = 1.1
_FASTEST: Final = 1000


@dataclass(frozen=True, slots=True)
class PeriodPlan:
    """How much is measured.

    Args:
        seconds: Of each round, by rate in Hz.
        rounds: Turns of each way at each rate.
    """

    seconds: dict[int, float]
    rounds: int


FULL: Final = PeriodPlan({10: 10.2, 50: 4.2, 100: 3.0, 1000: 2.0}, 10)
QUICK: Final = PeriodPlan({10: 2.0, 50: 1.0, 100: 1.0, 1000: 1.0}, 3)


class Evenness:
    """One way at one rate, over all rounds; µs."""

    def __init__(self) -> None:
        self.periods = array("d")
        self.deviations: list[float] = []
        self.source_deviations: list[float] = []
        self.lost = 0
        self.usage: dict[str, Usage] = {}
        self.messages = 0

    def add(self, arrivals: schedule.Arrivals) -> None:
        """Take one round."""
        periods = arrivals.periods()
        self.periods.extend(periods)
        if len(periods) > 1:
            self.deviations.append(statistics.stdev(periods))
            self.source_deviations.append(statistics.stdev(arrivals.source_periods()))
        self.lost += arrivals.lost
        self.usage = add(self.usage, arrivals.usage)
        self.messages += arrivals.total

    @property
    def sd(self) -> float | None:
        """The median over rounds."""
        return statistics.median(self.deviations) if self.deviations else None

    @property
    def source_sd(self) -> float | None:
        """The same of the publisher's own sends."""
        return statistics.median(self.source_deviations) if self.source_deviations else None

    @property
    def summary(self) -> samples.Summary:
        """Of all periods."""
        return samples.summary(self.periods, self.lost)

    @property
    def spread(self) -> float | None:
        """p99 less p50."""
        whole = self.summary
        return None if whole.p99 is None or whole.p50 is None else whole.p99 - whole.p50


Scores = dict[tuple[str, int], Evenness]


def paired(ours: Evenness, base: Evenness) -> float | None:
    """The median over rounds of the ratio of the deviations in one round: neighbours in time."""
    ratios = [a / b for a, b in zip(ours.deviations, base.deviations, strict=False) if b]
    return round(statistics.median(ratios), 3) if ratios else None


def measure(quick: bool, console: Console, json: Path | None = None, *, realtime: bool = False) -> dict[str, object]:
    """Measure, print the tables, write the files; return the result."""
    plan = QUICK if quick else FULL
    host = schedule.HostLateness()
    scores: Scores = {}
    with Bed() as bed:
        kinds = (schedule.RELAYED, schedule.DIRECT)
        ways, fifo, how = schedule.direct_and_agents(bed, kinds, realtime=realtime)
        ways.append(schedule.relays(bed, network=len(ways)))
        console.print(how, style="dim")
        streams = {way.key: way.stream(bed, "/paced", fifo=fifo) for way in ways}
        for order in schedule.turns(ways, plan.rounds, console):
            for rate, seconds in plan.seconds.items():
                for way in order:
                    arrivals = streams[way.key].run(_SIZE, rate, seconds)
                    scores.setdefault((way.key, rate), Evenness()).add(arrivals)
    titles = {way.key: way.title for way in ways}
    for rate in plan.seconds:
        console.print(_table(rate, scores, titles))
    rows = [(titles[key], one.usage, one.messages) for (key, rate), one in scores.items() if rate == _FASTEST]
    console.print(usage_table(f"processes on the path, {_FASTEST} Hz", rows))
    targets = [
        Claim(f"period sd at {rate} Hz, {what}", ratio(scores[key, rate].sd, base.sd), _LIMIT)
        for key, what in (("agents", "through agents / direct"), ("agents_direct", "RMPA direct / roscpp direct"))
        for rate in plan.seconds
        for base in [scores["direct", rate]]
    ]
    ours, theirs = scores["agents_direct", _FASTEST], scores["direct", _FASTEST]
    text = f"p99 less p50 of the period at {_FASTEST} Hz, RMPA direct / roscpp direct"
    targets.append(Claim(text, ratio(ours.spread, theirs.spread), _LIMIT))
    result: dict[str, object] = {
        "rows": [_row(key, rate, one, scores["direct", rate]) for (key, rate), one in scores.items()],
        "scheduling": how,
        **host.finish(console),
    }
    settings = {**asdict(plan), "bytes": _SIZE}
    panels = shapes.shares(_panels(scores, titles), "distance from the period that was meant, µs")
    return finish(
        console, schedule.named("period", realtime=realtime), settings, result, json, claims=targets, panels=panels
    )


def _row(key: str, rate: int, one: Evenness, base: Evenness) -> dict[str, object]:
    return {
        "way": key,
        "hz": rate,
        "period_us": asdict(one.summary),
        "mean_us": statistics.fmean(one.periods) if one.periods else None,
        "sd_us": one.sd,
        "sd_by_round_us": one.deviations,
        "p99_minus_p50_us": one.spread,
        "source_sd_us": one.source_sd,
        "sd_to_direct": ratio(one.sd, base.sd),
        "sd_to_direct_paired": paired(one, base),
        "p99_minus_p50_to_direct": ratio(one.spread, base.spread),
        "processes": {name: usage_row(usage, one.messages) for name, usage in one.usage.items()},
    }


def _table(rate: int, scores: Scores, titles: dict[str, str]) -> Table:
    heads = ("mean", "sd", "p99 - p50", "max", "sd at the source", "periods", "lost", "sd to direct", "same, paired")
    table = table_of(f"period at {rate} Hz, {_SIZE} B, µs; sd: median over rounds", ("way",), heads)
    base = scores["direct", rate]
    for key, title in titles.items():
        one = scores[key, rate]
        mean = statistics.fmean(one.periods) if one.periods else None
        cells = [us(value) for value in (mean, one.sd, one.spread, one.summary.largest, one.source_sd)]
        counts = [str(len(one.periods)), str(one.lost)]
        table.add_row(title, *cells, *counts, dash(ratio(one.sd, base.sd)), dash(paired(one, base)))
    return table


def _panels(scores: Scores, titles: dict[str, str]) -> dict[str, dict[str, list[float]]]:
    panels: dict[str, dict[str, list[float]]] = {}
    for (key, rate), one in scores.items():
        meant = 1e6 / rate
        panels.setdefault(f"{rate} Hz", {})[titles[key]] = [abs(period - meant) for period in one.periods]
    return panels
