"""What is asked for, and the plan that comes of it."""

from __future__ import annotations

from typing import Any

import pytest

from lab.bed.plan import Plan
from lab.experiments.asked import choose, parse_only, select
from lab.experiments.model import Cell
from rmpa.core.errors import ConfigError

CELLS = [
    Cell("rates", {"system": "classic", "nodelay": True, "rate": 10}),
    Cell("rates", {"system": "classic", "nodelay": False, "rate": 10}),
    Cell("rates", {"system": "rmpa", "rate": 10}),
    Cell("rates", {"system": "rmpa", "rate": 1000}),
]


@pytest.mark.parametrize(
    ("asked", "plan"),
    [
        ((None, (), None, None), Plan("full", ("rospy", "roscpp"), "100mbit", 1)),
        ((None, (), "none", None), Plan(link="")),
        ((None, (), "1gbit", 0), Plan(link="1gbit", seed=0)),
        (("short", ("rospy",), None, None), Plan(size="short", clients=("rospy",))),
    ],
)
def test_what_is_asked_is_done(asked: tuple[Any, ...], plan: Plan) -> None:
    assert choose(*asked) == plan


@pytest.mark.parametrize(
    ("link", "clients", "why"),
    [
        ("fast", (), "--link: 'fast' is no rate; write it as tc does"),
        ("", (), "--link: '' is no rate"),
        ("100", (), "is no rate"),
        (None, ("rospy", "rospy"), "--client: one was given twice"),
    ],
)
def test_contradictions_are_refused(link: str | None, clients: Any, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        choose(None, clients, link, None)


def test_a_run_goes_on_as_it_was() -> None:
    before = Plan("short", ("rospy",), "", 7)
    assert choose(None, (), None, None, before) == before
    assert choose(None, (), None, 8, before).seed == 8  # which the store then refuses


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
