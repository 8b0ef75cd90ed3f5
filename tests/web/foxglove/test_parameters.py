"""Parameters of Foxglove clients: values both ways, and what is asked of the hub."""

from __future__ import annotations

import itertools

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET

from rmpa.web import limits
from rmpa.web.foxglove import protocol
from rmpa.web.foxglove.channels import ParameterError, ParameterRequests, from_parameter, to_parameter
from rmpa.web.hub import requests

NAMES = ("/a", "/b")


@pytest.fixture
def params() -> ParameterRequests:
    return ParameterRequests(itertools.count(1).__next__)


@pytest.mark.parametrize(
    "value",
    [1, -3, True, 1.0, 2.5, "text", b"\x00\xff", [1.0, 2.0], [1, 2], [1, 2.5], [], ["a"], {"x": [True, {"y": 1}]}],
)
def test_a_value_comes_back_as_it_went(value: requests.ParamValue) -> None:
    sent = protocol.encode_json(to_parameter("/p", value))
    received = msgspec.json.decode(sent, type=protocol.FoxgloveParameter)
    back = from_parameter(received)
    assert back == value
    assert type(back) is type(value)
    if isinstance(value, list) and value:
        assert isinstance(back, list)
        assert type(back[0]) is type(value[0])


json_values = st.recursive(
    st.booleans() | st.integers(-(2**31), 2**31 - 1) | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


@given(json_values)
def test_any_value_comes_back(value: requests.ParamValue) -> None:
    sent = protocol.encode_json(to_parameter("/p", value))
    assert from_parameter(msgspec.json.decode(sent, type=protocol.FoxgloveParameter)) == value


def test_numbers_that_json_lacks_become_texts() -> None:
    assert to_parameter("/p", float("nan")) == protocol.FoxgloveParameter(name="/p", value="nan")
    assert to_parameter("/p", [1.0, float("-inf")]).value == [1.0, "-inf"]
    assert to_parameter("/p", [1.0, float("-inf")]).type is UNSET


def test_floating_point_numbers_say_so_as_javascript_writes_whole_ones_without_a_point() -> None:
    assert to_parameter("/p", 1.0).type == "float64"
    assert to_parameter("/p", [1.0, 2.0]).type == "float64_array"
    assert to_parameter("/p", [1.0, 2]).type is UNSET
    assert to_parameter("/p", 1).type is UNSET


def test_a_whole_number_of_type_float64_is_a_double() -> None:
    value = from_parameter(protocol.FoxgloveParameter(name="/p", type="float64", value=3))
    assert isinstance(value, float)
    listed = from_parameter(protocol.FoxgloveParameter(name="/p", type="float64_array", value=[1, 2.5]))
    assert isinstance(listed, list)
    assert [type(each) for each in listed] == [float, float]


def nested(depth: int) -> object:
    value: object = 1
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize(
    "parameter",
    [
        protocol.FoxgloveParameter(name="relative", value=1),
        protocol.FoxgloveParameter(name="", value=1),
        protocol.FoxgloveParameter(name="/a//b", value=1),
        protocol.FoxgloveParameter(name="/p", value=1 << 31),
        protocol.FoxgloveParameter(name="/p", value=[None]),
        protocol.FoxgloveParameter(name="/p", value=nested(40)),
        protocol.FoxgloveParameter(name="/p", type="float64", value="3"),
        protocol.FoxgloveParameter(name="/p", type="float64", value=True),
        protocol.FoxgloveParameter(name="/p", type="float64", value=10**400),
        protocol.FoxgloveParameter(name="/p", type="float64_array", value=3),
        protocol.FoxgloveParameter(name="/p", type="float64_array", value=[1, "x"]),
        protocol.FoxgloveParameter(name="/p", type="byte_array", value="?"),
        protocol.FoxgloveParameter(name="/p", type="byte_array", value=[1]),
    ],
    ids=lambda parameter: f"{parameter.name} {parameter.value!r:.20}",
)
def test_what_ros_cannot_hold_is_refused(parameter: protocol.FoxgloveParameter) -> None:
    with pytest.raises(ParameterError):
        from_parameter(parameter)


def test_parameters_are_got_by_name_or_all(params: ParameterRequests) -> None:
    assert params.get(protocol.GetParameters(("/a", "/b", "/a"), "r1")) == [requests.GetParams(1, ("/a", "/b"))]
    assert params.get(protocol.GetParameters()) == [requests.GetParams(2, (), "/")]
    first = params.answer(requests.ParamsChanged(1, {"/a": 1, "/b": None}))
    assert first == protocol.ParameterValues(parameters=(protocol.FoxgloveParameter(name="/a", value=1),), id="r1")
    second = params.answer(requests.ParamsChanged(2, {}))
    assert second == protocol.ParameterValues(parameters=())
    assert not params.owns(1)


def test_setting_is_answered_once_all_are_set(params: ParameterRequests) -> None:
    message = protocol.SetParameters(
        (protocol.FoxgloveParameter(name="/a", value=1), protocol.FoxgloveParameter(name="/b")), "r"
    )
    assert params.set(message) == [requests.SetParam(1, "/a", 1), requests.DeleteParam(2, "/b")]
    assert params.answer(requests.ParamsChanged(1, {"/a": 1})) is None
    answer = params.answer(requests.ParamsChanged(2, {"/b": None}))
    assert answer == protocol.ParameterValues(parameters=(protocol.FoxgloveParameter(name="/a", value=1),), id="r")


def test_setting_without_an_id_is_not_answered(params: ParameterRequests) -> None:
    params.set(protocol.SetParameters((protocol.FoxgloveParameter(name="/a", value=1),)))
    assert params.answer(requests.ParamsChanged(1, {"/a": 1})) is None
    assert not params.owns(1)


def test_one_bad_parameter_leaves_all_as_they_are(params: ParameterRequests) -> None:
    bad = (protocol.FoxgloveParameter(name="/a", value=1), protocol.FoxgloveParameter(name="b", value=1))
    with pytest.raises(ParameterError):
        params.set(protocol.SetParameters(bad))
    assert not params.owns(1)


def test_a_parameter_is_followed_once(params: ParameterRequests) -> None:
    assert params.follow(["/a"]) == [requests.FollowParams(1, ("/a",))]
    assert params.follow(["/a", "/b"]) == [requests.FollowParams(2, ("/b",))]
    assert params.unfollow(["/a", "/never"]) == [requests.UnfollowParams(1)]
    assert params.close() == [requests.UnfollowParams(2)]


def test_all_parameters_are_followed_and_some_left_out(params: ParameterRequests) -> None:
    params.follow(["/a"])
    assert params.follow([]) == [requests.UnfollowParams(1), requests.FollowParams(2)]
    assert params.follow([]) == []
    assert params.unfollow(["/a"]) == []
    assert params.answer(requests.ParamsChanged(2, {"/a": 1})) is None
    changed = params.answer(requests.ParamsChanged(2, {"/a": 1, "/b": None}))
    assert changed == protocol.ParameterValues(parameters=(protocol.FoxgloveParameter(name="/b"),))
    assert params.follow(["/a"]) == []
    assert params.answer(requests.ParamsChanged(2, {"/a": 1})) is not None
    assert params.unfollow([]) == [requests.UnfollowParams(2)]


def test_requests_without_answers_are_bounded(params: ParameterRequests) -> None:
    for _ in range(limits.FOXGLOVE_PARAMETER_REQUESTS_MAX):
        params.get(protocol.GetParameters())
    with pytest.raises(ParameterError, match="try again later"):
        params.get(protocol.GetParameters())
    params.answer(requests.ParamsChanged(1, {}))
    params.get(protocol.GetParameters())


def test_followed_names_are_bounded(params: ParameterRequests, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "FOXGLOVE_PARAMETERS_MAX", 2)
    params.follow(NAMES)
    with pytest.raises(ParameterError, match="empty list"):
        params.follow(["/c"])
    params.follow([])
    params.unfollow(NAMES)
    with pytest.raises(ParameterError):
        params.unfollow(["/c"])


def test_a_failed_request_still_ends(params: ParameterRequests) -> None:
    params.get(protocol.GetParameters((), "r"))
    assert params.failed(1) == protocol.ParameterValues(parameters=(), id="r")
    params.follow(["/a"])
    assert params.failed(2) is None
    assert params.follow(["/a"]) == [requests.FollowParams(3, ("/a",))]
