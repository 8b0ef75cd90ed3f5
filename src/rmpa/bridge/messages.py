"""The control messages between two bridges: one JSON object in each control frame, its kind in ``op``.

They are JSON because they are rare (never on the data path), bounded by ``mesh.limits.CONTROL_PAYLOAD_MAX``, and
readable in a packet capture. ``docs/design/protocol.md`` lists the messages with examples.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Final, TypeVar

import msgspec
from msgspec import Meta

from rmpa.bridge import limits
from rmpa.config import limits as config_limits
from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import BASE_NAME, GLOBAL_NAME, TYPE_NAME, Guid, is_global_name, is_type_name
from rmpa.core.limits import UINT32_MAX
from rmpa.mesh import limits as mesh_limits

# A global ROS name. The types below are checked where a message of a peer is decoded, and nowhere else.
Name = Annotated[str, Meta(max_length=config_limits.CROSSING_NAME_MAX, pattern=rf"\A{GLOBAL_NAME}\Z")]
PeerName = Annotated[str, Meta(max_length=core_limits.PEER_NAME_MAX, pattern=rf"\A{BASE_NAME}\Z")]
NameOrNone = Annotated[str, Meta(max_length=config_limits.CROSSING_NAME_MAX, pattern=rf"\A({GLOBAL_NAME})?\Z")]
TypeName = Annotated[str, Meta(max_length=config_limits.CROSSING_NAME_MAX, pattern=rf"\A{TYPE_NAME}\Z")]
AnyTypeName = Annotated[str, Meta(max_length=config_limits.CROSSING_NAME_MAX, pattern=rf"\A(\*|{TYPE_NAME})\Z")]
TypeNameOrNone = Annotated[str, Meta(max_length=config_limits.CROSSING_NAME_MAX, pattern=rf"\A({TYPE_NAME})?\Z")]
Md5 = Annotated[str, Meta(pattern=r"\A[0-9a-f]{32}\Z")]
InstanceId = Annotated[str, Meta(pattern=r"\A[0-9a-f]{32}\Z")]
Text = Annotated[str, Meta(max_length=limits.CONTROL_TEXT_MAX)]
Route = Annotated[int, Meta(gt=0, lt=limits.SERVICE_ROUTES)]
ServiceRoute = Annotated[int, Meta(ge=limits.SERVICE_ROUTES, le=UINT32_MAX)]
Sequence = Annotated[int, Meta(ge=0, le=UINT32_MAX)]
QuestionNumber = Annotated[int, Meta(gt=0, le=UINT32_MAX)]
Question = Annotated[str, Meta(max_length=limits.ASK_NAME_MAX)]
CallTimeout = Annotated[float, Meta(ge=core_limits.CONTRACT_TIME_MIN, le=config_limits.SERVICE_TIMEOUT_MAX)]


class Source(msgspec.Struct, frozen=True, order=True):
    """One stream of messages: a topic as one node publishes it. Sources are never mixed.

    Args:
        topic: Global name of the topic, in the publishing module.
        node: Global name of the publishing node, in the publishing module.
    """

    topic: Name
    node: Name

    def __str__(self) -> str:
        """``/cmd from /joy_node``."""
        return f"{self.topic} from {self.node}"


class Origin(msgspec.Struct, frozen=True):
    """The module and node that a relayed source belongs to.

    Args:
        name: The name of the module that publishes it.
        guid: Its GUID as text.
        instance: The random id of its run, 32 hexadecimal digits.
        node: The publishing node, in that module's graph.
        path: The instances of the relays on the path, the one nearest to the origin first; the last is the sender.
    """

    name: PeerName
    guid: str
    instance: InstanceId
    node: Name
    path: Annotated[tuple[InstanceId, ...], Meta(min_length=1, max_length=limits.RELAY_HOPS_MAX)]

    def __post_init__(self) -> None:
        """Check the origin that a peer names.

        Raises:
            ValueError: The GUID is none.
        """
        Guid.parse(self.guid)


class TopicOffer(msgspec.Struct, frozen=True, omit_defaults=True):
    """A source that the sender's graph has, and its message type.

    Args:
        topic: Its topic.
        node: Its node; for a relayed source, the proxy in the sender's graph.
        type: Its message type.
        origin: Its module and node, if it is not the sender's own.
    """

    topic: Name
    node: Name
    type: TypeName
    origin: Origin | None = None

    @property
    def source(self) -> Source:
        """The offered source."""
        return Source(self.topic, self.node)


class Description(msgspec.Struct, frozen=True):
    """The connection header of a publisher; known only once the agent is connected to it.

    Args:
        type: Message type.
        md5: Its MD5 sum, never ``*``.
        definition: The full text of its definition, byte for byte as the publisher sent it: one character a byte
            (ISO 8859-1), because some definitions have comments that are not UTF-8.
        latching: Whether each new subscriber gets the last message.
    """

    type: str
    md5: str
    definition: str
    latching: bool

    @property
    def problem(self) -> str:
        """Why a publisher with this header cannot be passed on, or empty."""
        if not is_type_name(self.type):
            return f"its publisher names no message type (but {self.type!r})"
        if not _MD5.fullmatch(self.md5):
            return f"its publisher names no md5 sum (but {self.md5!r})"
        if not self.definition.isascii() and max(self.definition) > "\xff":
            return "its definition has characters that are no bytes"
        return ""


class Advertise(msgspec.Struct, frozen=True, tag_field="op", tag="advertise"):
    """The sources that the sender offers: all of them, first on each link, or changes.

    Args:
        added: Sources that are new or have another type or origin.
        removed: Sources that are no longer offered.
        full: Whether this begins a full advertisement: sources that it does not contain are no longer offered.
        more: Whether the full advertisement continues in further messages.
    """

    added: Annotated[tuple[TopicOffer, ...], Meta(max_length=limits.ADVERTISED_MAX)] = ()
    removed: tuple[Source, ...] = ()
    full: bool = False
    more: bool = False


class SubscriptionOffer(TopicOffer, frozen=True, omit_defaults=True):
    """A subscription of a node, as ``TopicOffer``; ``type`` is ``*`` where the subscriber takes any."""

    type: AnyTypeName


class SubscriptionChanges(msgspec.Struct, frozen=True):
    """The arguments of the notification of subscriptions; see ``Advertise``."""

    added: Annotated[tuple[SubscriptionOffer, ...], Meta(max_length=limits.ADVERTISED_MAX)] = ()
    removed: Annotated[tuple[Source, ...], Meta(max_length=limits.ADVERTISED_MAX)] = ()
    full: bool = False
    more: bool = False


class OpenRoute(msgspec.Struct, frozen=True, tag_field="op", tag="open"):
    """Asks the receiver of this message to send a source, in data frames with this route's id.

    Args:
        route: The route's id, chosen by the subscribing agent, which sends this message.
        topic: The source's topic.
        node: The source's node.
        contract: The contract that the subscribing agent asks for.
        epoch: The last numbering of which it has messages, if an earlier route ended; else 0.
        after: The last message of that numbering that it has.
    """

    route: Route
    topic: Name
    node: Name
    contract: Contract = Contract()
    epoch: Sequence = 0
    after: Sequence = 0


class RouteOpened(msgspec.Struct, frozen=True, tag_field="op", tag="opened"):
    """The route is open; data follows.

    Args:
        route: The route's id.
        description: The header of the publisher.
        contract: The contract of the route: the stronger terms of both ends.
        epoch: Identifies the numbering of a reliable route; 0 for best effort.
        first: The numbering's first sequence.
        following: If a reliable route continues: the sequence of the next message.
        unknown: Whether an earlier run of the subscribing agent may have missed messages; left out: no.
        shared: Whether the agent was connected to the publisher before; left out: no.
    """

    route: Route
    description: Description
    contract: Contract = Contract()
    epoch: Sequence = 0
    first: Sequence = 1
    following: Sequence | msgspec.UnsetType = msgspec.UNSET
    unknown: bool | msgspec.UnsetType = msgspec.UNSET
    shared: bool | msgspec.UnsetType = msgspec.UNSET


class CloseRoute(msgspec.Struct, frozen=True, tag_field="op", tag="close"):
    """The subscribing agent closes a route."""

    route: Route


class RouteClosed(msgspec.Struct, frozen=True, tag_field="op", tag="closed"):
    """The publishing agent refuses or ends a route.

    Args:
        route: The route's id.
        reason: Text for the user.
        last: If the publisher of a reliable route has gone: the sequence of its last message.
    """

    route: Route
    reason: Text
    last: int | msgspec.UnsetType = msgspec.UNSET


class Mismatch(msgspec.Struct, frozen=True, tag_field="op", tag="mismatch"):
    """A subscriber at the sender was refused because its definition of the receiver's source differs.

    An empty ``text`` ends an earlier mismatch: the subscriber has gone or registers again.
    """

    topic: Name
    node: Name
    subscriber: Text
    text: Text


class Audience(msgspec.Struct, frozen=True, tag_field="op", tag="audience"):
    """The sender's nodes that listen to a route; sent if publishers check their listeners' names (actions).

    Args:
        route: The route's id.
        nodes: The listeners' global names, in the sender's graph.
    """

    route: Route
    nodes: Annotated[tuple[Name, ...], Meta(max_length=limits.AUDIENCE_MAX)] = ()


class ServiceOffer(msgspec.Struct, frozen=True, omit_defaults=True):
    """A service that the sender's graph has.

    Args:
        service: Its global wire name; the receiver may rename it.
        node: The node that provides it; for a relayed service, the proxy in the sender's graph.
        origin: Its module and node, if it is not the sender's own.
    """

    service: Name
    node: Name
    origin: Origin | None = None


class AdvertiseServices(msgspec.Struct, frozen=True, tag_field="op", tag="services"):
    """The services that the sender offers, as ``Advertise`` for topics; ``removed`` has names of services."""

    added: Annotated[tuple[ServiceOffer, ...], Meta(max_length=limits.ADVERTISED_MAX)] = ()
    removed: tuple[Name, ...] = ()
    full: bool = False
    more: bool = False


class OpenService(msgspec.Struct, frozen=True, tag_field="op", tag="service_open"):
    """The calling agent opens a service; it gets the replies on this route, whose id it chose.

    Args:
        route: The id, from ``limits.SERVICE_ROUTES`` on. Each reply is one message on it, whose sequence is the
            call's; its body is TCPROS's reply: the byte ``ok``, then the response or the text of the error.
        service: Its name, as it was offered.
        timeout: Seconds that the calling agent waits for the reply to a call.
    """

    route: ServiceRoute
    service: Name
    timeout: CallTimeout = config_limits.SERVICE_TIMEOUT


class ServiceOpened(msgspec.Struct, frozen=True, tag_field="op", tag="service_opened"):
    """The service can be called.

    Args:
        route: The caller's id.
        requests: The route that calls go to: each is one message, whose sequence the caller chooses.
        type: The service's type, ``package/Name``.
        md5: Its MD5 sum, never ``*``.
        request_type: The type of its requests from the server's header; may be empty.
        response_type: The type of its responses, likewise.
    """

    route: ServiceRoute
    requests: ServiceRoute
    type: TypeName
    md5: Md5
    request_type: TypeNameOrNone = ""
    response_type: TypeNameOrNone = ""


class CloseService(msgspec.Struct, frozen=True, tag_field="op", tag="service_close"):
    """The calling agent closes a service; ``route`` is its own one."""

    route: ServiceRoute


class ServiceClosed(msgspec.Struct, frozen=True, tag_field="op", tag="service_closed"):
    """The service cannot be called (any more); pending calls get no reply. ``reason`` is text for the user."""

    route: ServiceRoute
    reason: Text


class Request(msgspec.Struct, frozen=True, tag_field="op", tag="ask"):
    """A request of one agent to another; ``bridge.rpc`` finds its handler.

    Args:
        number: Identifies the request at the requesting agent.
        what: The handler's name.
        args: The handler's arguments, by name.
    """

    number: QuestionNumber
    what: Question
    args: dict[str, Any] = {}


class Response(msgspec.Struct, frozen=True, tag_field="op", tag="answer"):
    """The response to a request.

    Args:
        number: The number of the request.
        ok: Whether the request succeeded and ``value`` is its result; else see ``error`` and ``remedy``.
        value: Anything that JSON can represent.
        error: Why it failed.
        remedy: What the user can do; may be empty.
    """

    number: QuestionNumber
    ok: bool
    value: Any = None
    error: Text = ""
    remedy: Text = ""


class Notification(msgspec.Struct, frozen=True, tag_field="op", tag="tell"):
    """A message to another agent without a response; ``what`` selects the listener."""

    what: Question
    args: dict[str, Any] = {}


TopicMessage = Advertise | OpenRoute | RouteOpened | CloseRoute | RouteClosed | Mismatch | Audience
ServiceMessage = AdvertiseServices | OpenService | ServiceOpened | CloseService | ServiceClosed
Message = TopicMessage | ServiceMessage | Request | Response | Notification

# Encodes a message as the payload of a control frame.
encode: Final = msgspec.json.Encoder().encode
_DECODER: Final = msgspec.json.Decoder(Message)
_MD5: Final = re.compile(r"[0-9a-f]{32}")

FormT = TypeVar("FormT")
_OP: Final = b'{"op":"'


def is_crossing_name(name: str) -> bool:
    """Whether a name may be in a message: it is global and at most ``CROSSING_NAME_MAX`` characters long."""
    return len(name) <= config_limits.CROSSING_NAME_MAX and is_global_name(name)


def is_crossing_type(name: str) -> bool:
    """Whether a type may be in a message: its name is valid and at most ``CROSSING_NAME_MAX`` characters long."""
    return len(name) <= config_limits.CROSSING_NAME_MAX and is_type_name(name)


def without_text(fields: Any) -> tuple[Any, bytes]:
    """Arguments, or a value, without their ``text`` if that is long; and that text."""
    text = fields.get("text") if isinstance(fields, dict) else None
    if not isinstance(text, str) or len(text) <= limits.ASK_EXPRESS_MAX:
        return fields, b""
    return {name: value for name, value in fields.items() if name != "text"}, text.encode()


def with_text(fields: Any, text: bytes | memoryview) -> None:
    """Put a text that came behind its JSON into arguments, or a value.

    Raises:
        RemoteProtocolError: It is none, or does not belong there.
    """
    try:
        fields["text"] = str(text, "utf-8")
    except (UnicodeDecodeError, TypeError) as error:
        raise RemoteProtocolError(f"a text behind its message: {error}") from None


def convert(what: str, value: object, form: type[FormT]) -> FormT:
    """Read and validate what is in a message; bytes are in base64.

    Raises:
        RemoteProtocolError: It is missing or malformed; ``what`` names it.
    """
    try:
        return msgspec.convert(value, form)
    except (msgspec.ValidationError, RecursionError) as error:
        raise RemoteProtocolError(f"{what}: {error}") from error


def op_of(payload: bytes | bytearray | memoryview) -> str:
    """The kind of a control message, without parsing it; empty if its text does not begin with ``op``.

    The messages of ``encode`` begin with it. Others are parsed at once, which only takes time.
    """
    head = bytes(payload[:32])
    return head[len(_OP) :].partition(b'"')[0].decode("ascii", "replace") if head.startswith(_OP) else ""


def decode(payload: bytes | bytearray | memoryview) -> Message:
    """Read and validate one message.

    Raises:
        LimitExceeded: It is longer than ``mesh.limits.CONTROL_PAYLOAD_MAX``.
        RemoteProtocolError: It is not a message of this version, or a name, type, number or length in it is invalid.
    """
    if len(payload) > mesh_limits.CONTROL_PAYLOAD_MAX:
        raise LimitExceeded("control message", len(payload), mesh_limits.CONTROL_PAYLOAD_MAX)
    try:
        message: Message = _DECODER.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RemoteProtocolError(f"control message: {error}") from error
    if isinstance(message, RouteOpened) and message.description.problem:
        raise RemoteProtocolError(f"route {message.route}: {message.description.problem}")
    return message
