"""Latencies made by hand on a known line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.model import Cell, Measured, Results
from lab.experiments.payload import EXPERIMENT, SIZES, UNSHAPED, bits_per_second, name, steps
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


def test_sizes_double_from_1_kb_to_1_mb() -> None:
    assert (SIZES["full"][0], SIZES["full"][-1]) == (KB, KB * KB)
    assert all(b == 2 * a for a, b in zip(SIZES["full"], SIZES["full"][1:], strict=False))
    assert [name(size) for size in SIZES["full"]][::5] == ["1 KB", "32 KB", "1 MB"]


@pytest.mark.parametrize(
    ("link", "bits"), [("100mbit", 1e8), ("1gbit", 1e9), ("500Kbit", 5e5), ("2.5mbit", 2.5e6), ("800bit", 800)]
)
def test_links_are_written_as_tc_has_them(link: str, bits: float) -> None:
    assert bits_per_second(link) == bits


@pytest.mark.parametrize("link", ["", "100", "fast", "mbit"])
def test_other_links_are_refused(link: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        bits_per_second(link)


def test_no_size_asks_more_of_the_link_than_it_carries() -> None:
    for size, (rate, _) in steps(FULL, "100mbit", 100).items():
        assert rate <= 400.0
        assert 8 * size * rate <= 0.7 * 100e6


def test_only_batches_of_a_thousand_are_cut_short() -> None:
    assert {count for _, count in steps(FULL, "100mbit", 100).values()} == {100}
    long = {size: count for size, (_, count) in steps(FULL, "100mbit", 1000).items()}
    assert long[KB] == 1000
    assert long[KB * KB] == 100
    assert sorted(long.values(), reverse=True) == list(long.values())


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


def test_only_rmpas_line_is_claimed() -> None:
    def measure(cell: Cell) -> Measured:
        bent = cell.settings["system"] == "classic"
        return made(lambda kb, number: 5000.0 if bent else straight(kb, number))

    claims = EXPERIMENT.findings(run(FULL, measure)).claims
    assert all(claim.reached for claim in claims if "R²" in claim.text)


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


def test_the_short_form_claims_nothing() -> None:
    plan = Plan(size="short", clients=("roscpp",))
    claims = EXPERIMENT.findings(run(plan, lambda _: made(straight))).claims
    assert claims
    assert {claim.reached for claim in claims} == {None}


def test_the_table_has_each_size_with_both_systems() -> None:
    def measure(cell: Cell) -> Measured:
        return made(lambda kb, number: straight(kb, number) * (1.5 if cell.settings["system"] == "rmpa" else 1.0))

    grid = EXPERIMENT.findings(run(FULL, measure)).grids[0]
    rows = {row[0]: dict(zip(grid.columns, row, strict=True)) for row in grid.rows}
    assert next(iter(rows)) == "1 KB"
    assert len(rows) == 11
    assert rows["1 MB"]["p50, classic"] == "82.4"
    assert rows["1 MB"]["p50, RMPA / classic"] == "1.5"
    assert rows["1 MB"]["came / lost, RMPA"] == "20 / 0"


def test_the_figure_has_every_message_and_a_line_of_the_same_label() -> None:
    figures = EXPERIMENT.findings(run(FULL, lambda _: made(straight))).figures
    assert len({figure.name for figure in figures}) == 3
    every, medians = figures[0].panels
    points = [series for series in every.series if series.style == "points"]
    lines = [series for series in every.series if series.style == "line"]
    assert {series.label for series in points} == {series.label for series in lines}
    assert len(points[0].x) == 11 * 20
    assert lines[0].y == pytest.approx([0.58, 82.42])
    assert medians.series[0].x[-1] == 1024.0
    assert (medians.logx, medians.logy) == (True, True)


def test_what_failed_is_left_out() -> None:
    cells = [cell for cell in EXPERIMENT.cells(FULL) if cell.settings["system"] == "rmpa"]
    assert {cell.settings.get("transport") for cell in cells} == {None, "direct"}
    found = EXPERIMENT.findings(Results(FULL, [(cell, made(straight)) for cell in cells]))
    assert all("classic" not in head for grid in found.grids[:-1] for head in grid.columns[:-2])
    assert EXPERIMENT.findings(Results(FULL, [])).figures == ()
