"""Two runs side by side: figures matched by what they say, and all that differs in how they were measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from lab.bed.plan import Plan
from lab.experiments.report.compare import ComparedClaim, Difference, compare
from tests.lab.experiments.report.runs import MACHINE, Known, make_run

if TYPE_CHECKING:
    from pathlib import Path


def test_figures_stand_side_by_side_with_their_ratio(tmp_path: Path) -> None:
    found = compare(make_run(tmp_path / "a", largest=3.0), make_run(tmp_path / "b", largest=4.5), Known())
    assert found.differences == ()
    assert found.claims == (
        ComparedClaim("rates", "largest of RMPA / classic", "", 2.0, 3.0, 1.5),
        ComparedClaim("rates", "R² of the fit", "", None, None, None),
        ComparedClaim("rates", "largest of RMPA", "ms", 3.0, 4.5, 1.5),
    )
    assert msgspec.json.decode(msgspec.json.encode(found))["claims"][2]["b"] == 4.5


def test_what_differs_in_how_they_were_measured_is_named(tmp_path: Path) -> None:
    a = make_run(tmp_path / "a")
    b = make_run(
        tmp_path / "b",
        plan=Plan(link="", seed=2),
        names=("rmpa",),
        machine={**MACHINE, "kernel": "6.8", "load": [9.0]},
    )
    assert compare(a, b, Known()).differences == (
        Difference("plan: link", "100mbit", ""),
        Difference("plan: seed", "1", "2"),
        Difference("machine: kernel", "6.1", "6.8"),
        Difference("rates: cells measured", "2", "1"),
    )
