"""Latencies made by hand on a known line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.model import Cell, Measured, Results
from lab.experiments.payload import EXPERIMENT, SIZES
from lab.frames import frame

if TYPE_CHECKING:
    from collections.abc import Callable

FULL = Plan(clients=("roscpp",))
KB = 1024


def made(latency_us: Callable[[int, int], float], count: int = 20) -> Measured:
    """As many messages of each size; each comes so many µs after it was due, by KB and number."""
    came = [(size, n, 0, round(latency_us(size // KB, n) * 1000)) for size in SIZES["full"] for n in range(count)]
    sent = [(size, n, 0) for size in SIZES["full"] for n in range(count)]
    return Measured(
        {
            "arrivals": frame(("size", "sequence", "due_ns", "came_ns"), came),
            "sent": frame(("size", "sequence", "late_ns"), sent),
        }
    )


def straight(kb: int, _number: int) -> float:
    return 500.0 + 80.0 * kb


def run(plan: Plan, measure: Callable[[Cell], Measured]) -> Results:
    return Results(plan, [(cell, measure(cell)) for cell in EXPERIMENT.cells(plan)])


# --- findings -------------------------------------------------------------------------------------------------------


def test_a_line_is_found_as_it_was_made() -> None:
    found = EXPERIMENT.findings(run(FULL, lambda _: made(straight)))
    # Two batches, through medians and all samples; on the unshaped link two sizes of the direct transport.
    assert len(found.claims) == 4 + 2
    assert [claim.value for claim in found.claims] == pytest.approx([1.0] * 6)
    assert all(claim.reached for claim in found.claims)
    lines = found.grids[-1]
    assert {row[5:] for row in lines.rows} == {("0.5", "80", "102", "1.00000")}
    assert len(lines.rows) == 3 * 2 * 3
