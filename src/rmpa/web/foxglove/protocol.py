"""Messages of the Foxglove WebSocket protocol (``foxglove.websocket.v1`` and ``foxglove.sdk.v1``), without I/O.

JSON messages are text frames with the field ``op``. Binary messages begin with an opcode of one byte; their integers
are little-endian. Source: the protocol's specification in github.com/foxglove/ws-protocol (``spec.md``), and the
output of foxglove-sdk, whose order of fields is kept.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from typing import TYPE_CHECKING, Annotated, Final, Literal, TypeAlias

import msgspec
from msgspec import UNSET, Meta, UnsetType

from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError
from rmpa.core.identity import is_global_name
from rmpa.core.limits import INT32_MAX, INT32_MIN, UINT32_MAX
from rmpa.web.foxglove import limits
from rmpa.web.hub.frame_writer import Opcode, OutFrame
from rmpa.web.hub.params import as_json

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.web.hub.node_link import ParamValue, Payload

# The names of the WebSocket subprotocol, preferred first; the messages here are the same in both.
SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
# The encoding of all messages: what crosses TCPROS, undecoded.
ENCODING: Final = "ros1"
# The encoding of all schemas: a message definition with its dependencies, as in a TCPROS header.
SCHEMA_ENCODING: Final = "ros1msg"
WARNING: Final = 1
# Levels of a status.
ERROR: Final = 2


def message(op: str, **fields: object) -> OutFrame:
    """A JSON message; ``None`` leaves a field out."""
    values = {"op": op} | {name: value for name, value in fields.items() if value is not None}
    return Opcode.TEXT, (encode_json(values),)


def status(level: int, text: str, identity: str = "") -> OutFrame:
    """A text for users; a later one with the same ``identity`` replaces it."""
    return message("status", level=level, message=text, id=identity or None)


def parameter_values(values: Mapping[str, ParamValue], identity: str | None = None) -> OutFrame:
    """Values of parameters: the answer to the request ``identity``, or an update."""
    parameters = [to_parameter(name, value) for name, value in values.items()]
    return message("parameterValues", parameters=parameters, id=identity)


def encode_json(message: object) -> bytes:
    """A message as UTF-8 JSON; bytes in a text that are not UTF-8 become U+FFFD."""
    try:
        return msgspec.json.encode(message)
    except UnicodeEncodeError:
        text = json.dumps(msgspec.to_builtins(message), ensure_ascii=False)
        return text.encode("utf-8", "surrogatepass").decode("utf-8", "replace").encode()


_DATA: Final = struct.Struct("<BIQ")
_TIME: Final = struct.Struct("<BQ")
_SERVICE: Final = struct.Struct("<BIII")
_ASSET: Final = struct.Struct("<BIBI")
_UINT64_MAX: Final = (1 << 64) - 1


def message_data(subscription: int, stamp_ns: int, payload: Payload) -> OutFrame:
    """A message of a subscription; ``stamp_ns`` is its time of receipt, nanoseconds since the epoch."""
    return _binary(_DATA.pack(1, subscription, min(max(stamp_ns, 0), _UINT64_MAX)), payload)


def server_time(stamp_ns: int) -> OutFrame:
    """The server's time where it is not the wall clock's, in nanoseconds."""
    return _binary(_TIME.pack(2, min(max(stamp_ns, 0), _UINT64_MAX)))


def service_response(service: int, call: int, payload: Payload) -> OutFrame:
    """The response to a call."""
    return _binary(_SERVICE.pack(3, service, call, len(ENCODING)) + ENCODING.encode(), payload)


def asset_response(request: int, data: Payload) -> OutFrame:
    """A fetched asset."""
    return _binary(_ASSET.pack(4, request, 0, 0), data)


def asset_failure(request: int, error: str) -> OutFrame:
    """Says why an asset could not be fetched."""
    text = error.encode("utf-8", "replace")
    return _binary(_ASSET.pack(4, request, 1, len(text)) + text)


def _binary(header: bytes, payload: Payload = b"") -> OutFrame:
    """A frame whose payload is the sender's own buffer, and not copied."""
    return Opcode.BINARY, (header, payload)


Id: TypeAlias = Annotated[int, Meta(ge=0, le=UINT32_MAX)]
Text: TypeAlias = Annotated[str, Meta(max_length=limits.NAME_MAX)]
Ids: TypeAlias = Annotated[tuple[Id, ...], Meta(max_length=limits.SUBSCRIPTIONS_MAX)]
Names: TypeAlias = Annotated[tuple[Text, ...], Meta(max_length=limits.PARAMETERS_MAX)]
_ParameterType: TypeAlias = Literal["byte_array", "float64", "float64_array"]


class FoxgloveSubscription(msgspec.Struct, frozen=True, rename="camel"):
    """A subscription: a number that the client chooses, and the channel."""

    id: Id
    channel_id: Annotated[int, Meta(ge=0)]


class ClientChannel(msgspec.Struct, frozen=True, rename="camel"):
    """A topic that a client wants to publish."""

    id: Id
    topic: Text
    encoding: Text
    schema_name: Text


class FoxgloveParameter(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A parameter in a message of either side.

    Attributes:
        name: Its global name.
        type: ``byte_array``: ``value`` is base64 text. ``float64`` and ``float64_array``: numbers are floating-point
            ones, also where JSON shows whole ones.
        value: What JSON can hold (``from_parameter`` checks it); unset for a parameter that is deleted.
    """

    name: Text
    type: _ParameterType | UnsetType = UNSET
    value: object = UNSET


Subscriptions: TypeAlias = Annotated[tuple[FoxgloveSubscription, ...], Meta(max_length=limits.SUBSCRIPTIONS_MAX)]
ClientChannels: TypeAlias = Annotated[tuple[ClientChannel, ...], Meta(max_length=limits.ADVERTISED_MAX)]
FoxgloveParameters: TypeAlias = Annotated[tuple[FoxgloveParameter, ...], Meta(max_length=limits.PARAMETERS_MAX)]


def parse_text(data: bytes | str, decoder: msgspec.json.Decoder[msgspec.Struct]) -> msgspec.Struct:
    """Parse a text frame of a client.

    Raises:
        LimitExceeded: It is longer than ``limits.TEXT_MAX``; nothing of it was read.
        RemoteProtocolError: It is not JSON, or not a message of a client.
    """
    if len(data) > limits.TEXT_MAX:
        raise LimitExceeded("JSON message", len(data), limits.TEXT_MAX)
    try:
        return decoder.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
        raise RemoteProtocolError(f"not a message of this protocol: {error}") from None


def parse_binary(data: Payload) -> tuple[int, memoryview] | tuple[int, int, str, memoryview]:
    """Parse a binary frame of a client; its payload is not copied.

    Returns:
        Of a message that the client publishes the channel's number and the payload; of a service call the numbers of
        the service and the call, the encoding and the payload.

    Raises:
        LimitExceeded: It is longer than ``limits.BINARY_MAX``.
        RemoteProtocolError: The opcode is unknown, or the frame is too short for it.
    """
    if len(data) > limits.BINARY_MAX:
        raise LimitExceeded("binary message", len(data), limits.BINARY_MAX)
    view = memoryview(data)
    opcode = view[0] if view else None
    if opcode == 1:
        if len(view) < 5:
            raise RemoteProtocolError(f"a published message of {len(view)} bytes is too short for its header of 5")
        return int.from_bytes(view[1:5], "little"), view[5:]
    if opcode == 2:
        return _parse_call(view)
    known = "1 (message data) and 2 (service call)"
    raise RemoteProtocolError(
        "an empty binary message" if opcode is None else f"binary opcode {opcode} is unknown; there are {known}"
    )


def _parse_call(view: memoryview) -> tuple[int, int, str, memoryview]:
    if len(view) < _SERVICE.size:
        raise RemoteProtocolError(f"a service call of {len(view)} bytes is too short for its header of 13")
    _, service, call, length = _SERVICE.unpack_from(view)
    end = _SERVICE.size + length
    if length > limits.NAME_MAX or end > len(view):
        raise RemoteProtocolError(f"a service call of {len(view)} bytes claims an encoding of {length} bytes")
    try:
        encoding = str(view[_SERVICE.size : end], "utf-8")
    except UnicodeDecodeError:
        raise RemoteProtocolError("the encoding of a service call is not UTF-8") from None
    return service, call, encoding, view[end:]


# ROS tells integers from floating-point numbers and has byte strings, which JSON does not.


def to_parameter(name: str, value: ParamValue) -> FoxgloveParameter:
    """A parameter as clients get it; ``None`` is one that was deleted.

    Numbers that JSON lacks (NaN, infinities) become the texts ``nan``, ``inf`` and ``-inf``, without a type.
    """
    if value is None:
        return FoxgloveParameter(name=name)
    kind: _ParameterType | UnsetType = UNSET
    if isinstance(value, bytes):
        kind = "byte_array"
    elif isinstance(value, float) and math.isfinite(value):
        kind = "float64"
    elif isinstance(value, list) and value and all(isinstance(each, float) and math.isfinite(each) for each in value):
        kind = "float64_array"
    return FoxgloveParameter(name=name, type=kind, value=as_json(value, lambda data: base64.b64encode(data).decode()))


def from_parameter(parameter: FoxgloveParameter) -> ParamValue:
    """The value of a client's parameter; ``None`` for one that is to be deleted.

    Raises:
        RmpaError: The name is no global name, or the value does not fit its type, or ROS cannot hold it.
    """
    name, value = parameter.name, parameter.value
    check_name(name)
    if value is UNSET or value is None:
        return None
    if parameter.type == "byte_array":
        if isinstance(value, str):
            try:
                return base64.b64decode(value, validate=True)
            except ValueError:
                pass
        raise RmpaError(f"{name}: a byte_array is base64 text, not {_short(value)}")
    if parameter.type == "float64":
        return _float(name, value)
    if parameter.type == "float64_array":
        if not isinstance(value, list):
            raise RmpaError(f"{name}: a float64_array is a list of numbers, not {_short(value)}")
        return [_float(name, each) for each in value]
    return _from_json(name, value, 0)


def check_name(name: str) -> None:
    """Refuse what is not a parameter's global name.

    Raises:
        RmpaError: It is none.
    """
    if not is_global_name(name):
        raise RmpaError(f"{_short(name)} is not a parameter's name; write it like /base/rate")


def _float(name: str, value: object) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            pass
    raise RmpaError(f"{name}: a float64 is a number, not {_short(value)}")


def _from_json(name: str, value: object, depth: int) -> ParamValue:
    if depth > limits.PARAMETER_DEPTH_MAX:
        raise RmpaError(f"{name}: lists and maps are nested deeper than {limits.PARAMETER_DEPTH_MAX}")
    if isinstance(value, int) and not INT32_MIN <= value <= INT32_MAX:
        raise RmpaError(f"{name}: {value} does not fit an integer of 32 bits; give it the type float64")
    if isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list):
        return [_from_json(name, each, depth + 1) for each in value]
    if isinstance(value, dict):
        return {str(key): _from_json(name, each, depth + 1) for key, each in value.items()}
    raise RmpaError(f"{name}: a parameter cannot hold {_short(value)}")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}…"
