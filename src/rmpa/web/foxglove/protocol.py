"""Messages of the Foxglove WebSocket protocol (``foxglove.websocket.v1`` and ``foxglove.sdk.v1``), without I/O.

JSON messages are text frames with the field ``op``. Binary messages begin with an opcode of one byte; their integers
are little-endian. Source: the protocol's specification in github.com/foxglove/ws-protocol (``docs/spec.md``), and the
output of foxglove-sdk, whose order of fields is kept.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING, Annotated, Final, Literal, TypeAlias

import msgspec
from msgspec import UNSET, Meta, UnsetType

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.limits import UINT32_MAX
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.web.hub.requests import Payload

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""The names of the WebSocket subprotocol, preferred first; the messages here are the same in both."""
ENCODING: Final = "ros1"
"""The encoding of all messages: what crosses TCPROS, undecoded."""
SCHEMA_ENCODING: Final = "ros1msg"
"""The encoding of all schemas: a message definition with its dependencies, as in a TCPROS header."""


def choose_subprotocol(offered: Iterable[str]) -> str | None:
    """The subprotocol to answer a client's ``Sec-WebSocket-Protocol`` with; ``None`` if it offers none of ours."""
    names = {name.strip() for name in offered}
    return next((name for name in SUBPROTOCOLS if name in names), None)


class Capability(StrEnum):
    """An optional feature that a server offers to a client, by its name in ``serverInfo``."""

    CLIENT_PUBLISH = "clientPublish"
    PARAMETERS = "parameters"
    PARAMETERS_SUBSCRIBE = "parametersSubscribe"
    SERVICES = "services"
    TIME = "time"
    CONNECTION_GRAPH = "connectionGraph"
    ASSETS = "assets"


class StatusLevel(IntEnum):
    """The severity of a status message."""

    INFO = 0
    WARNING = 1
    ERROR = 2


# --- from the server: JSON ---


class FromServer(msgspec.Struct, frozen=True, kw_only=True, rename="camel", tag_field="op", omit_defaults=True):
    """A JSON message of the server."""

    def frame(self) -> TextFrame:
        """The message as a text frame."""
        return TextFrame(encode_json(self))


class _Part(msgspec.Struct, frozen=True, kw_only=True, rename="camel", omit_defaults=True):
    """A part of a server's message."""


class ServerInfo(FromServer, frozen=True, kw_only=True, tag="serverInfo"):
    """The first message to each client.

    Attributes:
        name: Of the server, for users.
        capabilities: What it offers beyond subscriptions.
        supported_encodings: Of messages that clients publish, and of service calls.
        metadata: ``ROS_DISTRO = noetic`` tells a client that the data are ROS 1's.
        session_id: The same for all clients of one run of the server, which tells a restart from a reconnection.
    """

    name: str
    capabilities: tuple[Capability, ...]
    supported_encodings: tuple[str, ...] = ()
    metadata: dict[str, str] = {}
    session_id: str = ""


class FoxgloveStatus(FromServer, frozen=True, kw_only=True, tag="status"):
    """A text for users; a later one with the same ``id`` replaces it."""

    level: int
    message: str
    id: str = ""


class RemoveStatus(FromServer, frozen=True, kw_only=True, tag="removeStatus"):
    """Status messages that are no longer valid."""

    status_ids: tuple[str, ...]


class Channel(_Part, frozen=True, kw_only=True):
    """A topic with one type that a client may subscribe to."""

    id: int
    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str | UnsetType = UNSET
    schema: str


class FoxgloveAdvertise(FromServer, frozen=True, kw_only=True, tag="advertise"):
    """New channels."""

    channels: tuple[Channel, ...]


class FoxgloveUnadvertise(FromServer, frozen=True, kw_only=True, tag="unadvertise"):
    """Channels that are gone; their subscriptions have ended."""

    channel_ids: tuple[int, ...]


class ServiceSchema(_Part, frozen=True, kw_only=True):
    """The type of a service's request or response."""

    encoding: str
    schema_name: str
    schema_encoding: str
    schema: str


class FoxgloveService(_Part, frozen=True, kw_only=True):
    """A service that a client may call."""

    id: int
    name: str
    type: str
    request: ServiceSchema
    response: ServiceSchema


class FoxgloveAdvertiseServices(FromServer, frozen=True, kw_only=True, tag="advertiseServices"):
    """New services."""

    services: tuple[FoxgloveService, ...]


class FoxgloveUnadvertiseServices(FromServer, frozen=True, kw_only=True, tag="unadvertiseServices"):
    """Services that are gone."""

    service_ids: tuple[int, ...]


class ServiceCallFailure(FromServer, frozen=True, kw_only=True, tag="serviceCallFailure"):
    """A call has failed."""

    service_id: int
    call_id: int
    message: str


ParameterType: TypeAlias = Literal["byte_array", "float64", "float64_array"]


class FoxgloveParameter(_Part, frozen=True, kw_only=True):
    """A parameter in a message of either side.

    Attributes:
        name: Its global name.
        type: ``byte_array``: ``value`` is base64 text. ``float64`` and ``float64_array``: numbers are floating-point
            ones, also where JSON shows whole ones.
        value: What JSON can hold (``parameters`` checks it); unset for a parameter that is deleted.
    """

    name: Annotated[str, Meta(max_length=limits.FOXGLOVE_NAME_MAX)]
    type: ParameterType | UnsetType = UNSET
    value: object = UNSET


class ParameterValues(FromServer, frozen=True, kw_only=True, tag="parameterValues"):
    """Values of parameters: the answer to the request ``id``, or an update."""

    parameters: tuple[FoxgloveParameter, ...]
    id: str | UnsetType = UNSET


class PublishedTopic(_Part, frozen=True, kw_only=True):
    """All publishers of a topic, by their nodes' names."""

    name: str
    publisher_ids: tuple[str, ...]


class SubscribedTopic(_Part, frozen=True, kw_only=True):
    """All subscribers of a topic, by their nodes' names."""

    name: str
    subscriber_ids: tuple[str, ...]


class AdvertisedService(_Part, frozen=True, kw_only=True):
    """All providers of a service, by their nodes' names."""

    name: str
    provider_ids: tuple[str, ...]


class ConnectionGraphUpdate(FromServer, frozen=True, kw_only=True, tag="connectionGraphUpdate"):
    """What has changed in the graph: each entry replaces the earlier one of its name."""

    published_topics: tuple[PublishedTopic, ...]
    subscribed_topics: tuple[SubscribedTopic, ...]
    advertised_services: tuple[AdvertisedService, ...]
    removed_topics: tuple[str, ...]
    removed_services: tuple[str, ...]


ServerMessage: TypeAlias = (
    ServerInfo
    | FoxgloveStatus
    | RemoveStatus
    | FoxgloveAdvertise
    | FoxgloveUnadvertise
    | FoxgloveAdvertiseServices
    | FoxgloveUnadvertiseServices
    | ServiceCallFailure
    | ParameterValues
    | ConnectionGraphUpdate
)


def encode_json(message: object) -> bytes:
    """A message as UTF-8 JSON; bytes in a text that are not UTF-8 become U+FFFD."""
    try:
        return msgspec.json.encode(message)
    except UnicodeEncodeError:
        return msgspec.json.encode(_clean(msgspec.to_builtins(message)))


def _clean(value: object) -> object:
    if isinstance(value, str):
        return value.encode("utf-8", "surrogatepass").decode("utf-8", "replace")
    if isinstance(value, dict):
        return {_clean(key): _clean(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(each) for each in value]
    return value


# --- from the server: frames ---


@dataclass(frozen=True, slots=True)
class TextFrame:
    """A text frame: JSON in UTF-8."""

    data: bytes


@dataclass(frozen=True, slots=True)
class BinaryFrame:
    """A binary frame, written as ``header`` and then ``payload``, which is the sender's own buffer and not copied."""

    header: bytes
    payload: Payload = b""

    def __len__(self) -> int:
        """Bytes of the frame's contents."""
        return len(self.header) + len(self.payload)

    def __bytes__(self) -> bytes:
        """The contents as one value: a copy, for tests and for writers that need one."""
        return self.header + bytes(self.payload)


FoxgloveFrame: TypeAlias = TextFrame | BinaryFrame

_DATA: Final = struct.Struct("<BIQ")
_TIME: Final = struct.Struct("<BQ")
_SERVICE: Final = struct.Struct("<BIII")
_ASSET: Final = struct.Struct("<BIBI")
_UINT64_MAX: Final = (1 << 64) - 1


def message_data(subscription: int, stamp_ns: int, payload: Payload) -> BinaryFrame:
    """A message of a subscription; ``stamp_ns`` is its time of receipt, nanoseconds since the epoch."""
    return BinaryFrame(_DATA.pack(1, subscription, min(max(stamp_ns, 0), _UINT64_MAX)), payload)


def server_time(stamp_ns: int) -> BinaryFrame:
    """The server's time where it is not the wall clock's, in nanoseconds."""
    return BinaryFrame(_TIME.pack(2, min(max(stamp_ns, 0), _UINT64_MAX)))


def service_response(service: int, call: int, payload: Payload) -> BinaryFrame:
    """The response to a call."""
    return BinaryFrame(_SERVICE.pack(3, service, call, len(ENCODING)) + ENCODING.encode(), payload)


def asset_response(request: int, data: Payload) -> BinaryFrame:
    """A fetched asset."""
    return BinaryFrame(_ASSET.pack(4, request, 0, 0), data)


def asset_failure(request: int, error: str) -> BinaryFrame:
    """Says why an asset could not be fetched."""
    text = error.encode("utf-8", "replace")
    return BinaryFrame(_ASSET.pack(4, request, 1, len(text)) + text)


# --- from a client: JSON ---

_Id: TypeAlias = Annotated[int, Meta(ge=0, le=UINT32_MAX)]
_Text: TypeAlias = Annotated[str, Meta(max_length=limits.FOXGLOVE_NAME_MAX)]
_Ids: TypeAlias = Annotated[tuple[_Id, ...], Meta(max_length=limits.FOXGLOVE_SUBSCRIPTIONS_MAX)]
_Names: TypeAlias = Annotated[tuple[_Text, ...], Meta(max_length=limits.FOXGLOVE_PARAMETERS_MAX)]


class _FromClient(msgspec.Struct, frozen=True, rename="camel", tag_field="op"):
    """A client's message; fields that are not known are ignored, as later versions may add some."""


class _PartFromClient(msgspec.Struct, frozen=True, rename="camel"):
    """A part of a client's message."""


class FoxgloveSubscription(_PartFromClient, frozen=True):
    """A subscription: a number that the client chooses, and the channel."""

    id: _Id
    channel_id: Annotated[int, Meta(ge=0)]


class FoxgloveSubscribe(_FromClient, frozen=True, tag="subscribe"):
    """Asks for the messages of channels."""

    subscriptions: Annotated[tuple[FoxgloveSubscription, ...], Meta(max_length=limits.FOXGLOVE_SUBSCRIPTIONS_MAX)]


class FoxgloveUnsubscribe(_FromClient, frozen=True, tag="unsubscribe"):
    """Ends subscriptions."""

    subscription_ids: _Ids


class ClientChannel(_PartFromClient, frozen=True):
    """A topic that a client wants to publish."""

    id: _Id
    topic: _Text
    encoding: _Text
    schema_name: _Text
    schema: str | None = None
    schema_encoding: _Text | None = None


class ClientAdvertise(_FromClient, frozen=True, tag="advertise"):
    """Topics that a client wants to publish."""

    channels: Annotated[tuple[ClientChannel, ...], Meta(max_length=limits.FOXGLOVE_ADVERTISED_MAX)]


class ClientUnadvertise(_FromClient, frozen=True, tag="unadvertise"):
    """Topics that a client publishes no longer."""

    channel_ids: _Ids


class GetParameters(_FromClient, frozen=True, tag="getParameters"):
    """Asks for parameters; for all where no name is given."""

    parameter_names: _Names = ()
    id: _Text | None = None


class SetParameters(_FromClient, frozen=True, tag="setParameters"):
    """Sets parameters, and deletes those without a value."""

    parameters: Annotated[tuple[FoxgloveParameter, ...], Meta(max_length=limits.FOXGLOVE_PARAMETERS_MAX)]
    id: _Text | None = None


class SubscribeParameterUpdates(_FromClient, frozen=True, tag="subscribeParameterUpdates"):
    """Asks for changes of parameters; of all where no name is given."""

    parameter_names: _Names = ()


class UnsubscribeParameterUpdates(_FromClient, frozen=True, tag="unsubscribeParameterUpdates"):
    """Ends updates of parameters; of all where no name is given."""

    parameter_names: _Names = ()


class SubscribeConnectionGraph(_FromClient, frozen=True, tag="subscribeConnectionGraph"):
    """Asks for the graph and its changes."""


class UnsubscribeConnectionGraph(_FromClient, frozen=True, tag="unsubscribeConnectionGraph"):
    """Ends the updates of the graph."""


class FoxgloveFetchAsset(_FromClient, frozen=True, tag="fetchAsset"):
    """Asks for a file."""

    uri: _Text
    request_id: _Id


# --- from a client: binary ---


@dataclass(frozen=True, slots=True)
class ClientMessageData:
    """A message that a client publishes; ``payload`` is a part of the received frame."""

    channel_id: int
    payload: memoryview


@dataclass(frozen=True, slots=True)
class ServiceCallRequest:
    """A service call; ``payload`` is a part of the received frame."""

    service_id: int
    call_id: int
    encoding: str
    payload: memoryview


ClientText: TypeAlias = (
    FoxgloveSubscribe
    | FoxgloveUnsubscribe
    | ClientAdvertise
    | ClientUnadvertise
    | GetParameters
    | SetParameters
    | SubscribeParameterUpdates
    | UnsubscribeParameterUpdates
    | SubscribeConnectionGraph
    | UnsubscribeConnectionGraph
    | FoxgloveFetchAsset
)
ClientBinary: TypeAlias = ClientMessageData | ServiceCallRequest
_DECODER: Final[msgspec.json.Decoder[ClientText]] = msgspec.json.Decoder(ClientText)


def parse_text(data: bytes | str) -> ClientText:
    """Parse a text frame of a client.

    Raises:
        LimitExceeded: It is longer than ``limits.FOXGLOVE_TEXT_MAX``; nothing of it was read.
        RemoteProtocolError: It is not JSON, or not a message of a client.
    """
    if len(data) > limits.FOXGLOVE_TEXT_MAX:
        raise LimitExceeded("JSON message", len(data), limits.FOXGLOVE_TEXT_MAX)
    try:
        return _DECODER.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
        raise RemoteProtocolError(f"not a message of this protocol: {error}") from None


def parse_binary(data: Payload) -> ClientBinary:
    """Parse a binary frame of a client; its payload is not copied.

    Raises:
        LimitExceeded: It is longer than ``limits.FOXGLOVE_BINARY_MAX``.
        RemoteProtocolError: The opcode is unknown, or the frame is too short for it.
    """
    if len(data) > limits.FOXGLOVE_BINARY_MAX:
        raise LimitExceeded("binary message", len(data), limits.FOXGLOVE_BINARY_MAX)
    view = memoryview(data)
    opcode = view[0] if view else None
    if opcode == 1:
        if len(view) < 5:
            raise RemoteProtocolError(f"a published message of {len(view)} bytes is too short for its header of 5")
        return ClientMessageData(int.from_bytes(view[1:5], "little"), view[5:])
    if opcode == 2:
        return _parse_call(view)
    known = "1 (message data) and 2 (service call)"
    raise RemoteProtocolError(
        "an empty binary message" if opcode is None else f"binary opcode {opcode} is unknown; there are {known}"
    )


def _parse_call(view: memoryview) -> ServiceCallRequest:
    if len(view) < _SERVICE.size:
        raise RemoteProtocolError(f"a service call of {len(view)} bytes is too short for its header of 13")
    _, service, call, length = _SERVICE.unpack_from(view)
    end = _SERVICE.size + length
    if length > limits.FOXGLOVE_NAME_MAX or end > len(view):
        raise RemoteProtocolError(f"a service call of {len(view)} bytes claims an encoding of {length} bytes")
    try:
        encoding = str(view[_SERVICE.size : end], "utf-8")
    except UnicodeDecodeError:
        raise RemoteProtocolError("the encoding of a service call is not UTF-8") from None
    return ServiceCallRequest(service, call, encoding, view[end:])
