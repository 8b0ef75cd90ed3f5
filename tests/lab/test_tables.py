"""What is said of a measurement: verdicts only where the samples say it, numbers."""

from __future__ import annotations

import io
import json
from typing import TYPE_CHECKING

import pytest
from rich.console import Console

from lab import results
from lab.findings import Claim
from lab.tables import dash, size, us

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("value", "at_least", "reached"),
    [(0.9, False, True), (1.1, False, False), (1.1, True, True), (0.9, True, False), (None, False, None)],
)
def test_a_claim_is_reached_missed_or_unknown(value: float | None, at_least: bool, reached: bool | None) -> None:
    assert Claim("x", value, 1.0, at_least=at_least).reached is reached


def test_a_measurement_ends_with_verdicts_and_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "RESULTS", tmp_path / "results")
    out = io.StringIO()
    claims = [Claim("p99", 2.0, 1.0), Claim("share", None, 0.9, at_least=True)]
    console = Console(file=out, width=200)
    results.finish(console, "short", {"hz": 1}, {"rows": []}, tmp_path / "copy", claims=claims)
    assert "p99: 2.00 (to reach: ≤ 1): not reached" in out.getvalue()
    assert "share: - (to reach: ≥ 0.9): too few samples to say" in out.getvalue()
    document = json.loads((tmp_path / "copy").read_text())
    assert [row["reached"] for row in document["result"]["targets"]] == [False, None]
    assert (document["measurement"], document["settings"]) == ("short", {"hz": 1})
    assert sorted(path.suffix for path in (tmp_path / "results").iterdir()) == [".json"]


def test_numbers_as_text() -> None:
    assert [us(None), us(12.34), us(1234.5), dash(None), dash(0.954)] == ["-", "12.3", "1234", "-", "0.95"]
    assert [size(64), size(64 * 1024), size(1024 * 1024)] == ["64 B", "64 KB", "1 MB"]
