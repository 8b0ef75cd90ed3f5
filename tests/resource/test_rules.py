from __future__ import annotations

import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.declare import ContextRule, Scalar, parse_rule, split_reference

PARAMETERS = ("gain", "name", "on")


def rule(text: str) -> ContextRule:
    return parse_rule(text, PARAMETERS, "context docked")


@pytest.mark.parametrize(
    ("text", "true", "false"),
    [
        ("/b/charging == true and ~gain > 3", {"/b/charging": True, "~gain": 4}, {"/b/charging": True, "~gain": 3}),
        ("/b.charging", {"/b.charging": True}, {"/b.charging": False}),
        ("not /b.charging", {"/b.charging": False}, {"/b.charging": True}),
        ("~gain >= -1.5e1", {"~gain": -15}, {"~gain": -15.1}),
        ("3 < ~gain", {"~gain": 3.5}, {"~gain": 3}),
        ('~name == "it\'s"', {"~name": "it's"}, {"~name": "its"}),
        ("~name != 'a and b'", {"~name": "a"}, {"~name": "a and b"}),
        ("~gain == /x", {"~gain": 2, "/x": 2.0}, {"~gain": 2, "/x": 3}),
        ("~on == true", {"~on": 1}, {"~on": 0}),  # a uint8 of a driver
        # and binds closer than or; brackets closer than both
        ("~on or ~gain > 1 and ~gain < 0", {"~on": True, "~gain": 5}, {"~on": False, "~gain": 5}),
        ("(~on or ~gain > 1) and ~gain < 5", {"~on": False, "~gain": 2}, {"~on": True, "~gain": 5}),
        ("not (~on and ~gain > 1)", {"~on": True, "~gain": 1}, {"~on": True, "~gain": 2}),
        ("not ~on == true", {"~on": False}, {"~on": True}),
    ],
)
def test_a_rule_holds_or_not(text: str, true: dict[str, Scalar], false: dict[str, Scalar]) -> None:
    assert rule(text).holds(true) is True
    assert rule(text).holds(false) is False


def test_what_is_not_known_decides_nothing() -> None:
    both = rule("/b.x > 1 and ~on")
    assert both.holds({"~on": True}) is None
    assert both.holds({"~on": False}) is False
    either = rule("/b.x > 1 or ~on")
    assert either.holds({"~on": True}) is True
    assert either.holds({"~on": False}) is None
    assert rule("not /b.x == 1").holds({}) is None
    assert rule("/b.x != 1").holds({"/b.x": math.nan}) is None


def test_a_text_is_no_number() -> None:
    assert rule("/b.x == 1").holds({"/b.x": "1"}) is False
    assert rule("/b.x > 1").holds({"/b.x": "2"}) is False
    assert rule("/b.x != 1").holds({"/b.x": "1"}) is True


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a value is missing; for example /battery/charging"),
        ("~gain >", "a value is missing"),
        ("> 3", "a value is missing in front of '>'"),
        ("~gian > 3", "there is no parameter gian; did you mean ~gain?"),
        ("~gain > 3 3", "'3' stands where the rule must end"),
        ("~gain > 3V", "'3V' cannot be read"),
        ("(~gain > 3", "a bracket is not closed"),
        ("~gain > 3)", "')' stands where the rule must end"),
        ("~on = true", "'= true' cannot be read"),
        ("~on == True", "'True' is no value; did you mean true?"),
        ("~name == docked", "'docked' is no value; texts have quotes"),
        ("~name == 'docked", "cannot be read"),
        ("__import__('os')", "'__import__' is no value"),
        ("and", "'and' is no value"),
        ("(" * 50 + "~on" + ")" * 50, f"deeper than {limits.CONTEXT_RULE_DEPTH} brackets"),
        ("not " * 50 + "~on", f"deeper than {limits.CONTEXT_RULE_DEPTH} brackets"),
        ("~on or " * 200 + "~on", "1403 characters"),
    ],
)
def test_invalid_rule_is_refused(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        rule(text)
    assert said in str(error.value)
    assert str(error.value).startswith("context docked: ")


@given(st.text(alphabet="~/.()<>=! andortuefls'\"0123_x-", max_size=80))
def test_any_text_is_a_rule_or_an_error(text: str) -> None:
    with contextlib.suppress(ConfigError):
        made = parse_rule(text, ("x", "a"))
        assert made.holds({}) in (True, False, None)
        assert made.holds(dict.fromkeys(made.references, 1.0)) is not None


def test_the_graph_tells_which_part_is_the_topic() -> None:
    assert list(split_reference("/a/b/c")) == [("/a/b/c", ()), ("/a/b", ("c",)), ("/a", ("b", "c"))]
    assert list(split_reference("/a/b.c.d")) == [("/a/b", ("c", "d"))]
    assert rule("/a > 1 and /a < ~gain").references == ("/a", "~gain")
