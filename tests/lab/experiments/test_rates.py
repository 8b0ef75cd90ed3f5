"""Latencies made by hand, whose percentiles are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.contenders import DIRECT, contender_of
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


def test_the_full_run_has_the_papers_batches_and_ten_thousand_beyond() -> None:
    from lab.experiments.rates import _COUNTS, _ROUNDS

    totals = {rate: count * _ROUNDS["full"] for rate, count in _COUNTS["full"].items()}
    assert all(_COUNTS["full"][rate] == 100 for rate in PAPER)
    assert totals[500] == totals[1000] == 10_000
    assert totals[100] >= 1000  # enough for a p99


@pytest.mark.parametrize(("step", "value", "reached"), [(1, 1.0, True), (2, 2.0, False)])
def test_widening_is_that_of_rmpa_at_1_khz_against_the_papers_rates(step: int, value: float, reached: bool) -> None:
    def measure(cell: Cell) -> Measured:
        if cell.settings["system"] == "classic":
            return made(LADDER, ramp(3))
        return made(LADDER, lambda rate, number: ramp(step if rate == 1000 else 1)(rate, number))

    claim = EXPERIMENT.findings(run(FULL, measure)).claims[0]
    assert claim.value == pytest.approx(value)
    assert claim.reached is reached


def test_too_few_messages_say_nothing_of_the_width() -> None:
    few = dict.fromkeys((*PAPER, 1000), 50)  # in two rounds 100, and p95 needs 200
    claim = EXPERIMENT.findings(run(FULL, lambda _: made(few, ramp(1)))).claims[0]
    assert claim.reached is None


def test_the_direct_transport_is_held_against_classic_ros_at_1_khz() -> None:
    counts = {**LADDER, 1000: 500}  # in two rounds 1000, which p99 needs

    def measure(cell: Cell) -> Measured:
        slower = 20 if contender_of(cell) == DIRECT else 0
        return made(counts, lambda rate, number: ramp(2)(rate, number) + slower)

    claims = {one.text: one for one in EXPERIMENT.findings(run(FULL, measure)).claims}
    p50, p99 = (claims[f"{name} at 1 kHz, roscpp: RMPA direct / classic"] for name in ("p50", "p99"))
    assert [p50.value, p99.value] == pytest.approx([320 / 300, 418 / 398])
    assert (p50.reached, p99.reached) == (False, True)
    assert claims["p95 less p50 at 1 kHz, roscpp: RMPA direct / classic"].value == pytest.approx(1.0)
    old = Results(FULL, [one for one in run(FULL, measure).cells if contender_of(one[0]) != DIRECT])
    assert not [one.text for one in EXPERIMENT.findings(old).claims if "direct" in one.text]
