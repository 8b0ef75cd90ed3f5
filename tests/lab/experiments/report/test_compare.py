"""Two runs side by side: figures matched by what they say, and all that differs in how they were measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import pytest

from lab.bed.plan import Plan
from lab.experiments.report.compare import ComparedClaim, Difference, compare
from rmpa.core.errors import ConfigError
from tests.lab.experiments.report.runs import MACHINE, Known, Latencies, make_run

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


def test_an_experiment_that_only_one_run_has(tmp_path: Path) -> None:
    known = Known({"rates": Latencies(), "payload": Latencies("payload")})
    found = compare(make_run(tmp_path / "a"), make_run(tmp_path / "b", experiment="payload"), known)
    assert [(one.experiment, one.a, one.b) for one in found.claims if one.unit] == [
        ("rates", 3.0, None),
        ("payload", None, 3.0),
    ]
    assert Difference("rates: cells measured", "2", "") in found.differences


def test_findings_that_fail_are_a_difference(tmp_path: Path) -> None:
    a, b = make_run(tmp_path / "a"), make_run(tmp_path / "b")
    (b / "rates" / "system-rmpa_round-1" / "arrivals.csv").unlink()
    found = compare(a, b, Known())
    assert [one.what for one in found.differences] == ["rates: cells measured", "rates: no findings"]
    assert found.claims[0].b is None


def test_what_is_no_run_directory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        compare(make_run(tmp_path / "a"), tmp_path / "b", Known())
