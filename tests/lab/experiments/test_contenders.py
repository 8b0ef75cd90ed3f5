from __future__ import annotations

import pytest

from lab.experiments.contenders import CLASSIC, DEFAULTS, RMPA, Contender, nodelay_of, system_of, turn
from lab.experiments.model import Cell


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
