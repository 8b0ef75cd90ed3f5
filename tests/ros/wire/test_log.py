"""Messages of /rosout: read as far as their text, and renamed."""

from __future__ import annotations

import pytest

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.log import parse_log, renamed

KIND = MessageType("rosgraph_msgs/Log")
FIELDS = {"level": 8, "name": "/driver", "msg": "too hot: 90 °C", "file": "a.cpp", "line": 7, "topics": ["/a", "/b"]}
STAMP = {"secs": 12, "nsecs": 500_000_000}


def framed() -> bytes:
    """The message with its length in front."""
    payload = bytes(
        codec_for(KIND).write({"header": {"seq": 3, "stamp": STAMP, "frame_id": "base"}, **FIELDS}, 0).payload
    )
    return len(payload).to_bytes(4, "little") + payload


def test_a_message_is_read_as_far_as_its_text() -> None:
    assert parse_log(framed(), 100) == ("/driver", 8, 12_500_000_000, "too hot: 90 °C".encode())
    assert parse_log(framed(), 7).text == "too hot… 8 bytes more".encode()


def test_a_renamed_message_differs_in_its_node_alone() -> None:
    again = renamed(framed(), "/rmpa/arm/driver")
    assert again == framed().replace(b"\x07\0\0\0/driver", b"\x10\0\0\0/rmpa/arm/driver").replace(
        framed()[:4], len(again[4:]).to_bytes(4, "little"), 1
    )
    assert parse_log(again, 100).node == "/rmpa/arm/driver"


def test_a_part_of_a_message_is_none() -> None:
    whole = framed()
    text_ends = whole.index("°C".encode()) + 3
    for end in range(text_ends):
        with pytest.raises(RemoteProtocolError):
            parse_log(whole[:end], 100)
    for end in range(whole.index(b"/driver") + 7):
        with pytest.raises(RemoteProtocolError):
            renamed(whole[:end], "/x")
