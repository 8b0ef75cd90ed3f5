"""Experiment 3: latency and payload.

Section 5 of the paper, Fig. 11: from 1 KB to 1 MB in batches of 100 messages; "the relation between both parameters
is almost linear".
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lab import samples, statistics, words
from lab.experiments.contenders import CLASSIC, COMPARED, DIRECT, RMPA, Contender, contender_of, turn
from lab.experiments.model import Cell, Measured, Results
from lab.experiments.stream import LEAD, SETTLE, stream
from lab.findings import Claim, Figure, Findings, Grid, Panel, Series
from lab.frames import latencies, lost
from lab.words import counted

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from lab.bed.plan import Plan
    from lab.bed.stage import Stage

_KB: Final = 1024
# Bytes: 1 KB to 1 MB, doubling; a few of them to see that it works.
SIZES: Final = {
    "short": tuple(_KB * kb for kb in (1, 16, 128, 512)),
    "full": tuple(_KB << power for power in range(11)),
}
BATCHES: Final = {"short": (5,), "full": (100, 1000)}
# How a cell says that no link is shaped.
UNSHAPED: Final = "none"
# Hz at the most: the next message is due long after the last one came.
_FASTEST: Final = 400.0
# Of the link, at the most, so that no message waits behind the one before.
_FILLED: Final = 0.7
# Bits on the wire for one of payload: headers of Ethernet, IP and TCP, and a little for acknowledgements.
_OVERHEAD: Final = 1.06
# Taken as carried where no link is shaped: what a process must copy several times on two cores.
_UNSHAPED_BITS: Final = 400e6
# Seconds for the batch of one size; beyond that it is cut short, to the smallest batch at the least.
_LONGEST: Final = {"short": 1.0, "full": 5.0}
_SETUP: Final = 5.0
_R2_LIMIT: Final = 0.99
_SIZES_NEEDED: Final = 3
# Of the direct transport's p50 by classic ROS's, on a cable that is not shaped: the wire hides nothing there.
_DIRECT_LIMIT: Final = 1.05
_DIRECT_SIZES: Final = (64 * _KB, _KB * _KB)
_UNITS: Final = {"": 1.0, "k": 1e3, "m": 1e6, "g": 1e9}

_ABOUT: Final = """\
One stream from *joystick* to *pc*, one way, from the moment at which a message was due at its source to when the
subscriber's callback has all of it. Messages of 1 KB to 1 MB (1 KB = 1,024 bytes), doubling, in batches of 100 and
of 1,000; the rate is what the link carries at 70 %, 400 Hz at the most. In the batches of 1,000, sizes that would
need more than five seconds of the link get as many messages as fit in, 100 at the least: 1 MB takes 88 ms of a link
of 100 Mbit/s. The same again, in batches of 100, on a link that is not shaped. *RMPA* is through the agents, *RMPA
direct* from node to node.

A straight line is laid through the medians of the sizes, and another one through all samples; R² says how much of
the variance it explains.
"""
_NOTES: Final = (
    (
        "The shaped link is a token bucket that lets 32 KB through at once: up to there latency is that of an "
        "unshaped link, and beyond it each KB takes its time on the wire. So the line meets the axis just below 0."
    ),
)


class Payload:
    """Experiment 3."""

    name = "payload"
    title = "3. Latency and payload (Fig. 11)"
    about = _ABOUT

    def cells(self, plan: Plan) -> list[Cell]:
        """One for each client, link, batch and contender; each climbs through all sizes."""
        clients = plan.clients[:1] if plan.short else plan.clients
        kinds = [(plan.link or UNSHAPED, batch) for batch in BATCHES[plan.size]]
        if plan.link and not plan.short:
            kinds.append((UNSHAPED, BATCHES[plan.size][0]))
        made: list[Cell] = []
        for link, batch in kinds:
            for client in clients:
                for contender in turn(COMPARED, len(made) // len(COMPARED)):
                    seconds = _SETUP + sum(
                        count / rate + LEAD + 2 * SETTLE for rate, count in steps(plan, link, batch).values()
                    )
                    settings = {**contender.settings, "client": client, "link": link, "batch": batch, "round": 1}
                    made.append(Cell(self.name, settings, seconds))
        return made

    def measure(self, cell: Cell, stage: Stage) -> Measured:
        """Climb through the sizes once."""
        link, batch = str(cell.settings["link"]), int(str(cell.settings["batch"]))
        with stream(cell, stage, "size", link="" if link == UNSHAPED else link) as made:
            for size, (rate, count) in steps(stage.plan, link, batch).items():
                made.run(size, size=size, rate=rate, count=count)
            return made.measured()

    def findings(self, results: Results) -> Findings:
        """Fig. 11 for each client and link, the lines, and whether they are straight."""
        found = _measured(results)
        return Findings(
            tuple(_figures(found)),
            (*_grids(found), *([_lines(found)] if found else [])),
            (*_claims(found, results.plan), *_direct_claims(found)),
            _NOTES if any(kind.link != UNSHAPED for kind in found) else (),
        )


EXPERIMENT: Final = Payload()


def steps(plan: Plan, link: str, batch: int) -> dict[int, tuple[float, int]]:
    """The rate (Hz) and the number of messages for each size (bytes)."""
    carried = _UNSHAPED_BITS if link == UNSHAPED else bits_per_second(link)
    least = min(BATCHES[plan.size])
    made: dict[int, tuple[float, int]] = {}
    for size in SIZES[plan.size]:
        rate = min(_FASTEST, _FILLED * carried / (8 * _OVERHEAD * size))
        made[size] = (rate, max(least, min(batch, int(rate * _LONGEST[plan.size]))))
    return made


def bits_per_second(link: str) -> float:
    """What ``tc`` means by ``100mbit``.

    Raises:
        ValueError: It is not written so.
    """
    if not (found := re.fullmatch(r"(\d+(?:\.\d+)?)([kmg]?)bit", link.lower())):
        raise ValueError(f"{link!r} is no rate such as 100mbit")
    return float(found[1]) * _UNITS[found[2]]


def name(size: int) -> str:
    """``4 KB``."""
    return f"{size // (_KB * _KB)} MB" if size >= _KB * _KB else f"{size // _KB} KB"


class Ladder:
    """One contender on one link in one batch.

    Args:
        values: Latencies by size, ms.
        lost: Messages by size that never came.
    """

    def __init__(self) -> None:
        self.values: dict[int, list[float]] = {}
        self.lost: dict[int, int] = {}

    def add(self, measured: Measured) -> None:
        """Take the tables of one cell."""
        arrivals, sent = measured.tables["arrivals"], measured.tables["sent"]
        for size in sent["size"].unique().tolist():
            self.values.setdefault(size, []).extend(latencies(arrivals, size=size))
            self.lost[size] = self.lost.get(size, 0) + lost(arrivals, sent, size=size)

    @property
    def medians(self) -> dict[int, float]:
        """By size, ms; a size of which nothing came is not in it."""
        return {size: samples.percentile(sorted(values), 50.0) for size, values in self.values.items() if values}

    def line(self, *, every: bool = False) -> statistics.Fit | None:
        """Through the medians, or through every sample; ms over KB. ``None`` with fewer than three sizes."""
        if len(self.medians) < _SIZES_NEEDED:
            return None
        points = [(size / _KB, value) for size, values in self.values.items() for value in values]
        if not every:
            points = [(size / _KB, value) for size, value in self.medians.items()]
        return statistics.linear_fit([x for x, _ in points], [y for _, y in points])


@dataclass(frozen=True, slots=True)
class Kind:
    """What two ladders must share to be held against each other."""

    client: str
    link: str
    batch: int


Found = dict[Kind, dict["Contender", Ladder]]
# Of tables.
_ORDER: Final = (RMPA, DIRECT, CLASSIC)


def _measured(results: Results) -> Found:
    """What there is, in the order in which it was planned."""
    found: Found = {}
    for cell, measured in results.cells:
        batch = cell.settings["batch"]
        kind = Kind(str(cell.settings["client"]), str(cell.settings["link"]), batch if isinstance(batch, int) else 0)
        found.setdefault(kind, {}).setdefault(contender_of(cell), Ladder()).add(measured)
    return found


def _claims(found: Found, plan: Plan) -> Iterator[Claim]:
    for kind, ladders in found.items():
        if kind.link != (plan.link or UNSHAPED) or RMPA not in ladders:
            continue
        for every, what in ((False, "medians"), (True, "all samples")):
            line = None if plan.short else ladders[RMPA].line(every=every)
            text = f"R² of RMPA, {kind.client}, batches of {kind.batch}, through {what}"
            yield Claim(text, line.r2 if line else None, _R2_LIMIT, at_least=True)


def _direct_claims(found: Found) -> Iterator[Claim]:
    for kind, ladders in found.items():
        if kind.link == UNSHAPED and DIRECT in ladders and CLASSIC in ladders:
            for size in _DIRECT_SIZES:
                ours, theirs = (samples.summary(ladders[one].values.get(size, [])).p50 for one in (DIRECT, CLASSIC))
                text = f"p50 of {name(size)}, {kind.client}, {_link(kind.link)}, {kind.batch}: RMPA direct / classic"
                yield Claim(text, ours / theirs if ours and theirs else None, _DIRECT_LIMIT)


def _lines(found: Found) -> Grid:
    rows = [
        (
            kind.client,
            _link(kind.link),
            str(kind.batch),
            contender.label,
            what,
            *_line(ladders[contender], every=every),
        )
        for kind, ladders in found.items()
        for contender in _ORDER
        if contender in ladders
        for every, what in ((False, "medians"), (True, "all samples"))
    ]
    heads = ("client", "link", "batch", "system", "through", "at 0, ms", "slope, µs/KB", "as Mbit/s", "R²")
    return Grid("Fig. 11: straight lines through latency over payload", heads, rows)


def _line(ladder: Ladder, *, every: bool) -> tuple[str, str, str, str]:
    line = ladder.line(every=every)
    if line is None:
        return "-", "-", "-", "-"
    carried = _KB * 8 / (line.slope * 1e3) if line.slope > 0 else None
    return counted(line.intercept), counted(line.slope, factor=1e3), counted(carried), f"{line.r2:.5f}"


def _grids(found: Found) -> Iterator[Grid]:
    for kind, ladders in found.items():
        shown = [contender for contender in _ORDER if contender in ladders]
        ours = [contender for contender in shown if contender is not CLASSIC]
        rows: list[tuple[str, ...]] = []
        for size in sorted({size for ladder in ladders.values() for size in ladder.values}):
            row = [name(size)]
            medians: dict[Contender, float | None] = {}
            for contender in shown:
                of = samples.summary(ladders[contender].values.get(size, []), ladders[contender].lost.get(size, 0))
                medians[contender] = of.p50
                row += [
                    counted(of.p50),
                    counted(of.p95),
                    counted(of.largest),
                    f"{of.count} / {of.lost}",
                ]
            base = medians.get(CLASSIC)
            ratios = ((medians[one], base) for one in ours)
            rows.append((*row, *(counted(a / b if a and b else None) for a, b in ratios)))
        heads = [f"{what}, {one.label}" for one in shown for what in ("p50", "p95", "largest", "came / lost")]
        title = f"Fig. 11 in figures: {kind.client}, {_link(kind.link)}, batches of {kind.batch}; latency, ms"
        yield Grid(title, ("payload", *heads, *(f"p50, {one.label} / classic" for one in ours)), rows)


def _figures(found: Found) -> Iterator[Figure]:
    for kind, ladders in found.items():
        shown = [contender for contender in COMPARED if contender in ladders]
        labels = {one: f"{one.label}, {kind.client}" for one in shown}
        points = [_points(ladders[one], labels[one], one.look) for one in shown]
        lines = [series for one in shown for series in _drawn(ladders[one], labels[one], one.look)]
        medians = [
            Series(labels[one], *_columns(ladders[one].medians), style="line", system=one.look) for one in shown
        ]
        yield Figure(
            f"fig-11-{kind.client}-{kind.link}-{kind.batch}",
            f"Fig. 11. Latency by payload: {kind.client}, {_link(kind.link)}, batches of {kind.batch}",
            "Every message, with the line through the medians; then the medians, on axes that show small payloads.",
            (
                Panel(_straightness(ladders, shown), "payload, KB", "latency, ms", (*points, *lines)),
                Panel("medians", "payload, KB", "latency, ms", tuple(medians), logx=True, logy=True),
            ),
        )


def _straightness(ladders: Mapping[Contender, Ladder], shown: Sequence[Contender]) -> str:
    lines = [f"{one.label} {line.r2:.3f}" for one in shown if (line := ladders[one].line()) is not None]
    return f"R²: {', '.join(lines)}" if lines else "every message"


def _link(link: str) -> str:
    return "link not shaped" if link == UNSHAPED else f"link of {words.link(link)}"


def _points(ladder: Ladder, label: str, system: str) -> Series:
    pairs = [(size / _KB, value) for size, values in ladder.values.items() for value in values]
    return Series(label, [x for x, _ in pairs], [y for _, y in pairs], system=system)


def _drawn(ladder: Ladder, label: str, system: str) -> Iterator[Series]:
    line = ladder.line()
    if line is not None:
        ends = [min(ladder.medians) / _KB, max(ladder.medians) / _KB]
        yield Series(label, ends, [line.at(x) for x in ends], style="line", system=system)


def _columns(medians: Mapping[int, float]) -> tuple[Sequence[float], Sequence[float]]:
    return [size / _KB for size in medians], list(medians.values())
