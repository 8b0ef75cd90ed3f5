"""Parameters of Foxglove clients: values both ways, and what is asked of the hub."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET

from rmpa.core.errors import RmpaError
from rmpa.web.foxglove import limits, protocol
from rmpa.web.foxglove.protocol import FoxgloveParameter as Parameter
from rmpa.web.foxglove.protocol import from_parameter, to_parameter

if TYPE_CHECKING:
    from rmpa.web.hub.node_link import ParamValue
    from tests.web.foxglove.client import Client
    from tests.web.recorder import Asked


@pytest.mark.parametrize(
    "value",
    [1, -3, True, 1.0, 2.5, "text", b"\x00\xff", [1.0, 2.0], [1, 2], [1, 2.5], [], ["a"], {"x": [True, {"y": 1}]}],
)
def test_a_value_comes_back_as_it_went(value: ParamValue) -> None:
    sent = protocol.encode_json(to_parameter("/p", value))
    received = msgspec.json.decode(sent, type=Parameter)
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
def test_any_value_comes_back(value: ParamValue) -> None:
    sent = protocol.encode_json(to_parameter("/p", value))
    assert from_parameter(msgspec.json.decode(sent, type=Parameter)) == value


@pytest.mark.parametrize(
    ("value", "shown", "kind"),
    [
        (float("nan"), "nan", UNSET),  # which JSON lacks
        ([1.0, float("-inf")], [1.0, "-inf"], UNSET),
        (1.0, 1.0, "float64"),  # JavaScript writes whole ones without a point
        ([1.0, 2.0], [1.0, 2.0], "float64_array"),
        ([1.0, 2], [1.0, 2], UNSET),
        (1, 1, UNSET),
    ],
)
def test_a_value_is_shown_with_its_type_where_json_does_not_tell_it(value: Any, shown: Any, kind: Any) -> None:
    assert to_parameter("/p", value) == Parameter(name="/p", value=shown, type=kind)


def test_a_whole_number_of_type_float64_is_a_double() -> None:
    listed: Any = from_parameter(Parameter(name="/p", type="float64_array", value=[1, 2.5]))
    one = from_parameter(Parameter(name="/p", type="float64", value=3))
    assert [type(each) for each in (one, *listed)] == [float] * 3


def nested(depth: int) -> object:
    value: object = 1
    for _ in range(depth):
        value = [value]
    return value


@pytest.mark.parametrize(
    "parameter",
    [
        Parameter(name="relative", value=1),
        Parameter(name="", value=1),
        Parameter(name="/a//b", value=1),
        Parameter(name="/p", value=1 << 31),
        Parameter(name="/p", value=[None]),
        Parameter(name="/p", value=nested(40)),
        Parameter(name="/p", type="float64", value="3"),
        Parameter(name="/p", type="float64", value=True),
        Parameter(name="/p", type="float64", value=10**400),
        Parameter(name="/p", type="float64_array", value=3),
        Parameter(name="/p", type="float64_array", value=[1, "x"]),
        Parameter(name="/p", type="byte_array", value="?"),
        Parameter(name="/p", type="byte_array", value=[1]),
    ],
    ids=lambda parameter: f"{parameter.name} {parameter.value!r:.20}",
)
def test_what_ros_cannot_hold_is_refused(parameter: Parameter) -> None:
    with pytest.raises(RmpaError):
        from_parameter(parameter)


# --- what a session asks of the hub ---


def _values(client: Client) -> dict[str, Any]:
    """The last values that the client was sent."""
    return {each["name"]: each.get("value") for each in client.of("parameterValues")[-1]["parameters"]}


def _follow(client: Client, *names: str, op: str = "subscribe") -> list[Asked]:
    return client.send({"op": f"{op}ParameterUpdates", "parameterNames": names})


def test_parameters_are_got_by_name_or_all(client: Client) -> None:
    client.send({"op": "getParameters", "parameterNames": ["/a", "/b", "/a"], "id": "r1"})
    assert client.last("get_params").names == ("/a", "/b")
    client.last("get_params").done({"/a": 1})
    assert client.of("parameterValues") == [
        {"op": "parameterValues", "parameters": [{"name": "/a", "value": 1}], "id": "r1"}
    ]
    client.send({"op": "getParameters"})
    assert client.last("get_params").names == ()
    client.last("get_params").failed(RmpaError("the core is away"))
    assert client.errors == ["the core is away"]
    assert _values(client) == {}


def test_parameters_are_set_and_deleted_and_what_is_refused_is_told(client: Client) -> None:
    changes = [{"name": "/a", "value": 3, "type": "float64"}, {"name": "/b"}, {"name": "/denied", "value": 1}]
    client.send({"op": "setParameters", "parameters": changes, "id": "r"})
    assert client.hub.params.changes == [("/a", 3.0), ("/b", None)]
    assert client.errors == ["the core refuses it"]
    assert _values(client) == {"/a": 3.0}
    client.send({"op": "setParameters", "parameters": [{"name": "/a", "value": 1}]})
    assert len(client.of("parameterValues")) == 1  # without an id it is not answered


def test_one_bad_parameter_leaves_all_as_they_are(client: Client) -> None:
    client.send({"op": "setParameters", "parameters": [{"name": "/a", "value": 1}, {"name": "b", "value": 1}]})
    assert "write it like /base/rate" in client.errors[0]
    assert client.hub.params.changes == []


def test_parameters_are_followed_by_name(client: Client) -> None:
    first = client.one("follow_params", _follow(client, "/a"))
    both = client.one("follow_params", _follow(client, "/a", "/b"))
    assert (first.names, first.closed, both.names) == (("/a",), True, ("/a", "/b"))
    both.changed({"/a": None})
    assert client.of("parameterValues")[-1]["parameters"] == [{"name": "/a"}]
    rest = client.one("follow_params", _follow(client, "/a", "/never", op="unsubscribe"))
    assert rest.names == ("/b",)
    assert _follow(client, op="unsubscribe") == []
    assert rest.closed


def test_all_parameters_are_followed_and_some_left_out(client: Client) -> None:
    _follow(client, "/a")
    assert client.one("follow_params", _follow(client)).names == ()
    client.one("follow_params", _follow(client, "/a", op="unsubscribe")).changed({"/a": 1})
    assert client.of("parameterValues") == []
    client.last("follow_params").changed({"/a": 1, "/b": None})
    assert _values(client) == {"/b": None}
    client.one("follow_params", _follow(client, "/a")).changed({"/a": 1})
    assert _values(client) == {"/a": 1}


def test_requests_without_answers_and_followed_names_are_bounded(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(limits.PARAMETER_REQUESTS_MAX + 1):
        client.send({"op": "getParameters"})
    assert len(client.errors) == 1
    assert "try again later" in client.errors[0]
    client.last("get_params")
    client.all("get_params")[0].done({})
    client.send({"op": "getParameters"})
    assert len(client.errors) == 1
    monkeypatch.setattr(limits, "PARAMETERS_MAX", 2)
    for name in ("/a", "/b"):
        _follow(client, name)
    _follow(client, "/c")
    assert "empty list" in client.errors[1]
