"""A message of /rosout, rosgraph_msgs/Log, with its length in front: read as far as its text, and renamed.

Each message of roscpp has the names of all topics of its node behind that, which are not read.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final, NamedTuple

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.wire.tcpros import LENGTH

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import Buffer

# The message's length, and its header: seq, the stamp's seconds and nanoseconds, the length of frame_id.
_BEGIN: Final = struct.Struct("<IIIII")
# Of a node's name.
_NAME_MAX: Final = 1024


class LogMessage(NamedTuple):
    """What a node says.

    Attributes:
        node: Its name, as it says.
        level: 1 debug, 2 info, 4 warn, 8 error, 16 fatal; any other number up to 255 may come.
        stamp_ns: Nanoseconds of the node's clock.
        text: UTF-8, as the node says; a long one is cut, and says so.
    """

    node: str
    level: int
    stamp_ns: int
    text: bytes


def parse_log(framed: Buffer, most: int) -> LogMessage:
    """Read a message, of its text at most so many bytes.

    Raises:
        RemoteProtocolError: It is none.
    """
    view = memoryview(framed)
    try:
        _, _, seconds, nanoseconds, frame = _BEGIN.unpack_from(view)
        at = _BEGIN.size + frame
        level = view[at]
        name, at = _string(view, at + 1, _NAME_MAX)
        text, _ = _string(view, at, most)
    except (struct.error, IndexError):
        raise RemoteProtocolError(f"{len(view)} bytes are no rosgraph_msgs/Log") from None
    return LogMessage(str(name, "utf-8", "replace"), level, seconds * 1_000_000_000 + nanoseconds, text)


def _string(view: memoryview, at: int, most: int) -> tuple[bytes, int]:
    """A string, and where the next field begins."""
    start = at + LENGTH.size
    size = LENGTH.unpack_from(view, at)[0]
    if start + size > len(view):
        raise IndexError
    if size <= most:
        return bytes(view[start : start + size]), start + size
    return bytes(view[start : start + most]) + f"… {size - most:,} bytes more".encode(), start + size


def renamed(framed: Buffer, node: str) -> bytes:
    """The same message as if another node had written it.

    Raises:
        RemoteProtocolError: It is none.
    """
    view = memoryview(framed)
    try:
        start = _BEGIN.size + _BEGIN.unpack_from(view)[4] + 1
        _, end = _string(view, start, _NAME_MAX)
    except (struct.error, IndexError):
        raise RemoteProtocolError(f"{len(view)} bytes are no rosgraph_msgs/Log") from None
    name = node.encode()
    body = b"".join((view[LENGTH.size : start], LENGTH.pack(len(name)), name, view[end:]))
    return LENGTH.pack(len(body)) + body
