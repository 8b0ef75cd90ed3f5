"""The Foxglove protocol's messages: golden bytes of foxglove-sdk 0.30.3, and what broken frames come to."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.web.clients.frame_writer import Opcode
from rmpa.web.foxglove import limits, protocol
from rmpa.web.foxglove.channels import Channel, FoxgloveService, graph_update
from rmpa.web.foxglove.session import DECODER, OPS

if TYPE_CHECKING:
    from rmpa.web.clients.frame_writer import OutFrame
    from rmpa.web.hub.node_link import ParamValue

CHATTER = Channel(1, "/chatter", "std_msgs/String", "", "string data")
KIND: Any = SimpleNamespace(
    name="std_srvs/SetBool",
    request=SimpleNamespace(definition="bool data"),
    response=SimpleNamespace(definition="bool success\nstring message"),
)
SET_BOOL = FoxgloveService(1, "/set_bool", KIND)
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
