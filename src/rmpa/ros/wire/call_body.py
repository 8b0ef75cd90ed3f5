"""The body of an XML-RPC call as it comes, and what the caller of one that is too large is told: an XML-RPC fault.

Of the ways to say no, a fault is the one that ROS's clients show: ``rospy.set_param`` ignores a status of -1 and
xmlrpc.client hides the text of an HTTP error. ``rosparam`` and ``roslaunch`` print the fault's text. A client reads
no answer before it has sent its whole call, so a refused one is read to its end; only its beginning is kept.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from rmpa.core.sizes import KIB
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Callable

_METHOD: Final = re.compile(rb"<methodName>\s*([A-Za-z0-9_.]{1,64})\s*</methodName>")
_TEXTS: Final = re.compile(rb"<value>\s*(?:<string>)?([^<]{1,256})(?:</string>)?\s*</value>")
_BEGIN: Final = 4 * KIB
"""Bytes of a refused call that are kept to say what it was."""


class CallBody:
    """Takes one body after the other.

    Args:
        reserve: ``(bytes) -> whether there is room``: asked once for each large call.
    """

    __slots__ = ("_data", "_left_out", "_reserve", "_why", "reserved")

    def __init__(self, reserve: Callable[[int], bool]) -> None:
        self._reserve = reserve
        self._data = bytearray()
        self._left_out = 0
        self._why: Callable[[bytes | bytearray, int], str] | None = None
        self.reserved = 0
        """Bytes that are set aside for the present call, until ``answered``."""

    def __len__(self) -> int:
        """Bytes that have come."""
        return len(self._data) + self._left_out

    @property
    def refused(self) -> bool:
        """Whether what comes now is only read to be refused."""
        return self._why is not None

    def expect(self, size: int) -> bool:
        """Say how many bytes a body will have, if its head tells; whether it is taken."""
        if size > limits.HTTP_BODY_MAX:
            self._why = too_large
        elif size > limits.HTTP_BODY_INLINE and not self.reserved:
            if self._reserve(size):
                self.reserved = size
            else:
                self._why = too_many
        return self._why is None

    def add(self, data: bytes | bytearray) -> None:
        """Take a part."""
        size = len(self) + len(data)
        if self._why is None and size > limits.HTTP_BODY_INLINE:
            # One that comes in chunks tells only now that it is large.
            self.expect(max(size, limits.HTTP_BODY_MAX))
        if self._why is None:
            self._data += data
        else:
            del self._data[_BEGIN:]
            self._data += data[: _BEGIN - len(self._data)]
            self._left_out = size - len(self._data)

    def end(self) -> tuple[memoryview, str]:
        """The whole body and an empty text; or of a refused one its beginning, and what its caller is told."""
        data, size, why = self._data, len(self), self._why
        self._data, self._left_out, self._why = bytearray(), 0, None
        return memoryview(data), why(data, size) if why is not None else ""

    def answered(self) -> None:
        """The call is answered: it needs no room any more."""
        self.reserved = 0


def call_name(begin: bytes | bytearray) -> str:
    """What a call is, by its first bytes: ``setParam /map``, ``system.multicall``; ``a call`` where they do not tell.

    Args:
        begin: At least its method, its caller and, for a parameter, the key.
    """
    method = _METHOD.search(begin)
    if method is None:
        return "a call"
    name = method[1].decode("ascii")
    texts = _TEXTS.findall(begin, method.end())
    if "Param" in name and len(texts) > 1:
        name += " " + texts[1].decode("utf-8", "replace")
    return name


def too_large(begin: bytes | bytearray, size: int, limit: int = 0) -> str:
    """The text for a call of ``size`` bytes, the bound and the remedy included."""
    limit = limit or limits.HTTP_BODY_MAX
    return (
        f"{call_name(begin)}: {size} bytes, above the {limit} ({limit >> 20} MiB) of one call; set its parts one by "
        "one, keep large data in a file and its path in the parameter, or publish it on a latched topic"
    )


def too_many(begin: bytes | bytearray, size: int) -> str:
    """The text for a call that has no room beside those under way."""
    return (
        f"{call_name(begin)}: {size} bytes beside other large calls, above the {limits.HTTP_BODIES_MAX >> 20} MiB of "
        "all that are under way; try again in a moment"
    )
