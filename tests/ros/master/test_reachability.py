"""Nodes that cannot be connected to, over time."""

from __future__ import annotations

from rmpa.ros import limits
from rmpa.ros.master.registrations import Reachability, Unreachable

AT = "http://10.9.9.9:1234/"
AFTER = limits.NODE_UNREACHABLE_AFTER


def test_a_node_is_withdrawn_after_a_while() -> None:
    table = Reachability()
    assert not table.failed("/n", AT, "no route", 100.0)
    assert table.unreachable == {"/n": Unreachable(AT, "no route", 100.0)}
    assert not table.failed("/n", AT, "no answer", 99.9 + AFTER)
    assert table.failed("/n", AT, "no answer", 100.0 + AFTER), "told once"
    assert not table.failed("/n", AT, "no answer", 200.0 + AFTER)
    assert table.unreachable == {"/n": Unreachable(AT, "no answer", 100.0, withdrawn=True)}


def test_a_short_outage_withdraws_nothing() -> None:
    table = Reachability()
    table.failed("/n", AT, "no route", 0.0)
    assert not table.reached("/n")
    assert not table.unreachable
    assert not table.failed("/n", AT, "no route", AFTER), "the time counts anew"


def test_a_node_that_is_reached_comes_back() -> None:
    table = Reachability()
    table.failed("/n", AT, "no route", 0.0)
    table.failed("/n", AT, "no route", AFTER)
    assert table.reached("/n")
    assert not table.reached("/n")
    assert not table.unreachable


def test_a_node_that_moves_or_goes_is_forgotten() -> None:
    table = Reachability()
    for node in ("/moved", "/gone", "/stays"):
        table.failed(node, AT, "no route", 0.0)
    table.keep({"/moved": "http://127.0.0.1:1/", "/stays": AT})
    assert list(table.unreachable) == ["/stays"]
    assert not table.failed("/stays", "http://10.9.9.8:1/", "no route", AFTER), "another address begins anew"
