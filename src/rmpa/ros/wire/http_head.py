"""The head of an HTTP request as rospy, roscpp and Python's tools send it, read in a few microseconds.

A general parser takes a tenth of a millisecond of the loop for it, at each of the thousands of calls of a launch.
What does not look exactly like this is left to that parser: other methods and versions, chunks, rare headers.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

from rmpa.ros import limits

_HEAD: Final = re.compile(
    rb"POST /[\x21-\x7e]{0,1000} HTTP/1\.1\r\n((?:[A-Za-z-]{1,40}: [\x20-\x7e]{0,1000}\r\n){1,20})\r\n"
)
_HARMLESS: Final = frozenset({b"accept", b"accept-encoding", b"content-type", b"user-agent"})
"""Headers that change nothing for us."""

REASONS: Final = {
    200: b"OK",
    400: b"Bad Request",
    405: b"Method Not Allowed",
    413: b"Content Too Large",
    415: b"Unsupported Media Type",
    431: b"Request Header Fields Too Large",
}
"""Of the statuses that we answer with."""


class Head(NamedTuple):
    """A request.

    Args:
        end: Where its body begins.
        length: How many bytes that has.
        close: Whether the connection shall end with the answer.
    """

    end: int
    length: int
    close: bool


def plain_head(data: bytes | bytearray) -> Head | None:
    """The head of a POST with a length and nothing unusual, or ``None`` for all else, an unfinished one too."""
    match = _HEAD.match(data)
    if match is None:
        return None
    length, hosts, close = -1, 0, False
    for line in match[1].split(b"\r\n")[:-1]:
        name, _, value = line.partition(b": ")
        name = name.lower()
        if name == b"content-length":
            if length >= 0 or not value.isdigit() or len(value) > 9:
                return None
            length = int(value)
        elif name == b"connection" and value in {b"close", b"keep-alive"}:
            close = close or value == b"close"
        elif name == b"host":
            hosts += 1
        elif name not in _HARMLESS:
            return None
    return Head(match.end(), length, close) if hosts == 1 and 0 <= length <= limits.HTTP_BODY_MAX else None
