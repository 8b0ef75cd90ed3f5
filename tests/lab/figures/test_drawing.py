"""Figures: every style draws without a warning, samples are shown as they are, systems look the same everywhere."""

from __future__ import annotations

import struct
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from lab.figures.colours import looks, shade
from lab.findings import Figure, Panel, Series

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure as Canvas

from lab.figures import panels
from lab.figures.drawing import draw
from lab.figures.panels import Drawn, settle, thinned

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.legend import Legend

LATE = [60.0, 70.0, 900.0] * 40
UP = [1.0, 2.0, 4.0, 8.0]
PANELS = {
    "points": Panel("points", "x", "y", (Series("a", UP, UP, "points", "rmpa"),), distribution=True),
    "line": Panel("line", "x", "y", (Series("a", UP, UP, "line", "rmpa"),), marks={"to reach": 20.0}, logx=True),
    "steps": Panel("steps", "x", "y", (Series("a", UP, UP, "steps", "classic"),), logy=True, moments={"1 ms": 3.0}),
    "bars": Panel("bars", "x", "y", (Series("a", UP, UP, "bars"), Series("b", UP, UP, "bars")), ticks={"one": 1.0}),
    "box": Panel("box", "x", "y", (Series("a", UP * 300, [*range(1200)], "box", "rmpa"),)),
    "boxes on a logarithmic axis": Panel("box", "x", "y", (Series("a", UP * 3, UP * 3, "box"),), logx=True),
    "boxes with a line": Panel("box", "x", "y", (Series("a", UP, UP, "box"), Series("b", [1, 9], [1, 9], "line"))),
    "spans": Panel("spans", "x", "", (Series("a", [0, 5, 7, 9], [0, 0, 1, 1], "spans"),), names=("CMD", "VEL")),
    "nothing": Panel("nothing", "x", "y", (Series("a", [], [], "box"), Series("b", [], [], "points"))),
    "one value": Panel("one", "x", "y", (Series("a", UP, [5.0] * 4, "points"),), distribution=True),
}


@pytest.mark.parametrize("name", PANELS)
def test_every_style_is_drawn_into_both_files(tmp_path: Path, name: str) -> None:
    figure = Figure("fig", "A title " * 30, "", (PANELS[name],))
    png, svg = draw(figure, [], tmp_path)
    head = png.read_bytes()[:24]
    assert head.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", head[16:24])
    assert width == 1536
    assert 400 < height < 1200
    assert "</svg>" in svg.read_text(encoding="utf-8")


@pytest.mark.parametrize("columns", [0, 2])
def test_panels_of_every_style_stand_in_rows(tmp_path: Path, columns: int) -> None:
    png, _ = draw(Figure("fig", "all", "", tuple(PANELS.values())[:5], columns), LATE, tmp_path)
    assert struct.unpack(">II", png.read_bytes()[16:24])[1] > 160 * 2 * 1.9


def test_the_same_data_gives_the_same_bytes(tmp_path: Path) -> None:
    figure = Figure("fig", "two", "", (PANELS["box"], PANELS["points"]))
    (tmp_path / "again").mkdir()
    first, second = draw(figure, LATE, tmp_path), draw(figure, LATE, tmp_path / "again")
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_a_system_has_one_colour_and_its_variants_shades_of_it() -> None:
    series = [
        Series("RMPA, rospy", [], [], system="rmpa"),
        Series("classic", [], [], system="classic"),
        Series("RMPA, rospy", [], [], "line", "rmpa"),
        Series("RMPA, roscpp", [], [], system="rmpa"),
        Series("raw", [], []),
    ]
    found = looks(series)
    assert list(found) == ["RMPA, rospy", "classic", "RMPA, roscpp", "raw"]
    assert looks(series[3:4])["RMPA, roscpp"].colour == found["RMPA, rospy"].colour  # the first in its figure
    assert found["RMPA, roscpp"].colour == shade(found["RMPA, rospy"].colour, 0.4)
    assert len({(one.colour, one.line) for one in found.values()}) == 4


def test_shades() -> None:
    assert (shade("#804020", 0.0), shade("#804020", 1.0), shade("#804020", -1.0)) == ("#804020", "#FFFFFF", "#000000")
    assert shade("#0000FF", 0.5) == "#8080FF"


def test_thinned_points_keep_the_outermost_and_their_order() -> None:
    pairs = [(float(i), float(i * 7919 % 50_000)) for i in range(50_000)]
    kept = thinned(pairs, 1000)
    assert 900 <= len(kept) <= 1000
    assert kept == sorted(kept)
    by_size = sorted(pairs, key=lambda pair: pair[1])
    assert {*by_size[:100], *by_size[-100:]} <= set(kept)
    assert thinned(pairs[:1000], 1000) == pairs[:1000]


def _drawn(*shown: Panel) -> list[Drawn]:
    canvas = Canvas()
    look = looks(series for panel in shown for series in panel.series)
    first: Axes | None = None
    found = []
    for at, panel in enumerate(shown):
        axes = canvas.add_subplot(1, len(shown), at + 1, sharey=first)
        first = first or axes
        found.append(panels.draw(axes, panel, look))
    settle(found)
    return found


def _texts(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def test_panels_that_share_an_axis_have_room_for_the_values_of_all() -> None:
    left = Panel("", "", "ms", (Series("a", UP, [1.0, 1.1, 1.2, 1.0], system="classic"),))
    right = Panel("", "", "ms", (Series("b", UP, [2.0, 2.1, 2.2, 2.0], system="rmpa"),))
    for drawn in _drawn(left, right):
        low, high = drawn.axes.get_ylim()
        assert low <= 1.0
        assert high >= 2.2


def test_values_that_would_flatten_the_others_are_named_only() -> None:
    values = [100.0 + i % 10 / 10 for i in range(200)] + [900.0, 950.0, 3.0]
    (drawn,) = _drawn(Panel("", "", "ms", (Series("a", [*range(203)], values),), distribution=True))
    low, high = drawn.axes.get_ylim()
    assert 95 < low < 100
    assert 101 < high < 105
    assert _texts(drawn.axes) == ["2 beyond, up to 950 ▲", "1 beyond, down to 3 ▼"]
    assert {text.get_color() for text in drawn.axes.texts} == {drawn.looks["a"].colour}


def test_rows_of_a_timeline_run_from_the_top_down() -> None:
    (drawn,) = _drawn(PANELS["spans"])
    low, high = drawn.axes.get_ylim()
    assert low > high
    assert [label.get_text() for label in drawn.axes.get_yticklabels()] == ["CMD", "VEL"]
    bars: list[Any] = [bar for bars in drawn.axes.containers for bar in bars]
    assert [(bar.get_x(), bar.get_width(), bar.get_y() + bar.get_height() / 2) for bar in bars] == [
        (0, 5, pytest.approx(0)),
        (7, 2, pytest.approx(1)),
    ]


def test_moments_and_marks_are_named() -> None:
    panel = Panel(
        "",
        "s",
        "ms",
        (Series("a", [0, 10], [1, 2], "line"),),
        marks={"limit": 50.0},
        moments={"killed": 4.0, "up": 4.2},
    )
    (drawn,) = _drawn(panel)
    assert _texts(drawn.axes) == ["limit", "killed", "up"]
    assert drawn.axes.get_ylim()[1] > 50  # the mark is to be seen


def test_boxes_stand_equally_far_apart_with_their_groups_below() -> None:
    panel = Panel("", "Hz", "µs", (Series("a", [10, 50, 1000] * 5, [1.0] * 15, "box"),))
    (drawn,) = _drawn(panel)
    assert [label.get_text() for label in drawn.axes.get_xticklabels()] == ["10", "50", "1000"]
    assert list(drawn.axes.get_xticks()) == [0, 1, 2]


@pytest.mark.parametrize(("count", "p99"), [(999, False), (1000, True)])
def test_a_box_shows_no_percentile_that_its_samples_do_not_carry(count: int, p99: bool) -> None:
    (drawn,) = _drawn(Panel("", "Hz", "µs", (Series("a", [10] * count, [float(i) for i in range(count)], "box"),)))
    lines: list[Any] = [*drawn.axes.lines]
    shown = {float(y) for line in lines if line.get_marker() == "_" for y in line.get_ydata()}
    assert shown == ({989.0} if p99 else set())


def test_whole_numbers_stay_whole() -> None:
    (drawn,) = _drawn(Panel("", "message", "ms", (Series("a", [0, 1, 2, 3], UP),)))
    assert all(float(tick).is_integer() for tick in drawn.axes.get_xticks())


def test_panels_that_say_different_things_have_legends_of_their_own(tmp_path: Path) -> None:
    def panel(*labels: str) -> Panel:
        return Panel("", "x", "y", tuple(Series(label, UP, UP, "line", "rmpa") for label in labels))

    figure = Figure("fig", "", "", (panel("a", "b", "c"), panel("d", "e", "f")))
    with _kept_canvas() as canvases:
        draw(figure, LATE, tmp_path)
        draw(replace(figure, panels=(panel("a", "b"), panel("b"))), LATE, tmp_path)
    apart, together = canvases
    assert [_said(axes.get_legend()) for axes in apart.axes] == [["a", "b", "c"], ["d", "e", "f"], []]
    assert apart.legends == []
    assert [_said(legend) for legend in together.legends] == [["a", "b"]]


def test_a_line_through_labelled_points_has_one_legend_entry(tmp_path: Path) -> None:
    points, fit = Series("a", UP, UP, "points", "rmpa"), Series("a", [1, 8], [1, 8], "line", "rmpa")
    other = Series("b", UP, UP, "line", "classic")
    with _kept_canvas() as canvases:
        draw(Figure("fig", "", "", (Panel("", "x", "y", (points, fit, other)),)), [], tmp_path)
    (legend,) = canvases[0].legends
    assert _said(legend) == ["a", "b"]
    assert [line.get_linestyle() for line in legend.get_lines()] == ["None", "-"]


def _said(legend: Legend | None) -> list[str]:
    return [text.get_text() for text in legend.get_texts()] if legend else []


@contextmanager
def _kept_canvas() -> Iterator[list[Canvas]]:
    """What is drawn meanwhile, to be looked at."""
    kept: list[Canvas] = []

    class Kept(Canvas):
        def savefig(self, *args: Any, **words: Any) -> None:
            if self not in kept:
                kept.append(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("matplotlib.figure.Figure", Kept)
        yield kept
