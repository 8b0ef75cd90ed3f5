"""Collects the body of an XML-RPC call; a call that is too large is answered with an XML-RPC fault.

A fault is the only error that ROS's clients show: ``rospy.set_param`` ignores a status of -1 and xmlrpc.client hides
the text of an HTTP error, while ``rosparam`` and ``roslaunch`` print a fault's text. A client reads no answer before
it has sent its whole call, so a refused call is read to its end, but only its beginning is kept.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from rmpa.core.limits import KIB
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Callable

_METHOD: Final = re.compile(rb"<methodName>\s*([A-Za-z0-9_.]{1,64})\s*</methodName>")
_TEXTS: Final = re.compile(rb"<value>\s*(?:<string>)?([^<]{1,256})(?:</string>)?\s*</value>")
_BEGIN: Final = 4 * KIB
"""Bytes of a refused call that are kept, to name the call in the fault."""


class CallBody:
    """Collects one body after the other.

    Args:
        reserve: ``(bytes) -> whether there is room``: called once for each large call.
    """

    __slots__ = ("_data", "_left_out", "_reserve", "_why", "reserved")

    def __init__(self, reserve: Callable[[int], bool]) -> None:
        self._reserve = reserve
        self._data = bytearray()
        self._left_out = 0
        self._why: Callable[[bytes | bytearray, int], str] | None = None
        self.reserved = 0
        """Bytes reserved for the present call, until ``answered``."""

    def __len__(self) -> int:
        """Bytes received."""
        return len(self._data) + self._left_out

    @property
    def refused(self) -> bool:
        """Whether the call is too large: its bytes are dropped."""
        return self._why is not None

    def expect(self, size: int) -> bool:
        """Announce the size of a body that has a Content-length; return whether it is accepted."""
        if size > limits.HTTP_BODY_MAX:
            self._why = too_large
        elif size > limits.HTTP_BODY_INLINE and not self.reserved:
            if self._reserve(size):
                self.reserved = size
            else:
                self._why = too_many
        return self._why is None

    def add(self, data: bytes | bytearray) -> None:
        """Add a part."""
        size = len(self) + len(data)
        if self._why is None and size > limits.HTTP_BODY_INLINE:
            # A body in chunks has no announced size.
            self.expect(max(size, limits.HTTP_BODY_MAX))
        if self._why is None:
            self._data += data
        else:
            del self._data[_BEGIN:]
            self._data += data[: _BEGIN - len(self._data)]
            self._left_out = size - len(self._data)

    def end(self) -> tuple[memoryview, str]:
        """Return the whole body and an empty text; for a refused one its beginning and the text of the fault."""
        data, size, why = self._data, len(self), self._why
        self._data, self._left_out, self._why = bytearray(), 0, None
        return memoryview(data), why(data, size) if why is not None else ""

    def answered(self) -> None:
        """Release the reserved bytes, because the call is answered."""
        self.reserved = 0


def call_name(begin: bytes | bytearray) -> str:
    """A call's method, with the key if it is about a parameter: ``setParam /map``; ``a call`` if it is unknown.

    Args:
        begin: The first bytes of the call.
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
    """The text of the fault for a call of ``size`` bytes, with the limit and a remedy."""
    limit = limit or limits.HTTP_BODY_MAX
    return (
        f"{call_name(begin)}: {size} bytes, above the {limit} ({limit >> 20} MiB) of one call; set its parts one by "
        "one, keep large data in a file and its path in the parameter, or publish it on a latched topic"
    )


def too_many(begin: bytes | bytearray, size: int) -> str:
    """The text of the fault for a call that does not fit beside those under way."""
    return (
        f"{call_name(begin)}: {size} bytes beside other large calls, above the {limits.HTTP_BODIES_MAX >> 20} MiB of "
        "all that are under way; try again in a moment"
    )
