"""Differences of states as JSON merge patches."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rmpa.web.monitor.messages import difference, without_nulls
from tests.web.monitor.patches import apply

SCALARS = st.booleans() | st.integers(-3, 3) | st.sampled_from((0.0, 1.0, 1.5, -2.0)) | st.text(max_size=3)
KEYS = st.sampled_from(("a", "b", "/odom", "__proto__", ""))
VALUES: st.SearchStrategy[Any] = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner | st.none(), max_size=3) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=12,
)
STATES = st.dictionaries(KEYS, VALUES, max_size=5)


@settings(suppress_health_check=[HealthCheck.too_slow])  # the first example of a recursive strategy is slow
@given(STATES, STATES)
def test_a_patch_applied_to_the_old_state_gives_the_new_one(old: Any, new: Any) -> None:
    made = apply(old, difference(old, new))
    assert json.dumps(made, sort_keys=True) == json.dumps(new, sort_keys=True)  # 1, 1.0 and true are told apart


@given(STATES, STATES)
def test_neither_state_is_changed(old: Any, new: Any) -> None:
    before = json.dumps([old, new])
    apply(old, difference(old, new))
    assert json.dumps([old, new]) == before


@given(STATES)
def test_equal_states_have_an_empty_patch(state: Any) -> None:
    assert difference(state, json.loads(json.dumps(state))) == {}


# RFC 7396, appendix A
@pytest.mark.parametrize(
    ("state", "patch", "result"),
    [
        ({"a": "b"}, {"a": "c"}, {"a": "c"}),
        ({"a": "b"}, {"b": "c"}, {"a": "b", "b": "c"}),
        ({"a": "b"}, {"a": None}, {}),
        ({"a": "b", "b": "c"}, {"a": None}, {"b": "c"}),
        ({"a": ["b"]}, {"a": "c"}, {"a": "c"}),
        ({"a": "c"}, {"a": ["b"]}, {"a": ["b"]}),
        ({"a": {"b": "c"}}, {"a": {"b": "d", "c": None}}, {"a": {"b": "d"}}),
        ({"a": [{"b": "c"}]}, {"a": [1]}, {"a": [1]}),
        (["a", "b"], ["c", "d"], ["c", "d"]),
        ({"a": "b"}, ["c"], ["c"]),
        ({"a": "foo"}, None, None),
        ({"a": "foo"}, "bar", "bar"),
        ({"e": None}, {"a": 1}, {"e": None, "a": 1}),
        ([1, 2], {"a": "b", "c": None}, {"a": "b"}),
        ({}, {"a": {"bb": {"ccc": None}}}, {"a": {"bb": {}}}),
    ],
)
def test_the_examples_of_the_standard(state: Any, patch: Any, result: Any) -> None:
    assert apply(state, patch) == result


def test_what_is_not_known_is_left_out_of_a_state() -> None:
    assert without_nulls({"a": None, "b": float("nan"), "c": (1, None), "d": {"e": None}}) == {
        "c": [1, None],
        "d": {},
    }
