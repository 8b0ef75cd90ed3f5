"""A measured message is recognised in each encoding, as ``rmpa web`` and rosbridge_suite's library write it."""

from __future__ import annotations

import json
import struct
from base64 import b64encode
from typing import TYPE_CHECKING

import cbor2
import pytest

from lab.nodes.node import HEAD
from lab.web.subscriptions import How, head_of
from lab.web.websocket import BINARY, TEXT, Frame
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.messages import MessageType
from rmpa.web.gateways.frame_writer import Opcode
from rmpa.web.rosbridge.protocol import Compression, PublishFrames, encode_cbor_raw

if TYPE_CHECKING:
    from collections.abc import Callable

DATA = HEAD.pack(7, 123_456, 1 << 60) + b"\x07" * 1000
PAYLOAD = memoryview(struct.pack("<III", 0, 0, len(DATA)) + DATA)
TYPE = "std_msgs/UInt8MultiArray"
LAYOUT = {"dim": [], "data_offset": 0}


def ours(how: How) -> Frame:
    if how == "cbor-raw":
        made = encode_cbor_raw("/for_rmpa", PAYLOAD, 5)
    else:
        compression = Compression.CBOR if how == "cbor" else Compression.NONE
        made = PublishFrames().encode("/for_rmpa", PAYLOAD, compression, codec_for(MessageType(TYPE)))
    opcode, parts = made
    data = b"".join(parts)
    return Frame(BINARY if opcode is Opcode.BINARY else TEXT, len(data), data[:512])


def theirs(how: How) -> Frame:
    head = {"op": "publish", "topic": "/for_suite"}
    if how == "json":
        text = json.dumps({**head, "msg": {"layout": LAYOUT, "data": b64encode(DATA).decode()}}).encode()
        return Frame(TEXT, len(text), text[:512])
    raw = {"secs": 1, "nsecs": 2, "bytes": bytes(PAYLOAD)}
    data = cbor2.dumps({**head, "msg": raw if how == "cbor-raw" else {"layout": LAYOUT, "data": DATA}})
    return Frame(BINARY, len(data), data[:512])


@pytest.mark.parametrize("make", [ours, theirs])
@pytest.mark.parametrize("how", ["cbor-raw", "cbor", "json"])
def test_the_head_of_a_message_is_found_in_a_publish(make: Callable[[How], Frame], how: How) -> None:
    assert head_of(make(how), how) == (7, 123_456, 1 << 60)


def test_the_head_of_a_message_is_found_in_foxglove_s_frame() -> None:
    data = struct.pack("<BIQ", 1, 3, 99) + PAYLOAD
    assert head_of(Frame(BINARY, len(data), data[:512]), "foxglove") == (7, 123_456, 1 << 60)


@pytest.mark.parametrize("how", ["cbor-raw", "cbor", "json", "foxglove"])
@pytest.mark.parametrize("frame", [Frame(TEXT, 40, b'{"op":"status","level":"error"}'), Frame(BINARY, 3, b"\x02ab")])
def test_what_is_no_message_is_none(how: How, frame: Frame) -> None:
    assert head_of(frame, how) is None
