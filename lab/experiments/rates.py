"""Experiment 2: how latency is distributed at different rates.

Section 5 of the paper, Fig. 10: from 10 to 50 Hz in batches of 100 messages, grouped around 350 µs up to 40 Hz and
"becoming more irregular" above. Here it goes on to 1 kHz.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from lab import samples, statistics
from lab.experiments.contenders import (
    CLASSIC,
    COMPARED,
    DEFAULTS,
    DIRECT,
    RELAYS,
    RMPA,
    nodelay_of,
    relays_of,
    turn,
)
from lab.experiments.model import Cell, Measured, Results
from lab.experiments.stream import SETTLE, stream
from lab.findings import Claim, Figure, Findings, Grid, Panel, Series
from lab.frames import latencies, lost
from lab.words import counted

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from lab.bed.plan import Plan
    from lab.bed.stage import Stage
    from lab.experiments.contenders import Contender

# Hz; the paper's.
PAPER: Final = (10, 20, 30, 40, 50)
_SIZE: Final = 64
_ROUNDS: Final = {"short": 1, "full": 2}
# Messages of each rate in each round.
_COUNTS: Final = {
    "short": {10: 5, 50: 10, 1000: 200},
    "full": {**dict.fromkeys(PAPER, 100), 100: 600, 200: 1600, 500: 5000, 1000: 5000},
}
# Messages in one round of what only stands beside the others.
_BESIDE: Final = {**dict.fromkeys(PAPER, 50), 1000: 1000}
# Seconds until a system of two hosts and its nodes are up, about.
_SETUP: Final = 5.0
# Of p95 less p50: that of 200 messages (at each of the paper's rates) has a standard error of 13 %, the median of
# five such rates one of 7 %, and 1.2 leaves room for three of those.
_WIDENING_LIMIT: Final = 1.2
_MS_TO_US: Final = 1e3
# Python agents that are no slower than relays in C++.
_RELAYS_LIMIT: Final = 1.0
# Of the direct transport at 1 kHz, by classic ROS over the same cable.
_DIRECT_LIMITS: Final = {"p50": 1.05, "p99": 1.15}
# No wider than classic ROS: the widths of 10,000 messages have a standard error of 2 %, their ratio one of 3 %, and
# this leaves room for three of those.
_WIDTH_LIMIT: Final = 1.1

_ABOUT: Final = """\
One stream of 64 bytes from *joystick* to *pc*, one way: from the moment at which a message was **due** at its
source to when the subscriber's callback has it (a message that leaves late is charged for it). The hosts are
network namespaces of one machine, with one clock.

10 to 50 Hz in batches of 100, as in the paper, in each of two rounds; then in each round 600 messages at 100 Hz,
1,600 at 200 Hz, 5,000 at 500 Hz and 5,000 at 1 kHz. So p99 is given from 100 Hz on, and p99.9 at 500 Hz and 1 kHz;
percentiles with fewer than ten samples beyond them are left out. The first tenth of a second of each step is not
counted. Systems take turns.

RMPA is there twice: *RMPA*, through the agents, and *RMPA direct*, from node to node. Classic ROS runs with
tcp_nodelay. Beside it, in one round of 50 messages at each of the paper's rates and 1,000 at
1 kHz: classic ROS *without tcp_nodelay*, where Nagle's algorithm may hold a message back until the one before it
was acknowledged; and classic ROS through *two relays* in C++ (roscpp, tcp_nodelay), one on each host, which tells
what two more processes that must wake cost by themselves: much more at 10 Hz, from an idle processor, than at 1
kHz.

*Width* is p95 less p50. No widening is said when the width at 1 kHz is at most 1.2 times the median of those at 10
to 50 Hz: their own sampling error is 7 %. The direct transport is held against classic ROS itself, on the same kind
of cable: p50, p99 and width at 1 kHz.
"""


class Rates:
    """Experiment 2."""

    name = "rates"
    title = "2. Latency and rate (Fig. 10)"
    about = _ABOUT

    def cells(self, plan: Plan) -> list[Cell]:
        """One for each client, contender and round; each climbs through all rates."""
        clients = plan.clients[:1] if plan.short else plan.clients
        made: list[Cell] = []
        for number in range(1, _ROUNDS[plan.size] + 1):
            beside = [DEFAULTS, RELAYS] if number == 1 and not plan.short else []
            for shift, client in enumerate(clients, number):
                for contender in (*turn(COMPARED, shift), *beside):
                    settings = {**contender.settings, "client": client, "round": number}
                    made.append(
                        Cell(self.name, settings, _seconds(_counts(plan, beside=contender in (DEFAULTS, RELAYS))))
                    )
        return made

    def measure(self, cell: Cell, stage: Stage) -> Measured:
        """Climb through the rates once."""
        with stream(cell, stage, "rate") as made:
            for rate, count in _counts(stage.plan, beside=not nodelay_of(cell) or relays_of(cell) > 0).items():
                made.run(rate, size=_SIZE, rate=rate, count=count)
            return made.measured()

    def findings(self, results: Results) -> Findings:
        """Fig. 10 and its figures for each client, and whether the distribution widens."""
        figures: list[Figure] = []
        grids: list[Grid] = []
        claims: list[Claim] = []
        for client in results.plan.clients:
            steps = {contender: _steps(results, contender, client) for contender in _SHOWN}
            if not any(steps.values()):
                continue
            figures.append(_figure(steps, client))
            grids.append(_grid(steps, client))
            text = f"p95 less p50 of RMPA, {client}: at 1 kHz / at 10 to 50 Hz"
            claims.append(Claim(text, widening(steps[RMPA]), _WIDENING_LIMIT))
            text = f"p50 at 10 to 50 Hz, {client}: RMPA / classic through two relays in C++"
            claims.append(Claim(text, _slowly(steps[RMPA], steps[RELAYS]), _RELAYS_LIMIT))
            claims.extend(_direct_claims(steps[DIRECT], steps[CLASSIC], client))
        return Findings(tuple(figures), tuple(grids), tuple(claims))


EXPERIMENT: Final = Rates()


_SHOWN: Final = (RMPA, DIRECT, CLASSIC, RELAYS, DEFAULTS)


class RateStep:
    """One contender at one rate, over all rounds.

    Args:
        values: Latencies, ms.
        lost: How many messages never came.
    """

    def __init__(self) -> None:
        self.values: list[float] = []
        self.lost = 0

    @property
    def summary(self) -> samples.Summary:
        """Percentiles, ms."""
        return samples.summary(self.values, self.lost)

    @property
    def width(self) -> float | None:
        """p95 less p50, ms; ``None`` where the samples are too few."""
        found = self.summary
        return None if found.p95 is None or found.p50 is None else found.p95 - found.p50

    @property
    def quartiles(self) -> float | None:
        """The interquartile range, ms; ``None`` likewise."""
        if len(self.values) < _QUARTILES_NEED:
            return None
        ordered = sorted(self.values)
        return samples.percentile(ordered, 75.0) - samples.percentile(ordered, 25.0)


# Ten beyond each.
_QUARTILES_NEED: Final = 40
Steps = dict[int, RateStep]


def widening(steps: Mapping[int, RateStep]) -> float | None:
    """How many times as wide the distribution is at 1 kHz as at the paper's rates (the median of theirs)."""
    base = statistics.median(steps[rate].width for rate in PAPER if rate in steps)
    width = steps[1000].width if 1000 in steps else None
    return width / base if base and width is not None else None


def _slowly(steps: Steps, base: Steps) -> float | None:
    """The median over the paper's rates of one p50 by the other's."""
    medians = [(steps[rate].summary.p50, base[rate].summary.p50) for rate in PAPER if rate in steps and rate in base]
    return statistics.median(a / b for a, b in medians if a is not None and b)


def _direct_claims(steps: Steps, base: Steps, client: str) -> Iterator[Claim]:
    """The direct transport's figures by classic ROS's; none where it was not measured."""
    if not steps:
        return
    text = f"p50 at 10 to 50 Hz, {client}: RMPA direct / classic"
    yield Claim(text, _slowly(steps, base), _DIRECT_LIMITS["p50"])
    ours, theirs = (of.get(1000, RateStep()) for of in (steps, base))
    for name, limit in _DIRECT_LIMITS.items():
        a, b = getattr(ours.summary, name), getattr(theirs.summary, name)
        yield Claim(f"{name} at 1 kHz, {client}: RMPA direct / classic", a / b if a and b else None, limit)
    width = ours.width / theirs.width if ours.width is not None and theirs.width else None
    yield Claim(f"p95 less p50 at 1 kHz, {client}: RMPA direct / classic", width, _WIDTH_LIMIT)


def _counts(plan: Plan, *, beside: bool) -> dict[int, int]:
    return _BESIDE if beside else _COUNTS[plan.size]


def _seconds(counts: Mapping[int, int]) -> float:
    return _SETUP + sum(count / rate + 2 * SETTLE for rate, count in counts.items())


def _steps(results: Results, contender: Contender, client: str) -> Steps:
    steps: Steps = {}
    for _, measured in contender.select(results, client=client):
        arrivals, sent = measured.tables["arrivals"], measured.tables["sent"]
        for rate in sent["rate"].unique().tolist():
            step = steps.setdefault(rate, RateStep())
            step.values += latencies(arrivals, rate=rate)
            step.lost += lost(arrivals, sent, rate=rate)
    return dict(sorted(steps.items()))


def _grid(steps: Mapping[Contender, Steps], client: str) -> Grid:
    rows: list[tuple[str, ...]] = []
    for rate in sorted({rate for of in steps.values() for rate in of}):
        base = steps[CLASSIC].get(rate)
        for contender, of in steps.items():
            if (step := of.get(rate)) is None:
                continue
            found = step.summary
            values = (found.p50, step.quartiles, step.width, found.p95, found.p99, found.p999, found.largest)
            median = base.summary.p50 if base else None
            ratio = found.p50 / median if found.p50 is not None and median else None
            cells = [counted(value, factor=_MS_TO_US) for value in values]
            rows.append((f"{rate} Hz", contender.label, *cells, str(found.count), str(found.lost), counted(ratio)))
    heads = (
        "p50",
        "interquartile range",
        "p95 - p50",
        "p95",
        "p99",
        "p99.9",
        "largest",
        "messages",
        "lost",
        "p50 / classic",
    )
    widths = ", ".join(
        f"{contender.label} {counted(widening(of))}" for contender, of in steps.items() if widening(of) is not None
    )
    note = f"p95 - p50 at 1 kHz / at 10 to 50 Hz: {widths}." if widths else ""
    return Grid(f"Fig. 10 in figures: {client}, 64 bytes, one way, µs", ("rate", "system", *heads), rows, note)


def _figure(steps: Mapping[Contender, Steps], client: str) -> Figure:
    shown = [contender for contender in COMPARED if steps[contender]]
    boxes = [_boxes(steps[contender], f"{contender.label}, {client}", contender.look) for contender in shown]
    curves = [
        Series(f"{contender.label}, {name}", *_curve(steps[contender], name), style="line", system=contender.look)
        for contender in shown
        for name in ("p50", "p95", "p99")
    ]
    tails = [
        Series(f"{contender.label}, {title}", *statistics.distribution(values), style="steps", system=contender.look)
        for contender in shown
        for title, values in _ends(steps[contender])
    ]
    return Figure(
        f"fig-10-{client}",
        f"Fig. 10. Latency by rate: {client}",
        "The paper's rates and those beyond; percentiles by rate; the distribution at both ends.",
        (
            Panel("each rate", "rate, Hz", "latency, µs", tuple(boxes), logy=True, ticks=_ticks(steps)),
            Panel("percentiles", "rate, Hz", "latency, µs", tuple(curves), logx=True, logy=True),
            Panel("distribution", "latency, µs", "share of messages", tuple(tails), logx=True),
        ),
    )


def _rates(steps: Mapping[Contender, Steps]) -> list[int]:
    return sorted({rate for contender in COMPARED for rate in steps[contender]})


def _ticks(steps: Mapping[Contender, Steps]) -> dict[str, float]:
    return {str(rate): float(rate) for rate in _rates(steps)}


def _boxes(steps: Steps, label: str, system: str) -> Series:
    pairs = [(float(rate), value * _MS_TO_US) for rate, step in steps.items() for value in step.values]
    return Series(label, [x for x, _ in pairs], [y for _, y in pairs], style="box", system=system)


def _curve(steps: Steps, name: str) -> tuple[Sequence[float], Sequence[float]]:
    points = [(float(rate), getattr(step.summary, name)) for rate, step in steps.items()]
    kept = [(rate, value * _MS_TO_US) for rate, value in points if value is not None]
    return [rate for rate, _ in kept], [value for _, value in kept]


def _ends(steps: Steps) -> Iterator[tuple[str, list[float]]]:
    low = [value * _MS_TO_US for rate in PAPER if rate in steps for value in steps[rate].values]
    if low:
        yield "10 to 50 Hz", low
    if 1000 in steps:
        yield "1 kHz", [value * _MS_TO_US for value in steps[1000].values]
