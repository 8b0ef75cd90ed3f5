"""Fuzz target: TCPROS message framing, and messages of learnt types."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros import limits
from rmpa.ros.types.definitions import SEPARATOR
from rmpa.ros.types.messages import MessageError, MessageType
from rmpa.ros.wire.tcpros import frame_message, split_messages

_JOY = MessageType("sensor_msgs/Joy")
_HEADER = f"{SEPARATOR}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
_LEARNT = MessageType.learn("my_msgs/All", f"time[] t\nstring[] s\nbool[3] b\nHeader h\n{_HEADER}")

SEEDS: list[bytes] = [
    b"",
    frame_message(b""),
    frame_message(b"abc") + frame_message(b"") + b"\x05\x00\x00\x00he",
    frame_message(_JOY.serialize(_JOY.make({"axes": [1.0], "buttons": [1, 2]}))),
    frame_message(_LEARNT.serialize(_LEARNT.make({"t": [1.5], "s": ["a", "b"], "h": {"frame_id": "x"}}))),
    b"\xff\xff\xff\xff",
]


def fuzz(data: bytes) -> None:
    """Every whole message once and in order, however the bytes are cut; each read, or refused by its type."""
    try:
        messages, consumed, wanted = split_messages(memoryview(data))
    except RemoteProtocolError:
        return
    if b"".join(messages) != data[:consumed] or wanted > limits.TCPROS_MESSAGE_MAX + 4:
        raise AssertionError("messages are not what was consumed")
    half = len(data) // 2
    first, start, _ = split_messages(memoryview(data[:half]))
    rest: list[memoryview] = []
    if start < len(data):
        try:
            rest, _, _ = split_messages(memoryview(data[start:]))
        except RemoteProtocolError:
            rest = []
    if [bytes(m) for m in (*first, *rest)] != [bytes(m) for m in messages]:
        raise AssertionError("a cut changes the messages")
    for message in messages[:4]:
        for kind in (_JOY, _LEARNT):
            try:
                kind.to_plain(kind.deserialize(message[4:]))
            except MessageError as error:
                str(error)
