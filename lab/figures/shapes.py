"""The panels that the measurements of ``lab.bench`` have in common, from samples by line and panel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

from lab.findings import Panel, Series
from lab.samples import percentile
from lab.statistics import distribution

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    _Points = Callable[[Sequence[float]], tuple[list[float], list[float]]]
    _Style = Literal["steps", "line"]
    Panels = Mapping[str, Mapping[str, Sequence[float]]]
    """Samples by the line's label, by the panel's title."""

_RANKS: Final = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p99.9": 99.9, "p99.99": 99.99}


def shares(panels: Panels, unit: str) -> list[Panel]:
    """How large a share of the samples is at most so large."""
    return [
        Panel(title, unit, "share of the samples", _series(lines, distribution, "steps"), logx=True)
        for title, lines in panels.items()
    ]


def tails(panels: Panels, unit: str, limit: float | None = None) -> list[Panel]:
    """Each percentile up to what the samples carry, the rare ones stretched; ``limit`` is what is to be reached."""
    ticks = {name: _rarity(rank) for name, rank in _RANKS.items()}
    marks = {"to reach": limit} if limit else {}
    return [
        Panel(
            title, "percentile", unit, _series(lines, _tail, "line"), logx=True, logy=True, marks=marks, ticks=ticks
        )
        for title, lines in panels.items()
    ]


def bars(panels: Mapping[str, Mapping[str, float]], unit: str) -> list[Panel]:
    """One bar a line, side by side."""
    return [
        Panel(
            title, "", unit, tuple(Series(label, [0.0], [y], "bars") for label, y in lines.items()), ticks={"": 0.0}
        )
        for title, lines in panels.items()
    ]


def lines(panels: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]], unit: str) -> list[Panel]:
    """Figures over what grows, from points of (how much, figure)."""
    return [
        Panel(
            title,
            "",
            unit,
            tuple(Series(label, [x for x, _ in pts], [y for _, y in pts], "line") for label, pts in of.items()),
            logx=True,
            ticks={f"{x:g}": x for pts in of.values() for x, _ in pts},
        )
        for title, of in panels.items()
    ]


def _series(lines: Mapping[str, Sequence[float]], points: _Points, style: _Style) -> tuple[Series, ...]:
    return tuple(Series(label, *points(samples), style) for label, samples in lines.items() if len(samples))


def _rarity(rank: float) -> float:
    """How many samples there are for each beyond a percentile."""
    return 1 / (1 - rank / 100)


def _tail(samples: Sequence[float]) -> tuple[list[float], list[float]]:
    values = sorted(samples)
    ranks = [100 - 100 * 10 ** (-step / 20) for step in range(1, 101) if len(values) * 10 ** (-step / 20) >= 10]
    return [_rarity(rank) for rank in ranks], [percentile(values, rank) for rank in ranks]
