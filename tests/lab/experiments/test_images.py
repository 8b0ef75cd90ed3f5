"""Experiment 6: what is planned, and what follows from samples whose answers are known."""

from __future__ import annotations

import pytest

from lab.bed.plan import Plan
from lab.experiments.contenders import CLASSIC, DIRECT, MIXED, RMPA, contender_of
from lab.experiments.images import EXPERIMENT, bytes_per_second
from lab.experiments.model import Cell, Measured, Results, Value
from lab.findings import Claim, Findings
from lab.frames import frame

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


def test_each_round_another_system_begins() -> None:
    cells = [contender_of(one) for one in EXPERIMENT.cells(Plan()) if one.settings["client"] == "rospy"]
    assert cells == [CLASSIC, RMPA, DIRECT, MIXED, RMPA, DIRECT, MIXED, CLASSIC]
    assert [contender_of(one) for one in EXPERIMENT.cells(Plan(size="short"))] == [CLASSIC, RMPA, DIRECT]


def test_only_images_that_came_in_the_span_count() -> None:
    came = [n * 100_000_000 for n in range(11)]
    assert bytes_per_second(came, 200_000_000, 600_000_000) == pytest.approx(10 * MB)
    assert bytes_per_second(came, 50_000_000, 150_000_000) == 0


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


def test_commands_beside_direct_images_are_held_against_both_relayed() -> None:
    found = claims(
        (cell("rmpa"), measured([0.5] * 985 + [1.0] * 15)),
        (cell("rmpa", transport="direct"), measured([5.0] * 1000)),
        (cell("rmpa", transport="mixed"), measured([0.5] * 985 + [1.2] * 15)),
    )
    text = "commands beside images, p99, roscpp: images direct, commands relayed / both relayed"
    assert found[text].value == pytest.approx(1.2)
    assert found[text].reached is False
    assert found["commands beside images, p99, RMPA, roscpp"].value == pytest.approx(1.0)


def test_of_few_commands_nothing_is_claimed() -> None:
    found = claims((cell("rmpa"), measured([0.5] * 200)))
    assert found["commands beside images, p99, RMPA, roscpp"].value is None
    assert found["images' share of the cable, RMPA, roscpp"].value is None


def test_without_a_cable_nothing_is_claimed_of_one() -> None:
    found = findings((cell("rmpa"), measured([0.5] * 2000, link="")))
    assert all(claim.value is None for claim in found.claims)
    assert not found.notes


def test_the_tables_count_what_never_came() -> None:
    commands, images = findings((cell("rmpa"), measured([0.5] * 998 + [2.0] * 2))).grids
    beside = next(row for row in commands.rows if row[1:3] == ("RMPA", "images"))
    at = dict(zip(commands.columns, beside, strict=True))
    assert (at["count"], at["lost"], at["later than 1 ms"]) == ("1000", "3", "0.50 %")
    picture = next(row for row in images.rows if row[1] == "RMPA")
    assert picture[-1] == "7"


def test_a_message_that_came_twice_counts_once() -> None:
    told = measured([0.5] * 1000)
    rows = list(told.tables["commands"].itertuples(index=False, name=None))
    doubled = Measured(
        {**told.tables, "commands": frame(told.tables["commands"].columns, [*rows, rows[-1]])}, told.facts
    )
    beside = findings((cell("rmpa"), doubled)).grids[0].rows[1]
    assert beside[8] == "1000"


def test_without_any_cell_nothing_is_said() -> None:
    assert findings() == Findings()
