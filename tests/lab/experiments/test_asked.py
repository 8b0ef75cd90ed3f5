"""What is asked for, and the plan that comes of it."""

from __future__ import annotations

import pytest

from lab.experiments.asked import parse_only, select
from lab.experiments.model import Cell
from rmpa.core.errors import ConfigError

CELLS = [
    Cell("rates", {"system": "classic", "nodelay": True, "rate": 10}),
    Cell("rates", {"system": "classic", "nodelay": False, "rate": 10}),
    Cell("rates", {"system": "rmpa", "rate": 10}),
    Cell("rates", {"system": "rmpa", "rate": 1000}),
]


def chosen(*texts: str) -> list[Cell]:
    return select(CELLS, parse_only(texts, CELLS))


def test_cells_by_their_settings() -> None:
    assert chosen() == CELLS
    assert chosen("system=rmpa") == CELLS[2:]
    assert chosen("rate=10", "system=rmpa") == [CELLS[2]]
    assert chosen("rate=10", "rate=1000", "system = rmpa") == CELLS[2:]
    assert chosen("nodelay=true") == [CELLS[0]]  # cells without the setting are not meant
    assert chosen("nodelay=False", "system=rmpa") == []


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("rmpa", "'rmpa' is not SETTING=VALUE"),
        ("sytem=rmpa", "no cell has a setting 'sytem'; did you mean system?"),
        ("x=1", "there are system, nodelay, rate"),
        ("rate=7", "no cell has rate=7; rate is 10, 1000"),
    ],
)
def test_settings_that_no_cell_has_are_told_what_there_is(text: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        chosen(text)
