"""Latencies made by hand on a known line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.model import Cell, Measured, Results
from lab.experiments.payload import EXPERIMENT, SIZES, UNSHAPED, steps
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


# --- what is planned ------------------------------------------------------------------------------------------------


def test_no_size_asks_more_of_the_link_than_it_carries() -> None:
    for size, (rate, _) in steps(FULL, "100mbit", 100).items():
        assert rate <= 400.0
        assert 8 * size * rate <= 0.7 * 100e6


def test_the_plans_link_comes_first_and_none_is_beside_it() -> None:
    assert [(cell.settings["link"], cell.settings["batch"]) for cell in EXPERIMENT.cells(FULL)][::3] == [
        ("100mbit", 100),
        ("100mbit", 1000),
        (UNSHAPED, 100),
    ]
    assert {cell.settings["link"] for cell in EXPERIMENT.cells(Plan(link=""))} == {UNSHAPED}


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


def test_the_direct_transport_is_held_against_classic_ros_where_the_wire_hides_nothing() -> None:
    def measure(cell: Cell) -> Measured:
        slower = 1.1 if cell.settings.get("transport") == "direct" else 1.0
        return made(lambda kb, number: slower * straight(kb, number))

    claims = [one for one in EXPERIMENT.findings(run(FULL, measure)).claims if "direct" in one.text]
    assert ["64 KB" in one.text for one in claims] == [True, False]
    assert all("not shaped" in one.text for one in claims)
    assert [one.value for one in claims] == pytest.approx([1.1, 1.1])
    assert not any(one.reached for one in claims)


def test_a_bend_is_seen() -> None:
    found = EXPERIMENT.findings(run(FULL, lambda _: made(lambda kb, _number: 500.0 + 0.08 * kb * kb)))
    assert {claim.reached for claim in found.claims if "R²" in claim.text} == {False}


def test_one_late_message_is_in_all_samples_and_not_in_the_medians() -> None:
    def late(kb: int, number: int) -> float:
        return straight(kb, number) + (2e6 if number == 3 and kb == 1 else 0.0)

    claims = EXPERIMENT.findings(run(FULL, lambda _: made(late))).claims
    reached = {claim.text.rpartition(" ")[2]: claim.reached for claim in claims if "R²" in claim.text}
    assert reached == {"medians": True, "samples": False}
