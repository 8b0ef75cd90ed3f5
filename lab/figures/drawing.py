"""Figures as files: panels in rows, the legend below, and beside them how late the host woke up meanwhile.

matplotlib is loaded when something is drawn. The same data gives the same bytes.
"""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any, Final

from lab.figures import panels
from lab.figures.colours import looks
from lab.samples import percentile

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas
    from matplotlib.gridspec import GridSpec
    from matplotlib.legend import Legend

    from lab.figures.panels import Drawn
    from lab.findings import Figure, Panel

# Inches; shown 830 pixels wide, as on a project's page, a letter of 9 points is 11 pixels high.
_WIDTH: Final = 9.6
# Letters of a title in one line.
_LINE: Final = 105
# Labels that the legend of a whole figure holds where its panels differ in them.
_LEGEND: Final = 4
# How many times as large the values of one panel may be that shares its axis with another.
_FOOT: Final = 8.0
_STYLE: Final[dict[Any, Any]] = {  # keys of matplotlib's own type, which differs between its versions
    "font.family": "DejaVu Sans",  # matplotlib brings it along
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.labelsize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "svg.hashsalt": "rmpa",
    "svg.fonttype": "path",
    "path.simplify": True,
    "hatch.linewidth": 0.6,
}


def draw(figure: Figure, lateness: Sequence[float], directory: Path) -> tuple[Path, Path]:
    """Draw a figure into two files.

    Args:
        figure: What.
        lateness: How late the host woke up before and after what is shown was measured, µs; may be empty.
        directory: Where; it exists.

    Returns:
        The PNG and the SVG.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    png, svg = directory / f"{figure.name}.png", directory / f"{figure.name}.svg"
    with mpl.rc_context(_STYLE):
        columns = figure.columns or _columns(len(figure.panels))
        rows = [figure.panels[at : at + columns] for at in range(0, len(figure.panels), columns)]
        heights = [max(_height(panel, len(rows)) for panel in row) for row in rows]
        title = textwrap.fill(figure.title, _LINE)
        canvas = Canvas(figsize=(_WIDTH, sum(heights) + 0.55 + 0.2 * title.count("\n")), layout="constrained")
        FigureCanvasAgg(canvas)
        canvas.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold")
        widths = [1.0] * columns + ([0.16 * columns] if lateness else [])
        grid = canvas.add_gridspec(len(rows), len(widths), width_ratios=widths, height_ratios=heights)
        _panels(canvas, grid, figure, rows)
        if lateness:
            _lateness(canvas.add_subplot(grid[:, -1]), lateness)
        canvas.savefig(png, dpi=160, metadata={"Software": None})
        canvas.savefig(svg, dpi=160, metadata={"Date": None, "Creator": None})
    return png, svg


def _columns(count: int) -> int:
    return count if count <= 3 else 2 if count == 4 else 3


def _height(panel: Panel, rows: int) -> float:
    if panel.names:
        return 1.0 + 0.3 * len(panel.names)
    return {1: 3.3, 2: 2.6}.get(rows, 1.9)


def _panels(canvas: Canvas, grid: GridSpec, figure: Figure, rows: Sequence[Sequence[Panel]]) -> None:
    apart = _legends_apart(figure.panels, rows)
    look = looks(series for panel in figure.panels for series in panel.series)
    above: dict[int, Drawn] = {}
    found: dict[str, Artist] = {}
    for number, row in enumerate(rows):
        together: list[list[Drawn]] = []
        for column, panel in enumerate(row):
            upper = above.get(column)
            upper = upper if upper and _same_x(upper.panel, panel) else None
            left = together[-1] if together and _same_y(together[-1][0].panel, panel) else []
            axes = canvas.add_subplot(
                grid[number, column], sharex=upper and upper.axes, sharey=left[0].axes if left else None
            )
            drawn = panels.draw(axes, panel, looks(panel.series) if apart else look, _LINE // len(row))
            if upper is not None:
                upper.axes.set_xlabel("")
                upper.axes.tick_params(labelbottom=False)
            if left:
                axes.set_ylabel("")
                left.append(drawn)
            else:
                together.append([drawn])
            above[column] = drawn
            handles: dict[str, Artist] = {}
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                handles.setdefault(label, handle)  # of a line through points with its label, the points
            if apart:
                _clear(axes.legend(handles.values(), handles, loc="upper left", bbox_to_anchor=(-0.05, -0.16)))
            found |= {label: handle for label, handle in handles.items() if label not in found}
        for drawns in together:
            panels.settle(drawns)
    if len(found) > 1 and not apart:
        columns = max(1, min(4, _LINE // (6 + max(map(len, found)))))
        _clear(canvas.legend(list(found.values()), list(found), loc="outside lower left", ncols=columns))


def _legends_apart(shown: Sequence[Panel], rows: Sequence[Sequence[Panel]]) -> bool:
    """Whether each panel has a legend of its own below it: they say different things, and too many for one."""
    labels = [frozenset(series.label for series in panel.series if len(series.y)) for panel in shown]
    return len(rows) == 1 and len(set(labels)) > 1 and len(frozenset().union(*labels)) > _LEGEND


def _clear(legend: Legend) -> None:
    """Show points in a legend as large as one can see them."""
    for line in legend.get_lines():
        line.set_markersize(5)
        line.set_alpha(1)


def _same_x(upper: Panel, lower: Panel) -> bool:
    return (upper.xlabel, upper.logx, upper.ticks) == (lower.xlabel, lower.logx, lower.ticks)


def _same_y(left: Panel, right: Panel) -> bool:
    """Whether both may share an axis: the same quantity, and values of a similar size."""
    if (left.ylabel, left.logy, left.names) != (right.ylabel, right.logy, right.names):
        return False
    tops = [max((y for series in panel.series for y in series.y), default=0.0) for panel in (left, right)]
    return left.logy or max(tops) <= _FOOT * min(tops)


def _lateness(axes: Axes, late: Sequence[float]) -> None:
    """Draw the noise of the host: how late its scheduler lets a sleeping process run."""
    ordered = sorted(max(1.0, one) for one in late)
    edges = [10 ** (step / 10) for step in range(60)]  # 1 µs to 1 s
    axes.hist(ordered, bins=edges, orientation="horizontal", color="#C8C8C8")
    axes.set_yscale("log")
    axes.set_xscale("log")
    axes.set_xlim(left=0.7)
    axes.set_ylim(ordered[0] / 1.5, max(1000.0, ordered[-1] * 1.6))
    axes.yaxis.tick_right()
    axes.yaxis.set_label_position("right")
    panels.log_numbers(axes.yaxis)
    most = axes.get_xlim()[1]
    steps = (1, 10, 100) if most < 2000 else (1, 100, 10_000, 1_000_000)
    axes.set_xticks([step for step in steps if step < most], [f"{step:,}" for step in steps if step < most])
    axes.xaxis.set_minor_formatter("")
    axes.set_ylabel("sleeps of 1 ms ended late by, µs", fontsize=8)
    axes.set_xlabel("times", fontsize=8)
    axes.tick_params(labelsize=7.5)
    axes.spines["right"].set_visible(True)
    axes.spines["left"].set_visible(False)
    axes.set_title("noise of the host", loc="left", fontsize=8.5)
    for text, percent, above in (("p50", 50.0, True), ("p99", 99.0, False), ("max", 100.0, True)):
        value = percentile(ordered, percent)
        axes.axhline(value, color=panels.QUIET, linewidth=0.8, linestyle=panels.DASHES)
        shown = f"{value:.0f} µs" if value < 1000 else f"{value / 1000:.3g} ms"
        shift = (-2, 1 if above else -10)
        panels.say(axes, f"{text} {shown}", (1, value), ("axes fraction", "data"), shift, "right")
