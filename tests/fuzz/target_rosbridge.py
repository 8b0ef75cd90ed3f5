"""Fuzz target: a rosbridge client's frames, text and binary, one after the other in one session, and its messages."""

from __future__ import annotations

import base64
import json
from typing import Any

import cbor2

from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.messages import MessageError, MessageType
from rmpa.web.rosbridge.protocol import encode_png
from tests.web.recorder import answer, decoded
from tests.web.rosbridge.client import Client

_SPLIT = b"\x1e"
_TYPES = ("std_msgs/String", "sensor_msgs/PointCloud2", "tf2_msgs/TFMessage", "diagnostic_msgs/DiagnosticArray")


def _ops(*ops: dict[str, Any]) -> bytes:
    return _SPLIT.join(b"T" + json.dumps(op).encode() for op in ops)


SEEDS: list[bytes] = [
    b"",
    _ops(
        {"op": "advertise", "topic": "/t", "type": "geometry_msgs/PoseStamped", "id": "a", "latch": True},
        {"op": "publish", "topic": "/t", "msg": {"header": {"stamp": "now"}, "pose": {"position": {"x": None}}}},
        {"op": "unadvertise", "topic": "/t"},
    ),
    _ops(
        {"op": "subscribe", "topic": "/t", "throttle_rate": 5, "queue_length": 2, "fragment_size": 10},
        {"op": "subscribe", "topic": "/t", "id": 5, "compression": "png"},
        {"op": "unsubscribe", "topic": "/t", "id": 5},
        {"op": "set_level", "level": "info"},
    ),
    _ops(
        {"op": "call_service", "service": "/rosapi/get_param", "args": ["/a", "{}"], "id": "x"},
        {"op": "call_service", "service": "/rosapi/set_param", "args": {"name": "/a", "value": "[1]"}},
        {"op": "advertise_service", "service": "/s", "type": "rospy_tutorials/AddTwoInts"},
        {
            "op": "service_response",
            "service": "/s",
            "id": "service_request:/s:1",
            "values": {"sum": 1},
            "result": True,
        },
    ),
    _ops(
        {"op": "fragment", "id": "f", "data": '{"op": "status"', "num": 0, "total": 2},
        {"op": "fragment", "id": "f", "data": "}", "num": 1, "total": 2},
        decoded(encode_png(b'{"op": "status"}')),
    ),
    b"B" + cbor2.dumps({"op": "publish", "topic": "/typed", "msg": {"data": cbor2.CBORTag(85, bytes(8))}}),
    b"M\x00\x05\x00\x00\x00hello",
    b"M\x02\x01\x00\x00\x00" + bytes(90),
    b"P" + base64.b64decode(decoded(encode_png(b'{"op": "status"}'))["data"]),
]


def fuzz(data: bytes) -> None:
    """Whatever comes in: no exception, and all frames to the client can be read."""
    client = Client()
    client.graph.add_topic("/typed", "std_msgs/Float32MultiArray")
    for part in data.split(_SPLIT):
        kind, rest = part[:1], part[1:]
        if kind == b"M":
            _message(rest)
            continue
        if kind == b"P":
            frame: str | bytes = json.dumps({"op": "png", "data": base64.b64encode(rest).decode()})
        else:
            frame = rest if kind == b"B" else rest.decode(errors="surrogateescape")
        for asked in client.send_raw(frame):
            answer(asked, rest)
        client.advance(0.01)
    client.advance(100)
    for each in client.received():
        assert "op" in each


def _message(raw: bytes) -> None:
    codec = codec_for(MessageType(_TYPES[raw[0] % len(_TYPES)] if raw else _TYPES[0]))
    payload = memoryview(raw[1:])
    try:
        text = codec.json(payload)
    except MessageError:
        return
    cbor2.loads(cbor2.dumps(codec.cbor_values(payload)))
    codec.write(json.loads(text), 0)
