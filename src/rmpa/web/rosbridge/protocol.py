"""The ops of rosbridge v2: reads a client's frames to ops, and writes the server's.

An op is a JSON object; of a binary frame, a CBOR map with the same keys. Unknown keys are ignored, as rosbridge_suite
does. ``package/msg/Name``, as ROS 2 clients write it, is read as ``package/Name``.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import cbor2
import msgspec

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import is_type_name, resolve_name
from rmpa.web.rosbridge import limits

if TYPE_CHECKING:
    from collections.abc import Mapping

Id: TypeAlias = str | int | None
Part: TypeAlias = bytes | bytearray | memoryview


@dataclass
class OpError(RemoteProtocolError):
    """A client's op cannot be done."""

    problem: str
    remedy: str = ""

    def __str__(self) -> str:
        """The problem and the remedy."""
        return f"{self.problem}; {self.remedy}" if self.remedy else self.problem


@dataclass(frozen=True, slots=True)
class RosbridgeFrame:
    """One WebSocket message to the client.

    Args:
        parts: Its bytes, in pieces, so that a large payload is copied once only, by what sends it.
        binary: CBOR; else JSON in UTF-8.
        handle: The subscription that it belongs to; 0 for all else, which is not to be dropped.
    """

    parts: tuple[Part, ...]
    binary: bool = False
    handle: int = 0

    @property
    def size(self) -> int:
        """Bytes of all parts."""
        return sum(map(len, self.parts))

    @property
    def data(self) -> Part:
        """All parts as one."""
        return self.parts[0] if len(self.parts) == 1 else b"".join(self.parts)


# --- ops from the client -----------------------------------------------------------------------------------------


class Op(msgspec.Struct, frozen=True, kw_only=True):
    """What all ops may have."""

    id: Id = None


class RosbridgeAdvertise(Op, frozen=True, kw_only=True):
    """The client will publish on a topic. `queue_size` has no effect: queues are bounded in bytes."""

    topic: str
    type: str
    latch: bool | None = False
    queue_size: int | None = None


class RosbridgeUnadvertise(Op, frozen=True, kw_only=True):
    """The client no longer publishes on a topic (with `id`: that of its advertisements)."""

    topic: str


class RosbridgePublish(Op, frozen=True, kw_only=True):
    """A message for a topic."""

    topic: str
    msg: Any = None
    latch: bool | None = False


class RosbridgeSubscribe(Op, frozen=True, kw_only=True):
    """The client wants a topic's messages. `throttle_rate` is in milliseconds, `fragment_size` in characters."""

    topic: str
    type: str | None = None
    throttle_rate: float | None = 0
    queue_length: float | None = 0
    fragment_size: float | None = None
    compression: str | None = "none"


class RosbridgeUnsubscribe(Op, frozen=True, kw_only=True):
    """The subscription with this `id` ends; without one, all of the topic."""

    topic: str


class RosbridgeCallService(Op, frozen=True, kw_only=True):
    """A call. `args` are an object or the fields in order; `timeout` is in seconds."""

    service: str
    args: Any = None
    type: str | None = None
    fragment_size: float | None = None
    compression: str | None = "none"
    timeout: float | None = None


class AdvertiseService(Op, frozen=True, kw_only=True):
    """The client offers a service."""

    service: str
    type: str


class UnadvertiseService(Op, frozen=True, kw_only=True):
    """The client no longer offers a service."""

    service: str


class ServiceResponse(Op, frozen=True, kw_only=True):
    """The client's answer to a call; where `result` is false, `values` may be the error's text."""

    service: str
    values: Any = None
    result: bool = True


class Fragment(Op, frozen=True, kw_only=True):
    """A part of an op."""

    id: str | int
    data: str
    num: int
    total: int


class Png(Op, frozen=True, kw_only=True):
    """An op as the bytes of a picture, or a fragment of one."""

    data: str
    num: int | None = None
    total: int | None = None


class SetLevel(Op, frozen=True, kw_only=True):
    """Which status messages the client wants."""

    level: str


class RosbridgeStatus(Op, frozen=True, kw_only=True):
    """A status message of the client."""

    level: str = "info"
    msg: str = ""


OPS: Final[Mapping[str, type[Op]]] = {
    "advertise": RosbridgeAdvertise,
    "unadvertise": RosbridgeUnadvertise,
    "publish": RosbridgePublish,
    "subscribe": RosbridgeSubscribe,
    "unsubscribe": RosbridgeUnsubscribe,
    "call_service": RosbridgeCallService,
    "advertise_service": AdvertiseService,
    "unadvertise_service": UnadvertiseService,
    "service_response": ServiceResponse,
    "fragment": Fragment,
    "png": Png,
    "set_level": SetLevel,
    "status": RosbridgeStatus,
}


def parse_frame(data: str | Part) -> dict[str, Any]:
    """Read a frame: text is JSON, bytes are CBOR.

    Raises:
        OpError: The frame is neither, or no object with text keys.
        LimitExceeded: The frame is too long.
    """
    most = limits.FRAME_MAX if isinstance(data, str) else limits.BINARY_FRAME_MAX
    if len(data) > most:
        raise LimitExceeded("frame", len(data), most)
    values = _json(data) if isinstance(data, str) else _cbor(data)
    if not isinstance(values, dict):
        raise OpError(f"a frame is an object with an 'op', not a {type(values).__name__}")
    return values


def parse_op(values: Mapping[str, Any]) -> tuple[str, Op]:
    """The op of a frame.

    Raises:
        OpError: The op is unknown, a key is missing, or a value has the wrong type.
    """
    name = values.get("op")
    if not isinstance(name, str):
        if "receiver" in values:
            raise OpError("this is a message of rosbridge v1", "write it as rosbridge v2, with an 'op'")
        raise OpError("the message has no 'op'", f"it is one of {', '.join(OPS)}")
    kind = OPS.get(name)
    if kind is None:
        raise OpError(f"unknown op {_short(name)}", f"it is one of {', '.join(OPS)}")
    try:
        op = msgspec.convert(values, kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise OpError(f"{name}: {str(error)[: limits.TEXT_MAX]}") from None
    if isinstance(op.id, str) and len(op.id) > limits.ID_MAX:
        raise LimitExceeded("id", len(op.id), limits.ID_MAX)
    if isinstance(op.id, int) and abs(op.id) >= 1 << 63:
        raise OpError("an id that is a number has 64 bits")
    return name, op


def id_of(values: Mapping[str, Any]) -> Id:
    """The id of a frame, for its status messages; None where it is no id."""
    found = values.get("id")
    if isinstance(found, str):
        return found if len(found) <= limits.ID_MAX else None
    return found if isinstance(found, int) and abs(found) < 1 << 63 else None


def graph_name(name: str) -> str:
    """The global name of what a client calls by `name`.

    Raises:
        OpError: It is no name.
    """
    if not name or len(name) > limits.NAME_MAX:
        raise OpError(f"a name has 1 to {limits.NAME_MAX} characters, not {len(name)}")
    try:
        return resolve_name(name, "/", "/rosbridge")
    except ValueError:
        problem = f"{_short(name)} is not a ROS name"
        raise OpError(problem, "allowed are letters, digits, _ and /, after a letter, / or ~") from None


def type_name(name: str) -> str:
    """``package/Name`` of a type, from that or ``package/msg/Name`` (``srv``).

    Raises:
        OpError: It is no type's name.
    """
    parts = name.split("/") if len(name) <= limits.NAME_MAX else []
    if len(parts) == 3 and parts[1] in ("msg", "srv"):
        del parts[1]
    plain = "/".join(parts)
    if not is_type_name(plain):
        raise OpError(f"{_short(name)} is not a type's name", "write it like std_msgs/String")
    return plain


def whole(value: float | None, what: str, least: int = 0) -> int:
    """An integer that some clients write as a fraction; None is `least`.

    Raises:
        OpError: It is negative, not finite, or less than `least`.
    """
    if value is None:
        return least
    if not math.isfinite(value) or value < least:
        raise OpError(f"{what} is {least} or more, not {value}")
    return int(min(value, 1 << 53))


def _short(text: str) -> str:
    return repr(text[:80].encode("utf-8", "backslashreplace").decode())


def _json(text: str) -> object:
    # Brackets within strings count, too: they are rare, and counting them takes no time.
    if (count := text.count("{") + text.count("[")) > limits.CONTAINERS_MAX:
        raise OpError(f"the message has {count} objects and lists", f"up to {limits.CONTAINERS_MAX} are read")
    try:
        return msgspec.json.decode(text)
    except RecursionError:
        raise OpError("the message is nested too deep") from None
    except (msgspec.DecodeError, UnicodeError) as error:
        first = error
    # Python's clients write NaN and Infinity, which are no JSON and which rosbridge_suite accepts.
    if "NaN" not in text and "Infinity" not in text:
        raise OpError(f"the message is not JSON: {first}"[: limits.TEXT_MAX])
    try:
        values: object = json.loads(text)
        msgspec.json.encode(values)  # Python also takes half of a surrogate pair, which cannot be sent back
    except RecursionError:
        raise OpError("the message is nested too deep") from None
    except (ValueError, OverflowError):
        raise OpError(f"the message is not JSON: {first}"[: limits.TEXT_MAX]) from None
    return values


def _cbor(data: Part) -> object:
    try:
        values: object = cbor2.loads(data, max_depth=64, allow_duplicate_keys=False)
    except (cbor2.CBORError, RecursionError, ValueError, TypeError, OverflowError, MemoryError) as error:
        raise OpError(f"a binary message is CBOR: {error}"[: limits.TEXT_MAX]) from None
    return values


# --- frames to the client ----------------------------------------------------------------------------------------


def write_op(values: Mapping[str, Any]) -> RosbridgeFrame:
    """A frame of JSON."""
    return RosbridgeFrame((msgspec.json.encode(values),))


def status(level: str, text: str, mid: Id) -> RosbridgeFrame:
    """A status message."""
    values = {"op": "status", "level": level, "msg": text[: limits.TEXT_MAX]}
    return write_op(values if mid is None else values | {"id": mid})
