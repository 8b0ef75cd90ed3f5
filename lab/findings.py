"""Findings as data: figures, tables and claims. ``lab.figures`` draws the figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


@dataclass(frozen=True, slots=True)
class Series:
    """One set of points in a panel.

    Args:
        label: For the legend.
        x: In the panel's unit.
        y: As many.
        style: ``points`` for samples, ``line``, ``steps`` for a distribution function, ``bars``; ``spans`` for thick
            horizontal bars, one for each pair of points: ``x`` where it begins and ends, ``y`` its row, twice;
            ``box`` for samples ``y`` grouped by their ``x`` (quartiles, p5 to p95, p99), groups equally far apart.
        system: Decides the colour, the same in all figures: ``classic``, ``rmpa``, ``direct``,
            ``mixed`` or something else.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    style: Literal["points", "line", "steps", "bars", "spans", "box"] = "points"
    system: str = ""


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes.

    Args:
        title: Above it.
        xlabel: With the unit.
        ylabel: With the unit.
        series: What is drawn.
        logx: A logarithmic axis.
        logy: Likewise.
        marks: Horizontal lines by what they say: ``{"to reach": 1.0}``.
        moments: Vertical lines likewise: ``{"pc killed": 0.0}``.
        names: What ``y`` = 0, 1, 2 … are called, from the top down, in place of numbers.
        ticks: What stands below the horizontal axis in place of numbers: ``{"1 KB": 1024.0}``.
        distribution: Draw beside it how often its points have which ``y``, on the same axis.
    """

    title: str
    xlabel: str
    ylabel: str
    series: tuple[Series, ...]
    logx: bool = False
    logy: bool = False
    marks: Mapping[str, float] = field(default_factory=dict)
    moments: Mapping[str, float] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    ticks: Mapping[str, float] = field(default_factory=dict)
    distribution: bool = False


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture of the report; the sleep-lateness histogram of its cells is drawn beside it by the report.

    Args:
        name: Its file's: ``fig-10-rates``.
        title: Above it, with the paper's number.
        caption: What is to be seen.
        panels: From left to right.
        columns: How many stand side by side, the next ones below them; 0: as it fits. Those below each other share
            their horizontal axis if they have the same label there.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    columns: int = 0


@dataclass(frozen=True, slots=True)
class Grid:
    """A table of the report, ready to read.

    Args:
        title: With the paper's number.
        columns: Heads.
        rows: As many texts each.
        note: Below it.
    """

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Claim:
    """A figure that is held against what it should be.

    Args:
        text: What should hold: ``period sd of CMD, RMPA / classic``.
        value: What came out; ``None`` where the samples are too few to say.
        limit: What it may be at the most, or at the least.
        at_least: Which of the two.
        unit: Of both; empty for a ratio.
        paper: What the paper had, if it had it.
    """

    text: str
    value: float | None
    limit: float
    at_least: bool = False
    unit: str = ""
    paper: float | None = None

    @property
    def reached(self) -> bool | None:
        """Whether it holds; ``None`` without a value."""
        if self.value is None:
            return None
        return self.value >= self.limit if self.at_least else self.value <= self.limit


@dataclass(frozen=True, slots=True)
class Findings:
    """What the report says of one experiment."""

    figures: tuple[Figure, ...] = ()
    grids: tuple[Grid, ...] = ()
    claims: tuple[Claim, ...] = ()
    notes: tuple[str, ...] = ()
