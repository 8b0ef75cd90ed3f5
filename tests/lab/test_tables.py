"""What was to be reached is called so only where the samples say it."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import pytest
from rich.console import Console

from lab import plot
from lab.tables import Target, dash, ratio, show_targets, size, us

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("value", "at_least", "reached"),
    [(0.9, False, True), (1.1, False, False), (1.1, True, True), (0.9, True, False), (None, False, None)],
)
def test_a_target_is_reached_missed_or_unknown(value: float | None, at_least: bool, reached: bool | None) -> None:
    assert Target("x", value, 1.0, at_least=at_least).reached is reached


def test_targets_are_printed_and_kept() -> None:
    out = io.StringIO()
    rows = show_targets(
        Console(file=out, width=200), [Target("p99", 2.0, 1.0), Target("share", None, 0.9, at_least=True)]
    )
    assert [row["reached"] for row in rows] == [False, None]
    assert "p99: 2.00 (to reach: ≤ 1): not reached" in out.getvalue()
    assert "share: - (to reach: ≥ 0.9): too few samples to say" in out.getvalue()


def test_there_is_no_ratio_without_both() -> None:
    assert [ratio(3.0, 2.0), ratio(None, 2.0), ratio(1.0, None), ratio(1.0, 0.0)] == [1.5, None, None, None]


def test_numbers_as_text() -> None:
    assert [us(None), us(12.34), us(1234.5), dash(None), dash(0.954)] == ["-", "12.3", "1234", "-", "0.95"]
    assert [size(64), size(64 * 1024), size(1024 * 1024)] == ["64 B", "64 KB", "1 MB"]


def test_pictures_are_drawn_from_few_samples_and_from_none(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    panels = {"one": {"a": [float(n) for n in range(1, 2000)], "b": []}, "two": {"a": [1.0, 2.0]}}
    for number, draw in enumerate((plot.shares, plot.tails)):
        image = tmp_path / f"{number}.png"
        assert draw(image, panels, "µs")
        assert image.stat().st_size > 1000
