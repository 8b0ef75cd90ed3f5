from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError
from rmpa.resource.declare.attributes import LATENCY, RATE, Attribute, Direction, Scale
from rmpa.resource.declare.requirements import Bound, Requirement, bound, find_attribute, merge

ZOOM = Attribute("zoom", Direction.TARGET)
MODE = Attribute("mode", Direction.MAX, scale=Scale.ORDINAL, words=("low", "medium", "high"))
FRAME = Attribute("frame", Direction.EXACT, scale=Scale.NOMINAL, words=("map", "odom", "base"))


def test_bounds_are_read_with_their_units() -> None:
    assert bound(RATE, at_least="0.02 kHz") == Bound(low=math.log(20))
    assert bound(LATENCY, at_most="50 ms", weight=2, hard=True) == Bound(high=math.log(0.05), weight=2, hard=True)
    assert bound(ZOOM, at_least=1, at_most=3) == Bound(1, 3)
    assert bound(ZOOM, exactly=2) == Bound(2, 2)
    assert bound(MODE, at_least="medium") == Bound(low=1)
    assert bound(FRAME, exactly=("map", "odom")) == Bound(words=frozenset({"map", "odom"}))
    assert bound(FRAME, exactly="map") == Bound(words=frozenset({"map"}))


def test_an_exact_value_where_more_is_better_is_a_lower_bound() -> None:
    assert bound(RATE, exactly=20) == Bound(low=math.log(20))
    assert bound(LATENCY, exactly=0.1) == Bound(high=math.log(0.1))


@pytest.mark.parametrize(
    ("attribute", "asked", "said"),
    [
        (ZOOM, {"at_least": 3, "at_most": 1}, "the bounds are the wrong way round"),
        (ZOOM, {}, "nothing is asked of it; give at_least, at_most or exactly"),
        (ZOOM, {"at_least": 1, "exactly": 2}, "give one or the other"),
        (ZOOM, {"exactly": ("a",)}, "it takes no such words"),
        (
            RATE,
            {"at_most": 20},
            "more is better, so a bound on the other side asks for nothing; give at_least (>=) alone",
        ),
        (RATE, {"at_least": 5, "at_most": 3}, "the bounds are the wrong way round"),
        (RATE, {"at_least": 5, "at_most": 20}, "give at_least (>=) alone"),
        (LATENCY, {"at_least": 20}, "less is better"),
        (RATE, {"at_least": -5}, "-5 is below 0; rate has a logarithmic scale"),
        (RATE, {"at_least": "20 s"}, "'s' is a unit of time"),
        (MODE, {"at_least": "huge"}, "'huge' is no value of mode; it is one of low, medium, high"),
        (FRAME, {"exactly": "moon"}, "'moon' is no value of frame"),
        (FRAME, {"at_least": "map"}, "give exactly, one word or more"),
        (RATE, {"at_least": 5, "weight": 0}, "a weight of 0"),
        (RATE, {"at_least": 5, "weight": math.nan}, "a weight of nan"),
    ],
)
def test_invalid_request_is_refused(attribute: Attribute, asked: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        bound(attribute, **asked)  # type: ignore[arg-type] # on purpose
    assert said in str(caught.value)
    assert f"requirement of {attribute.name}" in str(caught.value)


def test_unknown_attribute_has_a_suggestion() -> None:
    with pytest.raises(ConfigError, match="camera has no such attribute; did you mean rate"):
        find_attribute({"rate": RATE}, "rates", "camera")


def test_intervals_are_intersected() -> None:
    merged = merge(
        [
            Requirement("a", {"zoom": Bound(1, 5, weight=2)}),
            Requirement("b", {"zoom": Bound(3, 9, hard=True), "rate": Bound(low=1)}),
        ]
    )
    assert merged.bounds == {"zoom": Bound(3, 5, weight=2, hard=True), "rate": Bound(low=1)}
    assert merged.conflicts == ()


def test_an_empty_intersection_is_resolved_by_priority_and_reported() -> None:
    low = Requirement("low", {"zoom": Bound(1, 2, weight=9)}, priority=0)
    high = Requirement("high", {"zoom": Bound(3, 4)}, priority=5)
    merged = merge([low, high])
    assert merged.bounds == {"zoom": Bound(3, 4)}
    assert [str(c) for c in merged.conflicts] == ["zoom: what low asks contradicts high and is left out"]


def test_of_equal_priorities_the_earlier_one_stays() -> None:
    merged = merge([Requirement(name, {"frame": Bound(words=frozenset({name}))}) for name in ("map", "odom")])
    assert merged.bounds["frame"].words == {"map"}
    assert merged.conflicts[0].client == "odom"


_bounds = st.tuples(st.integers(0, 9), st.integers(0, 9)).map(lambda ends: Bound(min(ends), max(ends)))
_requirements = st.lists(
    st.builds(Requirement, st.uuids().map(str), st.dictionaries(st.sampled_from("abc"), _bounds), st.integers(0, 3)),
    max_size=8,
)


@given(_requirements)
def test_merge_satisfies_all_but_reported_conflicts(requirements: list[Requirement]) -> None:
    merged = merge(requirements)
    told = {(conflict.client, conflict.attribute) for conflict in merged.conflicts}
    for requirement in requirements:
        for name, asked in requirement.bounds.items():
            both = merged.bounds[name]
            assert both.low <= both.high
            if (requirement.client, name) not in told:
                assert asked.low <= both.low <= both.high <= asked.high


@given(_requirements)
def test_highest_priority_never_conflicts(requirements: list[Requirement]) -> None:
    merged = merge(requirements)
    if requirements:
        highest = max(requirements, key=lambda requirement: requirement.priority)
        assert all(conflict.client != highest.client for conflict in merged.conflicts)
