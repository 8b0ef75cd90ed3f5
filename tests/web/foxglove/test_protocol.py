"""Messages and parameters of Foxglove."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET

from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError
from rmpa.web.foxglove import limits, protocol
from rmpa.web.foxglove.channels import Channel, FoxgloveService, graph_update
from rmpa.web.foxglove.protocol import FoxgloveParameter as Parameter
from rmpa.web.foxglove.protocol import from_parameter, to_parameter
from rmpa.web.foxglove.session import DECODER, OPS
from rmpa.web.hub.frame_writer import Opcode, OutFrame
from rmpa.web.hub.node_link import ParamValue
from tests.web.foxglove.client import Client
from tests.web.recorder import Asked

CHATTER = Channel(1, ("/chatter", "std_msgs/String", ""), SimpleNamespace(md5sum="", definition="string data"))
KIND: Any = SimpleNamespace(
    name="std_srvs/SetBool",
    request=SimpleNamespace(definition="bool data"),
    response=SimpleNamespace(definition="bool success\nstring message"),
)
SET_BOOL = FoxgloveService(1, ("/set_bool", KIND.name, ""), KIND)
GOLDEN = Path(__file__).with_name("golden.jsonl").read_bytes().splitlines()
VALUES: dict[str, ParamValue] = {"/a": 1, "/c": b"ABCD", "/d": [1.5, 2.0], "/e": {"x": True}}
JSON = dict(
    zip(
        (
            protocol.message("advertise", channels=[CHATTER.json()]),
            protocol.message("unadvertise", channelIds=[1]),
            protocol.message("advertiseServices", services=[SET_BOOL.json()]),
            protocol.status(1, "msg", "i1"),
            protocol.status(2, "x"),
            protocol.message("removeStatus", statusIds=["i1"]),
            protocol.parameter_values(VALUES, "r1"),
            protocol.parameter_values({"/a": 6}),
            *graph_update(({}, {}, {}), ({"/t": ("/n1",)}, {"/t": ("/n2",)}, {"/s": ("/n1",)})),
        ),
        GOLDEN,
        strict=True,
    )
)
BINARY = {
    protocol.message_data(7, 1234567890123456789, b"\x02\x00\x00\x00hi"): (
        b'\x01\x07\x00\x00\x00\x15\x81\xe9}\xf4\x10"\x11\x02\x00\x00\x00hi'
    ),
    protocol.server_time(99): b"\x02c\x00\x00\x00\x00\x00\x00\x00",
    protocol.service_response(1, 12, b"\x01\x00\x00\x00\x00"): (
        b"\x03\x01\x00\x00\x00\x0c\x00\x00\x00\x04\x00\x00\x00ros1\x01\x00\x00\x00\x00"
    ),
    protocol.asset_response(5, b"hi"): b"\x04\x05\x00\x00\x00\x00\x00\x00\x00\x00hi",
    protocol.asset_failure(6, "OSError: not found"): (b"\x04\x06\x00\x00\x00\x01\x12\x00\x00\x00OSError: not found"),
}


@pytest.mark.parametrize(
    ("frame", "opcode", "golden"),
    [(frame, opcode, golden) for opcode in (Opcode.TEXT, Opcode.BINARY) for frame, golden in
     (JSON if opcode is Opcode.TEXT else BINARY).items()],
)  # fmt: skip
def test_messages_are_those_of_the_reference(frame: OutFrame, opcode: Opcode, golden: bytes) -> None:
    assert (frame[0], b"".join(frame[1])) == (opcode, golden)


def test_text_that_is_not_utf8_reaches_the_client_as_replacement_characters() -> None:
    assert "caf\N{REPLACEMENT CHARACTER}" in protocol.encode_json({"message": "caf\udce9"}).decode()


CLIENT: dict[str, dict[str, Any]] = {
    '{"op":"subscribe","subscriptions":[{"id":0,"channelId":3},{"id":1,"channelId":5}]}': {
        "subscriptions": (protocol.FoxgloveSubscription(0, 3), protocol.FoxgloveSubscription(1, 5))
    },
    '{"op":"unsubscribe","subscriptionIds":[0,1]}': {"subscription_ids": (0, 1)},
    '{"op":"advertise","channels":[{"id":4,"topic":"/cmd","encoding":"ros1","schemaName":"std_msgs/String",'
    '"schema":"string data","schemaEncoding":"ros1msg"}]}': {
        "channels": (protocol.ClientChannel(4, "/cmd", "ros1", "std_msgs/String"),)
    },
    '{"op":"unadvertise","channelIds":[1,2]}': {"channel_ids": (1, 2)},
    '{"op":"getParameters","parameterNames":["/a"],"id":"r"}': {"parameter_names": ("/a",), "id_": "r"},
    '{"op":"setParameters","parameters":[{"name":"/a","value":3},{"name":"/b"}]}': {
        "parameters": (
            protocol.FoxgloveParameter(name="/a", value=3),
            protocol.FoxgloveParameter(name="/b"),
        ),
        "id_": None,
    },
    '{"op":"subscribeParameterUpdates","parameterNames":["/a"]}': {"parameter_names": ("/a",)},
    '{"op":"unsubscribeParameterUpdates","parameterNames":[]}': {"parameter_names": ()},
    '{"op":"subscribeConnectionGraph"}': {},
    '{"op":"unsubscribeConnectionGraph","later":1}': {},
    '{"op":"fetchAsset","uri":"package://foo/robot.urdf","requestId":123}': {
        "uri": "package://foo/robot.urdf",
        "request_id": 123,
    },
}


@pytest.mark.parametrize("text", CLIENT)
def test_each_message_of_a_client_is_read(text: str) -> None:
    for data in (text, text.encode()):
        received = protocol.parse_text(data, DECODER)
        assert isinstance(received, OPS[json.loads(text)["op"]])
        assert msgspec.structs.asdict(received) == CLIENT[text]


def test_binary_messages_of_a_client_are_read_without_a_copy() -> None:
    data = bytearray(b"\x01\x04\x00\x00\x00\x02\x00\x00\x00hi")
    message = protocol.parse_binary(data)
    assert (message[0], bytes(message[-1])) == (4, b"\x02\x00\x00\x00hi")
    assert message[-1].obj is data
    call = protocol.parse_binary(struct.pack("<BIII", 2, 1, 12, 4) + b"ros1" + b"\x01")
    assert call == (1, 12, "ros1", memoryview(b"\x01"))


@pytest.mark.parametrize("whole", [b"\x01\x04\x00\x00\x00", struct.pack("<BIII", 2, 1, 12, 4) + b"ros1"])
def test_a_binary_message_that_was_cut_is_refused_at_each_length(whole: bytes) -> None:
    protocol.parse_binary(whole)
    for length in range(len(whole)):
        with pytest.raises(RemoteProtocolError):
            protocol.parse_binary(whole[:length])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "junk",
        "[]",
        "{}",
        '{"op":"nonsense"}',
        '{"op":"subscribe"}',
        '{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]}',
        '{"op":"subscribe","subscriptions":[{"id":4294967296,"channelId":1}]}',
        '{"op":"subscribe","subscriptions":[{"id":1.5,"channelId":1}]}',
        '{"op":"fetchAsset","uri":"\ud800","requestId":1}',
        '{"op":"fetchAsset","uri":"' + "x" * 2000 + '","requestId":1}',
        '{"op":"setParameters","parameters":[{"name":"/a","value":' + "[" * 100_000,
        '{"op":"setParameters","parameters":[{"name":"/a","value":1,"type":"float32"}]}',
        '{"op":"unsubscribe","subscriptionIds":[' + "1," * limits.SUBSCRIPTIONS_MAX + "1]}",
    ],
    ids=lambda text: text[:60],
)
def test_broken_and_hostile_text_is_refused(text: str) -> None:
    with pytest.raises(RemoteProtocolError):
        protocol.parse_text(text, DECODER)


def test_a_frame_beyond_the_limit_is_refused_before_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "TEXT_MAX", 10)
    monkeypatch.setattr(limits, "BINARY_MAX", 10)
    with pytest.raises(LimitExceeded):
        protocol.parse_text('{"op":"subscribeConnectionGraph"}', DECODER)
    with pytest.raises(LimitExceeded):
        protocol.parse_binary(b"\x01" + bytes(10))


@pytest.mark.parametrize(
    "data",
    [b"", b"\x00", b"\x09", struct.pack("<BIII", 2, 1, 1, 400) + b"ros1", struct.pack("<BIII", 2, 1, 1, 1) + b"\xff"],
)
def test_broken_binary_messages_are_refused(data: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        protocol.parse_binary(data)


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
