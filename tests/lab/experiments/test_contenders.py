from __future__ import annotations

import pytest

from lab.bed.plan import Plan
from lab.experiments.contenders import (
    CLASSIC,
    DEFAULTS,
    DIRECT,
    MIXED,
    RMPA,
    Contender,
    contender_of,
    nodelay_of,
    system_of,
    transport_of,
    turn,
)
from lab.experiments.model import Cell, Measured, Results


def test_another_one_begins_each_round() -> None:
    order = [CLASSIC, RMPA, DEFAULTS]
    assert [turn(order, number)[0] for number in range(4)] == [CLASSIC, RMPA, DEFAULTS, CLASSIC]
    assert all(set(turn(order, number)) == set(order) for number in range(4))


@pytest.mark.parametrize(
    ("contender", "system", "nodelay"),
    [(RMPA, "rmpa", True), (CLASSIC, "classic", True), (DEFAULTS, "classic", False)],
)
def test_a_cells_settings_say_who_it_is_about(contender: Contender, system: str, nodelay: bool) -> None:
    cell = Cell("control", contender.settings)
    assert (system_of(cell), nodelay_of(cell)) == (system, nodelay)


def test_a_cell_without_a_transport_was_relayed() -> None:
    old = Cell("control", {"system": "rmpa", "client": "roscpp", "round": 1})
    assert (contender_of(old), transport_of(old)) == (RMPA, "relay")
    assert (RMPA.settings, transport_of(Cell("rates", DIRECT.settings))) == ({"system": "rmpa"}, "direct")


def test_each_transport_selects_its_own_cells_only() -> None:
    cells = [Cell("images", {**one.settings, "round": 1}) for one in (CLASSIC, RMPA, DIRECT, MIXED)]
    results = Results(Plan(), [(cell, Measured()) for cell in cells])
    for cell, one in zip(cells, (CLASSIC, RMPA, DIRECT, MIXED), strict=True):
        assert [found for found, _ in one.select(results)] == [cell]
        assert contender_of(cell) == one
