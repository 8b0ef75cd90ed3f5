"""The protocol of the control socket: one JSON object a line each way.

::

    {"op": "ping", "args": {"peer": "base", "count": 1}}
    {"ok": true, "value": {"times": [0.0004], "remote": "10.0.0.2:40001"}}
    {"ok": false, "error": "no peer named 'bse'", "remedy": "did you mean base?"}

A long ``text`` in the arguments or the value is not part of the JSON, whose reading would delay data: ``follows`` has
the number of its bytes, and they follow the line.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.bridge.messages import without_text
from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.observe import limits
from rmpa.observe.json_pieces import json_pieces

if TYPE_CHECKING:
    from rmpa.core.counters import Yielder

_T = TypeVar("_T")
ROLE: Final = "role"
"""The operation that only an agent with another role than a module's serves; its value names that."""
GATEWAY_ROLE: Final = "gateway"
"""The role of the agent in ``rmpa gateway``."""
GATEWAY_REPORT: Final = "gateway"
"""The operation of a gateway that says what it joins; its ``problem`` is why it joins nothing."""


def _parse(line: bytes, type_: type[_T], what: str, most: int) -> _T:
    if len(line) > most:
        raise LimitExceeded(f"a {what}", len(line), most)
    try:
        return msgspec.json.decode(line, type=type_)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise RemoteProtocolError(f"not a {what}: {error}") from None


class ControlRequest(msgspec.Struct, frozen=True, omit_defaults=True):
    """A client's request.

    Attributes:
        op: The name of an operation (``control_operations.REPLIES``).
        args: Its arguments, by name.
        follows: Bytes of the argument ``text`` that follow the line.
    """

    op: str
    args: dict[str, object] = {}
    follows: int = 0

    @classmethod
    def parse(cls, line: bytes) -> ControlRequest:
        """Parse one line, with or without its end.

        Raises:
            RemoteProtocolError: It is not a request.
        """
        return _parse(line, cls, "control request", limits.CONTROL_REQUEST_MAX)

    def serialize(self) -> bytes:
        """One line."""
        args, text = without_text(self.args)
        return msgspec.json.encode(msgspec.structs.replace(self, args=args, follows=len(text))) + b"\n" + text

    def __str__(self) -> str:
        """The op and the names of its arguments, safe to log."""
        shown = f"{self.op}({', '.join(self.args)})"
        return shown[:200].encode("unicode_escape").decode("ascii")


class ControlReply(msgspec.Struct, frozen=True, omit_defaults=True):
    """The agent's reply.

    Attributes:
        ok: Whether ``value`` is the result; else ``error`` says why there is none and ``remedy`` what to do.
        value: Anything that JSON can hold.
        error: What happened.
        remedy: What to do; may be empty.
        follows: Bytes of the value's ``text`` that follow the line.
    """

    ok: bool
    value: Any = None  # the edge: each operation has its own type, and its caller converts the value
    error: str = ""
    remedy: str = ""
    follows: int = 0

    @classmethod
    def parse(cls, line: bytes) -> ControlReply:
        """Parse one line, with or without its end.

        Raises:
            RemoteProtocolError: It is not a reply.
        """
        return _parse(line, cls, "control reply", limits.CONTROL_REPLY_MAX)

    def serialize(self, yielder: Yielder = iter) -> bytes:
        """One line.

        Args:
            yielder: Yields to data between the pieces of a large reply, which take some 50 microseconds each.

        Raises:
            LocalProtocolError: The value is something that JSON cannot hold, or too large.
        """
        try:
            value, text = without_text(self.value)
            reply = msgspec.structs.replace(self, value=value, follows=len(text))
            line = b"".join((*yielder(json_pieces(reply)), b"\n", text))
        except (TypeError, ValueError, RecursionError) as error:
            raise LocalProtocolError(f"a handler's value is not JSON: {error}") from None
        if len(line) > limits.CONTROL_REPLY_MAX:
            raise LocalProtocolError(f"a reply of {len(line)} bytes is more than {limits.CONTROL_REPLY_MAX}")
        return line
