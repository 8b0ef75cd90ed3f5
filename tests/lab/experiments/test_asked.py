"""What is asked for, and the plan that comes of it."""

from __future__ import annotations

import pytest

from lab.bed.plan import Plan
from lab.experiments.asked import Asked, choose, parse_only, select
from lab.experiments.model import Cell
from rmpa.core.errors import ConfigError, StartError

CELLS = [
    Cell("rates", {"system": "classic", "nodelay": True, "rate": 10}),
    Cell("rates", {"system": "classic", "nodelay": False, "rate": 10}),
    Cell("rates", {"system": "rmpa", "rate": 10}),
    Cell("rates", {"system": "rmpa", "rate": 1000}),
]


def everything(_: Plan) -> str:
    return ""


def no_root(plan: Plan) -> str:
    return "network namespaces need root" if plan.bed == "namespaces" else ""


def test_nothing_asked_is_the_whole_evaluation_where_that_can_be() -> None:
    assert choose(Asked(), everything) == (Plan("full", "namespaces", ("rospy", "roscpp"), "100mbit", 1), "")


def test_without_root_all_is_on_loopback_and_that_is_said() -> None:
    plan, note = choose(Asked(), no_root)
    assert plan == Plan("full", "loopback", ("own",), "", 1)
    assert note == "network namespaces need root: all on loopback, with our own nodes and core"


@pytest.mark.parametrize(
    ("asked", "plan"),
    [
        (Asked(link="none"), Plan(link="")),
        (Asked(link="1gbit", seed=0), Plan(link="1gbit", seed=0)),
        (Asked(size="short", clients=("rospy",)), Plan(size="short", clients=("rospy",))),
        (Asked(bed="loopback"), Plan(bed="loopback", clients=("own",), link="")),
        (Asked(bed="loopback", clients=("rospy",), link="none"), Plan(bed="loopback", clients=("rospy",), link="")),
        (Asked(bed="namespaces"), Plan()),
    ],
)
def test_what_is_asked_is_done(asked: Asked, plan: Plan) -> None:
    assert choose(asked, everything) == (plan, "")


def test_a_bed_that_was_named_is_not_exchanged_for_another() -> None:
    with pytest.raises(StartError, match="hosts as network namespaces: network namespaces need root"):
        choose(Asked(bed="namespaces"), no_root)
    with pytest.raises(StartError, match="network namespaces need root"):
        choose(Asked(link="10mbit"), no_root)


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        (Asked(link="fast"), "--link: 'fast' is no rate; write it as tc does"),
        (Asked(link=""), "--link: '' is no rate"),
        (Asked(link="100"), "is no rate"),
        (Asked(bed="loopback", link="100mbit"), "--link: loopback has no cables"),
        (Asked(clients=("rospy", "rospy")), "--client: one was given twice"),
    ],
)
def test_contradictions_are_refused(asked: Asked, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        choose(asked, everything)


def test_a_run_goes_on_as_it_was() -> None:
    before = Plan("short", "loopback", ("own",), "", 7)
    assert choose(Asked(), everything, before) == (before, "")  # though namespaces could be had now
    assert choose(Asked(seed=8), everything, before)[0].seed == 8  # which the store then refuses
    assert choose(Asked(bed="namespaces"), everything, before)[0] == Plan("short", "namespaces", seed=7)
    shaped = Plan(link="10mbit", clients=("roscpp",))
    assert choose(Asked(), everything, shaped) == (shaped, "")
    with pytest.raises(StartError, match="need root"):
        choose(Asked(), no_root, shaped)


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
