"""What a page and the server send each other (docs/design/monitor-protocol.md).

The messages of a page are parsed and checked once, here. A state is a tree of JSON values whose objects have no
member that is null: there a missing member says "not known". Its changes are JSON merge patches (RFC 7396), in which
a null always removes, and arrays are replaced as a whole.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, Union

import msgspec

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Mapping

Value: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, list["Value"], dict[str, "Value"], None
]
Tree: TypeAlias = dict[str, Value]
VERSION: Final = 1
SUBPROTOCOL: Final = "rmpa.monitor.v1"
"""The WebSocket subprotocol; a version that older pages cannot read has another one."""
LOG_TOPIC: Final = "/rosout_agg"
"""The messages of all nodes, from one publisher: ``/rosout`` would be a connection to each node."""

Id: TypeAlias = int
Kind: TypeAlias = Literal["module", "topic", "service", "node", "resource", "counters"]
How: TypeAlias = Literal["value", "plot", "image", "scan"]


class Ack(msgspec.Struct, frozen=True, tag_field="op", tag="ack", forbid_unknown_fields=False):
    """The state or patch number ``n`` is shown, and all before it."""

    n: int


class Look(msgspec.Struct, frozen=True, tag_field="op", tag="look"):
    """The page shows these things and wants their details; none of others. Each is ``[kind, name]``."""

    at: tuple[tuple[Kind, str], ...] = ()


class Watch(msgspec.Struct, frozen=True, tag_field="op", tag="watch"):
    """Messages of a topic: its newest values, lines of a plot, images, or laser scans."""

    id: Id
    topic: str
    how: How
    fields: tuple[str, ...] = ()
    rate: float = 5.0


class Unwatch(msgspec.Struct, frozen=True, tag_field="op", tag="unwatch"):
    """No more messages of that watch."""

    id: Id


class AskQuestion(msgspec.Struct, frozen=True, tag_field="op", tag="ask"):
    """A question or an order that has one answer: ``why``, ``call``, ``params``, ``set_param`` and so on.

    ``at`` is as of ``Drive``.
    """

    id: Id
    what: str
    args: dict[str, Any] = {}  # the edge: each question has its own
    at: float = 0.0


class Log(msgspec.Struct, frozen=True, tag_field="op", tag="log"):
    """Whether lines of the log are wanted."""

    on: bool


class Drive(msgspec.Struct, frozen=True, tag_field="op", tag="drive"):
    """A joystick: speeds from -1 to 1 of what is allowed; repeated every 0.1 s while it is held.

    ``hold`` numbers the times that the stick was taken, and ``n`` the commands, both rising; ``at`` is when it was
    made, by the server's clock as the page knows it (``joystick``).
    """

    topic: str
    linear: float
    angular: float
    hold: int
    n: int
    at: float


class ReleaseJoystick(msgspec.Struct, frozen=True, tag_field="op", tag="release"):
    """The joystick is let go: the robot is stopped at once, and nothing more of that hold drives it."""

    hold: int


ClientMessage: TypeAlias = Ack | Look | Watch | Unwatch | AskQuestion | Log | Drive | ReleaseJoystick
_decoder: Final = msgspec.json.Decoder(ClientMessage)


def parse(text: str | bytes) -> ClientMessage:
    """A message of a client.

    Raises:
        LimitExceeded: It is too long.
        RemoteProtocolError: It is not one, or says what cannot be.
    """
    if len(text) > limits.REQUEST_MAX:
        raise LimitExceeded("a monitor's request", len(text), limits.REQUEST_MAX)
    try:
        message: ClientMessage = _decoder.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RemoteProtocolError(f"not a monitor's request: {error}") from None
    _check(message)
    return message


def _check(message: ClientMessage) -> None:
    if isinstance(message, Look) and len(message.at) > limits.LOOKS_MAX:
        raise RemoteProtocolError(f"a page looks at {len(message.at)} things; {limits.LOOKS_MAX} is the most")
    if isinstance(message, Watch | Unwatch | AskQuestion) and not 0 < message.id < 2**32:
        raise RemoteProtocolError(f"the id {message.id} is not between 1 and 4294967295")
    if isinstance(message, Watch):
        if not 0 < message.rate <= limits.WATCH_RATE_MAX:
            raise RemoteProtocolError(
                f"rate {message.rate:g} is not above 0 and at most {limits.WATCH_RATE_MAX:g} Hz"
            )
        if len(message.fields) > limits.FIELDS_MAX or (message.how == "plot") != bool(message.fields):
            raise RemoteProtocolError(f"a plot has 1 to {limits.FIELDS_MAX} fields, everything else none")
    if isinstance(message, Drive) and not (abs(message.linear) <= 1 and abs(message.angular) <= 1):
        raise RemoteProtocolError("a joystick's values are from -1 to 1")


# --- states -------------------------------------------------------------------------------------------------------


def difference(old: Mapping[str, Value], new: Mapping[str, Value]) -> Tree:
    """The merge patch that makes ``new`` of ``old``; empty where they are equal.

    Parts that are the same object in both cost nothing. ``1``, ``1.0`` and ``True`` are different values.
    """
    patch: Tree = {key: None for key in old if key not in new}
    for key, value in new.items():
        before = old.get(key)
        if before is value:
            continue
        if isinstance(value, dict) and isinstance(before, dict):
            if inner := difference(before, value):
                patch[key] = inner
        elif before != value or msgspec.json.encode(before) != msgspec.json.encode(value):
            patch[key] = value
    return patch


def without_nulls(value: object) -> Value:
    """A value for a state: without members that are null, arrays as lists, NaN and infinities left out as unknown.

    In an array, what is unknown stays, as null.
    """
    if isinstance(value, dict):
        members = ((str(key), without_nulls(inner)) for key, inner in value.items())
        return {key: inner for key, inner in members if inner is not None}
    if isinstance(value, list | tuple):
        return [without_nulls(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)
