"""Experiment 6: what is planned, and what follows from samples whose answers are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.images import EXPERIMENT
from lab.experiments.model import Cell, Measured, Results, Value
from lab.frames import frame

if TYPE_CHECKING:
    from lab.findings import Claim, Findings

MB = 1024 * 1024
PERIOD = 10_000_000


def cell(system: str, turn: int = 1, client: str = "roscpp", **more: Value) -> Cell:
    return Cell("images", {"system": system, **more, "client": client, "nodelay": True, "round": turn})


def measured(beside_ms: list[float], *, link: str = "100mbit", image_ms: float = 90.0) -> Measured:
    """Commands alone after 0.1 ms, beside images as given, and images at even distances."""
    commands = [("alone", n, n * PERIOD, n * PERIOD + 100_000) for n in range(500)]
    commands += [("images", n, n * PERIOD, n * PERIOD + int(ms * 1e6)) for n, ms in enumerate(beside_ms)]
    count = int(len(beside_ms) * 10 / image_ms)
    pictures = [(n, int(n * image_ms * 1e6), int((n + 2) * image_ms * 1e6)) for n in range(count)]
    tables = {
        "commands": frame(("beside", "sequence", "due_ns", "came_ns"), commands),
        "images": frame(("sequence", "due_ns", "came_ns"), pictures),
    }
    return Measured(tables, {"link": link, "alone": 500, "beside": len(beside_ms) + 3, "images": count + 7})


def findings(*cells: tuple[Cell, Measured]) -> Findings:
    return EXPERIMENT.findings(Results(Plan(), cells))


def claims(*cells: tuple[Cell, Measured]) -> dict[str, Claim]:
    return {claim.text: claim for claim in findings(*cells).claims}


def test_the_claims_hold_a_percentile_of_all_rounds() -> None:
    fast = [0.5] * 985 + [0.9] * 15
    slow = [5.0] * 985 + [20.0] * 15
    found = claims(
        *((cell("classic", turn), measured(slow)) for turn in (1, 2)),
        *((cell("rmpa", turn), measured(fast)) for turn in (1, 2)),
    )
    assert found["commands beside images, p99, RMPA, roscpp"].value == pytest.approx(0.9)
    assert found["commands beside images, p99, classic, roscpp"].value == pytest.approx(20.0)
    assert found["images' share of the cable, RMPA, roscpp"].value == pytest.approx(8 * MB / 0.09 / 1e8, rel=1e-3)
    assert all(claim.reached for claim in found.values())
