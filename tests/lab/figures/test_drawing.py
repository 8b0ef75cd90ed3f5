"""Figures: every style draws without a warning, samples are shown as they are, systems look the same everywhere."""

from __future__ import annotations

import struct
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
    from pathlib import Path

    from matplotlib.axes import Axes

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


@pytest.mark.parametrize(("count", "p99"), [(999, False), (1000, True)])
def test_a_box_shows_no_percentile_that_its_samples_do_not_carry(count: int, p99: bool) -> None:
    (drawn,) = _drawn(Panel("", "Hz", "µs", (Series("a", [10] * count, [float(i) for i in range(count)], "box"),)))
    lines: list[Any] = [*drawn.axes.lines]
    shown = {float(y) for line in lines if line.get_marker() == "_" for y in line.get_ydata()}
    assert shown == ({989.0} if p99 else set())
