from __future__ import annotations

import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError
from rmpa.resource.declare.attributes import LATENCY, RATE, Attribute, Direction, Scale
from rmpa.resource.declare.requirements import (
    Bound,
    QoSRequest,
    Requirement,
    at_least,
    at_most,
    between,
    exactly,
    parse_bound,
    parse_request,
    parse_requirement,
)

ATTRIBUTES = {
    "rate": RATE,
    "latency": LATENCY,
    "zoom": Attribute("zoom", Direction.TARGET, "m"),
    "frame": Attribute("frame", Direction.EXACT, scale=Scale.NOMINAL, words=("map", "odom")),
}


@pytest.mark.parametrize(
    ("text", "wish"),
    [
        (">= 20 Hz", at_least("20 Hz")),
        (">=20Hz hard", at_least("20Hz", hard=True)),
        ("<= 50 ms hard weight=2", at_most("50 ms", hard=True, weight=2)),
        ("<= 50 ms weight=2.5  hard ", at_most("50 ms", hard=True, weight=2.5)),
        ("1 .. 3 m", between("1", "3 m")),
        ("= map", exactly("map")),
        ("== map", exactly("map")),
        ("= map | odom", exactly("map", "odom")),
    ],
)
def test_what_people_write_is_read(text: str, wish: QoSRequest) -> None:
    assert parse_request(text, "x") == wish


def test_an_interval_has_one_unit() -> None:
    assert parse_bound("1 .. 300 cm", "zoom", ATTRIBUTES, "camera") == Bound(0.01, 3.0)
    assert parse_bound("1 m .. 300 cm", "zoom", ATTRIBUTES, "camera") == Bound(1.0, 3.0)
    assert parse_bound("1 .. 3", "zoom", ATTRIBUTES, "camera") == Bound(1.0, 3.0)


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        ("rate", "20 Hz", "'20 Hz' is no bound; write"),
        ("rate", "", "'' is no bound"),
        ("rate", ">=", "'>=' lacks a value"),
        ("rate", ">= 20 Hz weight=much", "'weight=much' is no weight"),
        ("rate", ">= 20 Hz weight=-1", "a weight of -1"),
        ("rate", ">= 20 m", "'m' is a unit of length"),
        ("rats", ">= 20 Hz", "camera has no such attribute; did you mean rate?"),
        ("zoom", "3 .. 1 m", "the bounds are the wrong way round"),
        ("frame", "= moon", "'moon' is no value of frame"),
        ("priority", "high", "'high' is no whole number"),
        ("expires", "-3 s", "'-3 s' is over already"),
        ("expires", "3 m", "'m' is a unit of length"),
        ("rate", "x" * 2000, "2000 characters"),
    ],
)
def test_unreadable_requirement_is_refused(key: str, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_requirement("/c", [(key, text)], ATTRIBUTES, "camera", 0.0)
    assert said in str(caught.value)


def test_a_whole_requirement() -> None:
    asked = [("rate", ">= 20 Hz"), ("priority", " 3 "), ("expires", "1 min"), ("frame", "= map|odom hard")]
    bounds = {"rate": Bound(low=math.log(20)), "frame": Bound(words=frozenset({"map", "odom"}), hard=True)}
    assert parse_requirement("/c", asked, ATTRIBUTES, "camera", 100.0) == Requirement("/c", bounds, 3, 160.0)
    with pytest.raises(ConfigError, match="it is asked twice"):
        parse_requirement("/c", [("rate", ">= 1"), ("rate", ">= 2")], ATTRIBUTES, "camera", 0.0)
    with pytest.raises(ConfigError, match="more than 256 bounds"):
        parse_requirement("/c", [("priority", "1")] * 300, ATTRIBUTES, "camera", 0.0)


_wishes = st.one_of(
    st.builds(at_least, st.sampled_from(["20 Hz", "3"]), hard=st.booleans(), weight=st.sampled_from([1.0, 2.0, 0.5])),
    st.builds(at_most, st.sampled_from(["20 ms", "3"]), hard=st.booleans()),
    st.builds(between, st.sampled_from(["1"]), st.sampled_from(["3 m"]), hard=st.booleans()),
    st.builds(lambda words: exactly(*words), st.lists(st.sampled_from("abc"), min_size=1, max_size=3)),
)


@given(_wishes)
def test_what_a_wish_shows_is_read_as_the_same(wish: QoSRequest) -> None:
    assert parse_request(str(wish), "x") == wish


@given(st.text(max_size=80))
def test_no_text_does_worse_than_a_config_error(text: str) -> None:
    with contextlib.suppress(ConfigError):
        parse_requirement("/c", [("rate", text), ("zoom", text), ("frame", text)], ATTRIBUTES, "camera", 0.0)
