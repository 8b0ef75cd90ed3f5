"""A message of /rosout, rosgraph_msgs/Log, with its length in front: read as far as its text, and renamed.

Each message of roscpp has the names of all topics of its node behind that, which are not read.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.wire.tcpros import LENGTH, Buffer

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
    stamp_ns, at = _begin(view)
    name, end = _string(view, at, _NAME_MAX)
    text, _ = _string(view, end, most)
    return LogMessage(str(name, "utf-8", "replace"), view[at - 1], stamp_ns, text)


def _begin(view: memoryview) -> tuple[int, int]:
    """The stamp in nanoseconds, and where the node's name begins, behind the level."""
    if len(view) < _BEGIN.size:
        raise _none(view)
    _, _, seconds, nanoseconds, frame = _BEGIN.unpack_from(view)
    return seconds * 1_000_000_000 + nanoseconds, _BEGIN.size + frame + 1


def _none(view: memoryview) -> RemoteProtocolError:
    return RemoteProtocolError(f"{len(view)} bytes are no rosgraph_msgs/Log")


def _string(view: memoryview, at: int, most: int) -> tuple[bytes, int]:
    """A string, and where the next field begins."""
    start = at + LENGTH.size
    if start > len(view) or start + (size := LENGTH.unpack_from(view, at)[0]) > len(view):
        raise _none(view)
    if size <= most:
        return bytes(view[start : start + size]), start + size
    return bytes(view[start : start + most]) + f"… {size - most:,} bytes more".encode(), start + size


def renamed(framed: Buffer, node: str) -> bytes:
    """The same message as if another node had written it.

    Raises:
        RemoteProtocolError: It is none.
    """
    view, name = memoryview(framed), node.encode()
    _, start = _begin(view)
    _, end = _string(view, start, _NAME_MAX)
    body = b"".join((view[LENGTH.size : start], LENGTH.pack(len(name)), name, view[end:]))
    return LENGTH.pack(len(body)) + body
