"""The protocol of the control socket: requests, replies, the snapshot as JSON, changes of the graph.

The protocol of the control socket: one JSON object a line each way.

::

    {"op": "ping", "args": {"peer": "base", "count": 1}}
    {"ok": true, "value": {"times": [0.0004], "remote": "10.0.0.2:40001"}}
    {"ok": false, "error": "no peer named 'bse'", "remedy": "did you mean base?", "code": "unknown-name"}

A long ``text`` in the arguments or the value is not part of the JSON, whose reading would delay data: ``follows`` has
the number of its bytes, and they follow the line.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self

import msgspec

from rmpa.bridge.messages import without_text
from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.observe import limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rmpa.core.timers import Yielder


class ReloadReply(msgspec.Struct, kw_only=True, frozen=True):
    """The settings as read again, against those that the agent runs with.

    Attributes:
        file: The file that was read, or empty if there is none.
        changed: The keys whose new values hold from now on (or would, for a check): ``bridge.deny``, ``[[peer]]``.
        restart: Those that hold after a restart only, each with both values: ``mesh.port (40001 instead of 0)``.
        notes: Doubtful settings, each ready to read.
        problem: Why the settings cannot be used, with the file's line, and nothing has changed; empty if they can.
        code: The problem's code (``core.codes``).
    """

    file: str = ""
    changed: tuple[str, ...] = ()
    restart: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    problem: str = ""
    code: str = ""


# Elements of a list in one piece: some 50 microseconds where they are topics.
_BATCH: Final = 16


def json_pieces(value: object) -> Iterator[bytes]:
    """The output of ``msgspec.json.encode`` in pieces: long lists, also those in fields of structs, are cut.

    Args:
        value: Must not change meanwhile.

    Raises:
        TypeError, ValueError, RecursionError: JSON cannot hold it.
    """
    if isinstance(value, list | tuple) and len(value) > _BATCH:
        yield from _list(value)
    elif isinstance(value, msgspec.Struct) and not type(value).__struct_config__.tag:
        yield from _struct(value)
    else:
        yield msgspec.json.encode(value)


def _list(values: Sequence[object]) -> Iterator[bytes]:
    for begin in range(0, len(values), _BATCH):
        yield b"[" if begin == 0 else b","
        yield msgspec.json.encode(values[begin : begin + _BATCH])[1:-1]
    yield b"]"


def _struct(value: msgspec.Struct) -> Iterator[bytes]:
    separator = b"{"
    for name, start, default in _members(type(value)):
        content = getattr(value, name)
        if default is not msgspec.NODEFAULT and content == default:
            continue
        yield separator + start
        yield from json_pieces(content)
        separator = b","
    yield b"{}" if separator == b"{" else b"}"


@functools.cache  # to read the annotations of a type takes as long as to write a small struct
def _members(kind: type[msgspec.Struct]) -> tuple[tuple[str, bytes, object], ...]:
    """Of each field its name, its JSON up to the value, and the value that is left out, ``NODEFAULT`` for none."""
    omit = kind.__struct_config__.omit_defaults
    return tuple(
        (each.name, msgspec.json.encode(each.encode_name) + b":", _default(each) if omit else msgspec.NODEFAULT)
        for each in msgspec.structs.fields(kind)
    )


def _default(field: msgspec.structs.FieldInfo) -> object:
    return field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()


# The operation that only an agent with another role than a module's serves; its value names that.
ROLE: Final = "role"
# The role of the agent in ``rmpa gateway``.
GATEWAY_ROLE: Final = "gateway"
# The operation of a gateway that says what it joins; its ``problem`` is why it joins nothing.
GATEWAY_REPORT: Final = "gateway"


class _Line(msgspec.Struct, frozen=True, omit_defaults=True):
    """A line of the protocol."""

    _NAME: ClassVar[str]
    _MOST: ClassVar[int]

    @classmethod
    def parse(cls, line: bytes) -> Self:
        """Parse one line, with or without its end.

        Raises:
            RemoteProtocolError: It is none.
        """
        if len(line) > cls._MOST:
            raise LimitExceeded(f"a {cls._NAME}", len(line), cls._MOST)
        try:
            return msgspec.json.decode(line, type=cls)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
            raise RemoteProtocolError(f"not a {cls._NAME}: {error}") from None


class ControlRequest(_Line, frozen=True, omit_defaults=True):
    """A client's request.

    Attributes:
        op: The name of an operation (``observe.operations``).
        args: Its arguments, by name.
        follows: Bytes of the argument ``text`` that follow the line.
    """

    _NAME = "control request"
    _MOST = limits.CONTROL_REQUEST_MAX
    op: str
    args: dict[str, object] = {}
    follows: int = 0

    def serialize(self) -> bytes:
        """One line."""
        args, text = without_text(self.args)
        return msgspec.json.encode(msgspec.structs.replace(self, args=args, follows=len(text))) + b"\n" + text

    def __str__(self) -> str:
        """The op and the names of its arguments, safe to log."""
        shown = f"{self.op}({', '.join(self.args)})"
        return shown[:200].encode("unicode_escape").decode("ascii")


class ControlReply(_Line, frozen=True, omit_defaults=True):
    """The agent's reply.

    Attributes:
        ok: Whether ``value`` is the result; else ``error`` says why there is none and ``remedy`` what to do.
        value: Anything that JSON can hold.
        error: What happened.
        remedy: What to do; may be empty.
        follows: Bytes of the value's ``text`` that follow the line.
        code: The error's code (``core.codes``).
    """

    _NAME = "control reply"
    _MOST = limits.CONTROL_REPLY_MAX
    ok: bool
    value: Any = None  # the edge: each operation has its own type, and its caller converts the value
    error: str = ""
    remedy: str = ""
    follows: int = 0
    code: str = ""

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
