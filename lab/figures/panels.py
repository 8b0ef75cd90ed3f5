"""One panel of a figure: its series, each in its style, and the lines and words around them."""

from __future__ import annotations

import itertools
import math
import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from lab.figures.colours import Look, shade
from lab.samples import percentile, summary

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.ticker import Locator

    from lab.findings import Panel, Series

# Characters of all groups' names that have room beside each other in a panel.
_WORDS_LEVEL: Final = 20
# Points of a series that are drawn; of more, evenly chosen ones and the outermost.
_MOST: Final = 3000
# Points up to which a line shows each.
_FEW: Final = 40
_BARS_WITH_NUMBERS: Final = 14
# Points from which an SVG holds them as an image.
_RASTER: Final = 300
_FRACTIONS: Final = ("axes fraction", "axes fraction")
# Of the distribution beside a panel.
_CLASSES: Final = 32
# How many times the distance of p2 and p98 an axis goes beyond them at the most.
_ROOM: Final = 0.8
# Multiples of it scatter evenly, and the same each time.
_GOLDEN: Final = 0.6180339887498949
QUIET: Final = "#444444"
DASHES: Final = (0, (4, 3))


@dataclass(frozen=True, slots=True)
class Drawn:
    """A panel on its axes.

    Args:
        axes: Where it is.
        panel: What it shows.
        looks: Of its series, by label.
        beside: Where the distribution of its points goes, if that is wanted.
    """

    axes: Axes
    panel: Panel
    looks: Mapping[str, Look]
    beside: Axes | None

    @property
    def values(self) -> list[float]:
        """All y."""
        return [y for series in self.panel.series for y in series.y]


def draw(axes: Axes, panel: Panel, looks: Mapping[str, Look], letters: int = 100) -> Drawn:
    """Draw a panel's series and words; ``settle`` does the rest when those that share its axes are drawn too.

    Args:
        axes: Where.
        panel: What.
        looks: Of its series, by label.
        letters: Of a title that have room above it; a longer one is broken.
    """
    axes.set_title(textwrap.fill(panel.title, letters), loc="left")
    axes.set_xlabel(panel.xlabel)
    axes.set_ylabel(panel.ylabel)
    axes.grid(visible=True, alpha=0.25, linewidth=0.6)
    axes.set_axisbelow(True)
    if panel.logx:
        axes.set_xscale("log")
    if panel.logy:
        axes.set_yscale("log")
    full = [one for one in panel.series if len(one.y)]
    places = _Places(panel, full)
    for one in full:
        _DRAWN[one.style](axes, one, looks[one.label], places)
    if panel.ticks:
        _name_places(axes, [places.back(places.place(x)) for x in panel.ticks.values()], list(panel.ticks))
        axes.minorticks_off()
    elif places.equal:
        _name_places(axes, range(len(places.groups)), [f"{x:g}" for x in places.groups])
    elif not panel.logx and full and all(float(x).is_integer() for one in full for x in one.x):
        axes.xaxis.set_major_locator(_whole_numbers())  # numbers of messages, of modules
    for text, y in panel.marks.items():
        axes.axhline(y, color=QUIET, linestyle=DASHES, linewidth=1)
        say(axes, text, (1, y), ("axes fraction", "data"), (-3, 2), "right")
    beside = axes.inset_axes((1.01, 0, 0.17, 1), sharey=axes) if panel.distribution else None
    return Drawn(axes, panel, looks, beside)


def _name_places(axes: Axes, places: Sequence[float], words: list[str]) -> None:
    """Write words below places, turned where they have no room beside each other."""
    axes.set_xticks(places, words, rotation=45 if sum(map(len, words)) > _WORDS_LEVEL else 0)


def settle(together: Sequence[Drawn]) -> None:
    """Bound the vertical axis that some panels share, and draw what depends on it."""
    low, high = _bounds(together)
    for drawn in together:
        if drawn.panel.names:  # rows, from the top down
            drawn.axes.set_yticks(range(len(drawn.panel.names)), drawn.panel.names)
            drawn.axes.set_ylim(len(drawn.panel.names) - 0.4, -0.6)
            drawn.axes.grid(visible=False, axis="y")
        else:
            drawn.axes.set_ylim(low, high)
        if drawn.panel.logx and not drawn.panel.ticks:
            log_numbers(drawn.axes.xaxis)
        if drawn.panel.logy:
            log_numbers(drawn.axes.yaxis)
        elif not drawn.panel.names:
            _beyond(drawn, low, high)
        _moments(drawn.axes, drawn.panel.moments)
        if drawn.beside is not None:
            _distribution(drawn.beside, drawn.panel.series, drawn.looks)


class _Places:
    """Where boxes and bars stand: groups side by side, and the series of a group side by side within it."""

    def __init__(self, panel: Panel, series: Sequence[Series]) -> None:
        kinds = {one.style for one in series}
        self.log = panel.logx
        self.grouped = [one.label for one in series if one.style in {"box", "bars"}]
        self.groups = sorted({x for one in series if one.style in {"box", "bars"} for x in one.x})
        self.equal = "box" in kinds and not panel.logx
        steps = [b - a for a, b in itertools.pairwise(map(self.place, self.groups))]
        self.width = 0.8 * min(steps, default=1.0) / max(1, len(set(self.grouped)))

    def place(self, x: float) -> float:
        """Where a group's middle is, in a scale on which widths add up."""
        if not self.equal:
            return math.log10(x) if self.log else x
        at = next((i for i, group in enumerate(self.groups) if group >= x), len(self.groups) - 1)
        if at == 0 or self.groups[at] == x:
            return float(at)
        below, above = self.groups[at - 1], self.groups[at]
        return at - 1 + (x - below) / (above - below)

    def back(self, place: float) -> float:
        """From that scale to the axis'."""
        return 10**place if self.log and not self.equal else place

    def middle(self, series: Series, x: float) -> float:
        """Where a series' share of a group has its middle."""
        labels = list(dict.fromkeys(self.grouped))
        return self.place(x) + (labels.index(series.label) - (len(labels) - 1) / 2) * self.width


def _points(axes: Axes, series: Series, look: Look, places: _Places) -> None:
    pairs = thinned(list(zip(series.x, series.y, strict=True)))
    axes.plot(
        [places.back(places.place(x)) for x, _ in pairs],
        [y for _, y in pairs],
        linestyle="none",
        marker=look.marker,
        markersize=4.5 if len(pairs) <= _FEW else 3.2 if len(pairs) <= _RASTER else 2.2,
        markeredgewidth=0,
        alpha=0.85 if len(pairs) <= _RASTER else 0.5,
        color=look.colour,
        label=series.label,
        rasterized=len(pairs) > _RASTER,
    )


def _line(axes: Axes, series: Series, look: Look, places: _Places) -> None:
    axes.plot(
        [places.back(places.place(x)) for x in series.x],
        series.y,
        linestyle=look.line,
        linewidth=1.5,
        marker=look.marker if 2 < len(series.x) <= _FEW else "",
        markersize=4.5,
        color=look.colour,
        label=series.label,
    )


def _steps(axes: Axes, series: Series, look: Look, places: _Places) -> None:
    del places
    axes.plot(
        series.x,
        series.y,
        drawstyle="steps-post",
        linestyle=look.line,
        linewidth=1.5,
        color=look.colour,
        label=series.label,
    )


def _bars(axes: Axes, series: Series, look: Look, places: _Places) -> None:
    middles = [places.middle(series, x) for x in series.x]
    left = [places.back(middle - places.width / 2) for middle in middles]
    right = [places.back(middle + places.width / 2) for middle in middles]
    widths = [b - a for a, b in zip(left, right, strict=True)]
    hatch = {"solid": "", "dashed": "///", "dotted": "...", "dashdot": "xxx"}[look.line]
    drawn = axes.bar(
        left, series.y, widths, align="edge", color=look.colour, hatch=hatch, edgecolor="white", label=series.label
    )
    if len(places.groups) * len(set(places.grouped)) <= _BARS_WITH_NUMBERS:
        axes.bar_label(drawn, labels=[f"{y:.3g}" for y in series.y], fontsize=7, padding=1, color=QUIET)


def _spans(axes: Axes, series: Series, look: Look, places: _Places) -> None:
    del places
    pairs = list(zip(series.x, series.y, strict=True))
    for at in range(0, len(pairs) - 1, 2):
        (begin, row), (end, _) = pairs[at], pairs[at + 1]
        axes.barh(
            [row], [end - begin], left=[begin], height=0.55, color=look.colour, label=series.label if not at else ""
        )


def _box(axes: Axes, series: Series, look: Look, places: _Places) -> None:
    """Samples, faint; quartiles; p5 to p95 and p99 where the samples are enough for them."""
    groups: dict[float, list[float]] = {}
    for x, y in zip(series.x, series.y, strict=True):
        groups.setdefault(x, []).append(y)
    for x, samples in sorted(groups.items()):
        middle, half = places.middle(series, x), 0.36 * places.width
        _scatter(axes, samples, look, places, middle, half)
        ordered, whole = sorted(samples), summary(samples)
        low, high = percentile(ordered, 25), percentile(ordered, 75)
        left, right, at = places.back(middle - half), places.back(middle + half), places.back(middle)
        pale = shade(look.colour, 0.75)
        axes.fill([left, right, right, left], [low, low, high, high], facecolor=pale, edgecolor=look.colour, zorder=3)
        axes.plot([left, right], [percentile(ordered, 50)] * 2, color=look.colour, linewidth=2, zorder=4)
        if whole.p95 is not None:
            for edge, end in ((low, percentile(ordered, 5)), (high, whole.p95)):
                axes.plot([at, at], [edge, end], color=look.colour, linewidth=1.1, zorder=3)
        if whole.p99 is not None:
            axes.plot([at], [whole.p99], marker="_", markersize=9, markeredgewidth=1.8, color=look.colour, zorder=4)
    axes.fill([], [], facecolor=shade(look.colour, 0.75), edgecolor=look.colour, label=series.label)


def _scatter(axes: Axes, samples: Sequence[float], look: Look, places: _Places, middle: float, half: float) -> None:
    chosen = thinned(list(enumerate(samples)), _MOST // 10)
    axes.plot(
        [places.back(middle + half * (2 * (i * _GOLDEN % 1) - 1)) for i, _ in chosen],
        [y for _, y in chosen],
        linestyle="none",
        marker=".",
        markersize=2.4,
        markeredgewidth=0,
        alpha=0.45,
        color=look.colour,
        rasterized=True,
        zorder=2,
    )


_DRAWN: Final = {"points": _points, "line": _line, "steps": _steps, "bars": _bars, "spans": _spans, "box": _box}


def thinned(pairs: Sequence[tuple[float, float]], most: int = _MOST) -> list[tuple[float, float]]:
    """Choose points for a picture: every so many-th, and all of the outermost, in their order."""
    if len(pairs) <= most:
        return list(pairs)
    ends = most // 10
    by_size = sorted(range(len(pairs)), key=lambda i: pairs[i][1])
    step = len(pairs) / (most - 2 * ends)
    kept = {int(i * step) for i in range(most - 2 * ends)} | {*by_size[:ends], *by_size[-ends:]}
    return [pairs[i] for i in sorted(kept)]


def _bounds(together: Sequence[Drawn]) -> tuple[float, float]:
    """From where to where: from 0 where that is near, and without points that would leave the others no room."""
    low, high = together[0].axes.get_ylim()
    values = [y for drawn in together for y in drawn.values]
    if together[0].panel.logy or not values:
        return low, high
    if any(drawn.panel.distribution for drawn in together):
        ordered = sorted(values)
        lowest, highest = percentile(ordered, 2), percentile(ordered, 98)
        room = _ROOM * (highest - lowest)
        low, high = max(low, lowest - room), min(high, highest + room)
        if low < high:
            return low, high
        return low - 0.5, high + 0.5
    marks = [mark for drawn in together for mark in drawn.panel.marks.values()]
    if 0 <= min(values) < 0.5 * max(values):
        low = 0.0
    return low, max([high, *(mark + 0.08 * (mark - low) for mark in marks)])


def _beyond(drawn: Drawn, low: float, high: float) -> None:
    """Say at the edge, in each series' colour, what of it lies beyond."""
    above = below = 0
    for series in drawn.panel.series:
        beyond = [y for y in series.y if y > high], [y for y in series.y if y < low]
        colour = drawn.looks[series.label].colour
        if beyond[0]:
            text = f"{len(beyond[0])} beyond, up to {max(beyond[0]):.4g} ▲"
            say(drawn.axes, text, (1, 1), _FRACTIONS, (-3, -9 - 10 * above), "right", colour)
            above += 1
        if beyond[1]:
            text = f"{len(beyond[1])} beyond, down to {min(beyond[1]):.4g} ▼"
            say(drawn.axes, text, (1, 0), _FRACTIONS, (-3, 2 + 10 * below), "right", colour)
            below += 1


def _whole_numbers() -> Locator:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(nbins=8, integer=True, steps=[1, 2, 5, 10])


def log_numbers(axis: Axis) -> None:
    """Write 1000 rather than a power, and numbers between the powers where the axis is short."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = sorted(axis.get_view_interval())
    short = high / low < 200
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if short else (1.0,), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}" if value >= 10_000 else f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _moments(axes: Axes, moments: Mapping[str, float]) -> None:
    """Vertical lines with their words above the axes, on two lines where they are near each other."""
    low, high = axes.get_xlim()
    raised, ever, before = False, False, -math.inf
    for text, x in sorted(moments.items(), key=lambda item: item[1]):
        axes.axvline(x, color="black", linestyle=DASHES, linewidth=1)
        raised = not raised and (x - before) < 0.2 * (high - low)
        before, ever = x, ever or raised
        say(axes, text, (x, 1), ("data", "axes fraction"), (0, 12 if raised else 2), "center")
    if moments:
        axes.set_title(axes.get_title(loc="left"), loc="left", pad=26 if ever else 15)


def say(
    axes: Axes,
    text: str,
    at: tuple[float, float],
    scales: tuple[str, str],
    shift: tuple[float, float],
    side: Literal["left", "center", "right"],
    colour: str = QUIET,
) -> None:
    """Write a few words, ``shift`` points away from a place that is given in these scales."""
    axes.annotate(
        text,
        at,
        shift,
        xycoords=scales,
        textcoords="offset points",
        ha=side,
        va="bottom",
        fontsize=8,
        color=colour,
    )


def _distribution(axes: Axes, series: Sequence[Series], looks: Mapping[str, Look]) -> None:
    """How often which y, in classes that all series share; the axis is the panel's."""
    axes.grid(visible=False)
    axes.tick_params(labelleft=False, left=False, labelbottom=False, bottom=False)
    for side in ("top", "right", "bottom"):
        axes.spines[side].set_visible(False)
    low, high = axes.get_ylim()
    step = (high - low) / _CLASSES
    edges = [low + step * i for i in range(_CLASSES + 1)]
    for one in series:
        if not len(one.y):
            continue
        look = looks[one.label]
        axes.hist(one.y, edges, histtype="stepfilled", alpha=0.35, color=look.colour, orientation="horizontal")
        axes.hist(one.y, edges, histtype="step", color=look.colour, orientation="horizontal")
