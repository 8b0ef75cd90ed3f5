"""Latencies made by hand, whose percentiles are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.model import Cell, Measured, Results
from lab.experiments.rates import EXPERIMENT, PAPER
from lab.frames import frame

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


FULL = Plan(clients=("roscpp",))
US = 1000


def made(counts: Mapping[int, int], latency_us: Callable[[int, int], int]) -> Measured:
    """As many messages of each rate; each comes so many µs after it was due, by rate and number."""
    came = [
        (rate, n, n * US, n * US + latency_us(rate, n) * US) for rate, count in counts.items() for n in range(count)
    ]
    sent = [(rate, n, 0) for rate, count in counts.items() for n in range(count)]
    return Measured(
        {
            "arrivals": frame(("rate", "sequence", "due_ns", "came_ns"), came),
            "sent": frame(("rate", "sequence", "late_ns"), sent),
        }
    )


def run(plan: Plan, measure: Callable[[Cell], Measured]) -> Results:
    return Results(plan, [(cell, measure(cell)) for cell in EXPERIMENT.cells(plan)])


def ramp(step_us: int) -> Callable[[int, int], int]:
    """1 to 100 steps above 200 µs, over and over: p50 is 50 steps above, p95 is 95, so the width is 45."""
    return lambda _rate, number: 200 + (number % 100 + 1) * step_us


LADDER = dict.fromkeys((*PAPER, 100, 1000), 200)


@pytest.mark.parametrize(("step", "value", "reached"), [(1, 1.0, True), (2, 2.0, False)])
def test_widening_is_that_of_rmpa_at_1_khz_against_the_papers_rates(step: int, value: float, reached: bool) -> None:
    def measure(cell: Cell) -> Measured:
        if cell.settings["system"] == "classic":
            return made(LADDER, ramp(3))
        return made(LADDER, lambda rate, number: ramp(step if rate == 1000 else 1)(rate, number))

    claim = EXPERIMENT.findings(run(FULL, measure)).claims[0]
    assert claim.value == pytest.approx(value)
    assert claim.reached is reached
