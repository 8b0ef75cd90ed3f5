"""How a client subscribes in each protocol and encoding, and where a measured message begins in what it gets."""

from __future__ import annotations

import base64
import json
import re
from typing import TYPE_CHECKING, Final, Literal

from lab.nodes.node import HEAD

if TYPE_CHECKING:
    from lab.web.websocket import WebSocket

# Foxglove's protocol, or an encoding of rosbridge's.
How = Literal["foxglove", "cbor-raw", "cbor", "json"]
HOWS: Final[tuple[How, ...]] = ("foxglove", "cbor-raw", "cbor", "json")
# Of the measured messages.
TYPE: Final = "std_msgs/UInt8MultiArray"
# The only subprotocol that foxglove-sdk's server accepts.
FOXGLOVE: Final = "foxglove.sdk.v1"
# Bytes of a ROS 1 message of ``TYPE`` before its data: no dimensions, the offset, and the data's length.
_LAYOUT: Final = 12
_DATA_OPCODE: Final = 1
# Of a Foxglove message: opcode, subscription (4 bytes), time (8).
_DATA_HEADER: Final = 13
_JSON: Final = re.compile(r'"data":\s*"([A-Za-z0-9+/=]{24})')
# The key before the byte string that matters, with its CBOR head: text of 5 and of 4 bytes.
_CBOR: Final = {"cbor-raw": b"ebytes", "cbor": b"ddata"}


def protocol_of(how: How) -> str:
    """The WebSocket subprotocol."""
    return FOXGLOVE if how == "foxglove" else ""


def subscribe(client: WebSocket, how: How, topic: str) -> None:
    """Subscribe; returns when the server has been asked.

    Raises:
        BedError: The server closed the connection, or does not advertise the topic.
    """
    if how != "foxglove":
        compression = "none" if how == "json" else how
        client.send(json.dumps({"op": "subscribe", "topic": topic, "type": TYPE, "compression": compression}))
        return
    channel = wait_channel(client, topic)
    client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel}]}))


def wait_channel(client: WebSocket, topic: str) -> int:
    """The channel of a topic, as soon as a Foxglove server advertises it.

    Raises:
        BedError: The server closed the connection, or does not advertise it in time.
    """
    while True:
        text = client.receive()
        if not isinstance(text, str):
            continue
        message = json.loads(text)
        if message.get("op") == "advertise":
            for channel in message["channels"]:
                if channel["topic"] == topic:
                    return int(channel["id"])


def head_of(message: str | bytes, how: How) -> tuple[int, int, int] | None:
    """Round, sequence and due ns of a measured message; ``None``: it is none.

    Args:
        message: What the server sent.
        how: The protocol and encoding.
    """
    data, at = message if isinstance(message, bytes) else b"", -1
    if how == "foxglove":
        at = _DATA_HEADER + _LAYOUT if data[:1] == bytes((_DATA_OPCODE,)) else -1
    elif how == "json":
        found = _JSON.search(message) if isinstance(message, str) else None
        data, at = (base64.b64decode(found[1]), 0) if found else (b"", -1)
    else:
        at = _byte_string(data, _CBOR[how])
        at += _LAYOUT if at >= 0 and how == "cbor-raw" else 0
    if at < 0 or len(data) < at + HEAD.size:
        return None
    number, sequence, due = HEAD.unpack_from(data, at)
    return number, sequence, due


def _byte_string(data: bytes, key: bytes) -> int:
    """Where the content of the CBOR byte string behind a key begins; -1 where there is none (RFC 8949, section 3)."""
    at = data.find(key)
    while at >= 0:
        at += len(key)
        tagged = data[at : at + 2] == b"\xd8\x40"  # tag 64: a typed array of uint8
        at += 2 if tagged else 0
        initial = data[at] if at < len(data) else 0
        if initial >> 5 == 2:
            size = initial & 0x1F
            return at + 1 + ({24: 1, 25: 2, 26: 4, 27: 8}.get(size, 0))
        at = data.find(key, at)
    return -1
