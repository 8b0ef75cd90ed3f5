"""The words of the control socket: one JSON object a line each way.

::

    {"op": "ping", "args": {"peer": "base", "count": 1}}
    {"ok": true, "value": {"times": [0.0004], "remote": "10.0.0.2:40001"}}
    {"ok": false, "error": "no peer named 'bse'", "remedy": "did you mean base?"}
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.observe import limits
from rmpa.observe.json_pieces import json_pieces

if TYPE_CHECKING:
    from rmpa.core.yielding import Yielder


class ControlRequest(msgspec.Struct, frozen=True):
    """What a client asks.

    Attributes:
        op: A handler's name.
        args: What that handler wants, by name.
    """

    op: str
    args: dict[str, object] = {}

    @classmethod
    def parse(cls, line: bytes) -> ControlRequest:
        """Read one line, with or without its end.

        Raises:
            RemoteProtocolError: It is no request.
        """
        if len(line) > limits.CONTROL_REQUEST_MAX:
            raise LimitExceeded("a control request", len(line), limits.CONTROL_REQUEST_MAX)
        try:
            return msgspec.json.decode(line, type=cls)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
            raise RemoteProtocolError(f"not a control request: {error}") from None

    def serialize(self) -> bytes:
        """One line."""
        return msgspec.json.encode(self) + b"\n"

    def __str__(self) -> str:
        """The op and the names of its arguments, safe to log."""
        shown = f"{self.op}({', '.join(self.args)})"
        return shown[:200].encode("unicode_escape").decode("ascii")


class ControlReply(msgspec.Struct, frozen=True, omit_defaults=True):
    """What the agent answers.

    Attributes:
        ok: Whether ``value`` is the answer; else ``error`` says why not and ``remedy`` what to do.
        value: Anything that JSON can say.
        error: What happened.
        remedy: What to do; may be empty.
    """

    ok: bool
    value: Any = None  # the edge: each op has its own type, and its caller converts it
    error: str = ""
    remedy: str = ""

    @classmethod
    def parse(cls, line: bytes) -> ControlReply:
        """Read one line, with or without its end.

        Raises:
            RemoteProtocolError: It is no reply.
        """
        if len(line) > limits.CONTROL_REPLY_MAX:
            raise LimitExceeded("a control reply", len(line), limits.CONTROL_REPLY_MAX)
        try:
            return msgspec.json.decode(line, type=cls)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
            raise RemoteProtocolError(f"not a control reply: {error}") from None

    def serialize(self, breathing: Yielder = iter) -> bytes:
        """One line.

        Args:
            breathing: For the pieces of a large one, some 50 microseconds each.

        Raises:
            LocalProtocolError: A handler returned something that JSON cannot say, or too much of it.
        """
        try:
            line = b"".join((*breathing(json_pieces(self)), b"\n"))
        except (TypeError, ValueError, RecursionError) as error:
            raise LocalProtocolError(f"a handler's value is not JSON: {error}") from None
        if len(line) > limits.CONTROL_REPLY_MAX:
            raise LocalProtocolError(f"a reply of {len(line)} bytes is more than {limits.CONTROL_REPLY_MAX}")
        return line
