"""The control messages between two bridges: one JSON object in each control frame, its kind in ``op``.

They are JSON because they are rare (never on the data path), bounded by ``mesh.limits.CONTROL_PAYLOAD_MAX``, and
readable in a packet capture. ``docs/design/protocol.md`` lists the messages with examples.
"""

from __future__ import annotations

import math
import re
from typing import Any, Final

import msgspec

from rmpa.bridge import limits
from rmpa.config import limits as config_limits
from rmpa.core.contract import Contract
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import Guid, is_global_name, is_type_name, peer_name_problem
from rmpa.core.limits import UINT32_MAX
from rmpa.mesh import limits as mesh_limits


class Source(msgspec.Struct, frozen=True, order=True):
    """One stream of messages: a topic as one node publishes it. Sources are never mixed.

    Args:
        topic: Global name of the topic, in the publishing module.
        node: Global name of the publishing node, in the publishing module.
    """

    topic: str
    node: str

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

    name: str
    guid: str
    instance: str
    node: str
    path: tuple[str, ...] = ()


class TopicOffer(msgspec.Struct, frozen=True, omit_defaults=True):
    """A source that the sender's graph has, and its message type.

    Args:
        topic: Its topic.
        node: Its node; for a relayed source, the proxy in the sender's graph.
        type: Its message type.
        origin: Its module and node, if it is not the sender's own.
    """

    topic: str
    node: str
    type: str
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

    added: tuple[TopicOffer, ...] = ()
    removed: tuple[Source, ...] = ()
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

    route: int
    topic: str
    node: str
    contract: Contract = Contract()
    epoch: int = 0
    after: int = 0

    @property
    def source(self) -> Source:
        """The requested source."""
        return Source(self.topic, self.node)


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
    """

    route: int
    description: Description
    contract: Contract = Contract()
    epoch: int = 0
    first: int = 1
    following: int | msgspec.UnsetType = msgspec.UNSET
    unknown: bool | msgspec.UnsetType = msgspec.UNSET


class CloseRoute(msgspec.Struct, frozen=True, tag_field="op", tag="close"):
    """The subscribing agent closes a route."""

    route: int


class RouteClosed(msgspec.Struct, frozen=True, tag_field="op", tag="closed"):
    """The publishing agent refuses or ends a route.

    Args:
        route: The route's id.
        reason: Text for the user.
        last: If the publisher of a reliable route has gone: the sequence of its last message.
    """

    route: int
    reason: str
    last: int | msgspec.UnsetType = msgspec.UNSET


class Mismatch(msgspec.Struct, frozen=True, tag_field="op", tag="mismatch"):
    """A subscriber at the sender was refused because its definition of the receiver's source differs.

    An empty ``text`` ends an earlier mismatch: the subscriber has gone or registers again.
    """

    topic: str
    node: str
    subscriber: str
    text: str

    @property
    def source(self) -> Source:
        """The source that did not fit."""
        return Source(self.topic, self.node)


class Audience(msgspec.Struct, frozen=True, tag_field="op", tag="audience"):
    """The sender's nodes that listen to a route; sent if publishers check their listeners' names (actions).

    Args:
        route: The route's id.
        nodes: The listeners' global names, in the sender's graph.
    """

    route: int
    nodes: tuple[str, ...] = ()


class ServiceOffer(msgspec.Struct, frozen=True, omit_defaults=True):
    """A service that the sender's graph has.

    Args:
        service: Its global wire name; the receiver may rename it.
        node: The node that provides it; for a relayed service, the proxy in the sender's graph.
        origin: Its module and node, if it is not the sender's own.
    """

    service: str
    node: str
    origin: Origin | None = None


class AdvertiseServices(msgspec.Struct, frozen=True, tag_field="op", tag="services"):
    """The services that the sender offers, as ``Advertise`` for topics; ``removed`` has names of services."""

    added: tuple[ServiceOffer, ...] = ()
    removed: tuple[str, ...] = ()
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

    route: int
    service: str
    timeout: float = config_limits.SERVICE_TIMEOUT


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

    route: int
    requests: int
    type: str
    md5: str
    request_type: str = ""
    response_type: str = ""


class CloseService(msgspec.Struct, frozen=True, tag_field="op", tag="service_close"):
    """The calling agent closes a service; ``route`` is its own one."""

    route: int


class ServiceClosed(msgspec.Struct, frozen=True, tag_field="op", tag="service_closed"):
    """The service cannot be called (any more); pending calls get no reply. ``reason`` is text for the user."""

    route: int
    reason: str


class Request(msgspec.Struct, frozen=True, tag_field="op", tag="ask"):
    """A request of one agent to another; ``bridge.driver`` finds its handler.

    Args:
        number: Identifies the request at the requesting agent.
        what: The handler's name.
        args: The handler's arguments, by name.
    """

    number: int
    what: str
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

    number: int
    ok: bool
    value: Any = None
    error: str = ""
    remedy: str = ""


class Notification(msgspec.Struct, frozen=True, tag_field="op", tag="tell"):
    """A message to another agent without a response; ``what`` selects the listener."""

    what: str
    args: dict[str, Any] = {}


RouteMessage = OpenRoute | RouteOpened | CloseRoute | RouteClosed | Audience
TopicMessage = Advertise | Mismatch | RouteMessage
ServiceMessage = AdvertiseServices | OpenService | ServiceOpened | CloseService | ServiceClosed
AgentMessage = Request | Response | Notification
Message = TopicMessage | ServiceMessage | AgentMessage

_ENCODER: Final = msgspec.json.Encoder()
_DECODER: Final = msgspec.json.Decoder(Message)
_MD5: Final = re.compile(r"[0-9a-f]{32}")
_INSTANCE: Final = re.compile(r"[0-9a-f]{32}")


_OP: Final = b'{"op":"'
_OP_MAX: Final = 32


def is_crossing_name(name: str) -> bool:
    """Whether a name may be in a message: it is global and at most ``CROSSING_NAME_MAX`` characters long."""
    return len(name) <= config_limits.CROSSING_NAME_MAX and is_global_name(name)


def is_crossing_type(name: str) -> bool:
    """Whether a type may be in a message: its name is valid and at most ``CROSSING_NAME_MAX`` characters long."""
    return len(name) <= config_limits.CROSSING_NAME_MAX and is_type_name(name)


def encode(message: Message) -> bytes:
    """Encode a message as the payload of a control frame."""
    return _ENCODER.encode(message)


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


def op_of(payload: bytes | bytearray | memoryview) -> str:
    """The kind of a control message, without parsing it; empty if its text does not begin with ``op``.

    The messages of ``encode`` begin with it. Others are parsed at once, which only takes time.
    """
    head = bytes(payload[:_OP_MAX])
    return head[len(_OP) :].partition(b'"')[0].decode("ascii", "replace") if head.startswith(_OP) else ""


def decode(payload: bytes | bytearray | memoryview) -> Message:
    """Read and validate one message.

    Raises:
        LimitExceeded: It is longer than ``mesh.limits.CONTROL_PAYLOAD_MAX``, or a list or text in it is too long.
        RemoteProtocolError: It is not a message of this version, or has an invalid name, type or value.
    """
    if len(payload) > mesh_limits.CONTROL_PAYLOAD_MAX:
        raise LimitExceeded("control message", len(payload), mesh_limits.CONTROL_PAYLOAD_MAX)
    try:
        message: Message = _DECODER.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RemoteProtocolError(f"control message: {error}") from error
    _validate(message)
    return message


def _validate(message: Message) -> None:
    match message:
        case Advertise():
            _validate_advertise(message)
        case Mismatch():
            _check_names(message.topic, message.node)
            _check_text(message.subscriber)
            _check_text(message.text)
        case Request() | Response() | Notification():
            _validate_agent(message)
        case AdvertiseServices() | OpenService() | ServiceOpened() | CloseService() | ServiceClosed():
            _validate_service(message)
        case _:
            _validate_route(message)


def _validate_advertise(message: Advertise) -> None:
    if len(message.added) > limits.ADVERTISED_MAX:
        raise LimitExceeded("advertisement (in topics)", len(message.added), limits.ADVERTISED_MAX)
    for offer in message.added:
        _check_names(offer.topic, offer.node)
        if not is_crossing_type(offer.type):
            raise RemoteProtocolError(f"{offer.type[:200]!r}, offered for {offer.topic}, is not a message type")
        if offer.origin is not None:
            _check_origin(offer.origin)
    for source in message.removed:
        _check_names(source.topic, source.node)


def _check_origin(origin: Origin) -> None:
    if problem := peer_name_problem(origin.name):
        raise RemoteProtocolError(f"a relayed source: {problem}")
    try:
        Guid.parse(origin.guid)
    except ValueError as error:
        raise RemoteProtocolError(f"a relayed source: {error}") from error
    _check_names(origin.node)
    if not 0 < len(origin.path) <= limits.RELAY_HOPS_MAX:
        raise LimitExceeded("way of a relayed source (in relays)", len(origin.path), limits.RELAY_HOPS_MAX)
    for instance in (origin.instance, *origin.path):
        if not _INSTANCE.fullmatch(instance):
            raise RemoteProtocolError(f"{instance[:64]!r} in the way of a relayed source is no instance id")


def _validate_route(message: RouteMessage) -> None:
    if not 0 < message.route < limits.SERVICE_ROUTES:
        raise RemoteProtocolError(f"route {message.route} is not a 31-bit number above 0")
    match message:
        case OpenRoute():
            _check_names(message.topic, message.node)
            _check_terms(message)
        case RouteClosed():
            _check_text(message.reason)
        case RouteOpened():
            if message.description.problem:
                raise RemoteProtocolError(f"route {message.route}: {message.description.problem}")
            _check_terms(message)
        case Audience():
            if len(message.nodes) > limits.AUDIENCE_MAX:
                raise LimitExceeded("audience (in nodes)", len(message.nodes), limits.AUDIENCE_MAX)
            _check_names(*message.nodes)


def _validate_service(message: ServiceMessage) -> None:
    if isinstance(message, AdvertiseServices):
        if len(message.added) > limits.ADVERTISED_MAX:
            raise LimitExceeded("advertisement (in services)", len(message.added), limits.ADVERTISED_MAX)
        for offer in message.added:
            _check_names(offer.service, offer.node)
            if offer.origin is not None:
                _check_origin(offer.origin)
        _check_names(*message.removed)
        return
    _check_service_route(message.route)
    if isinstance(message, OpenService):
        _check_names(message.service)
        if not config_limits.CONTRACT_TIME_MIN <= message.timeout <= config_limits.SERVICE_TIMEOUT_MAX:
            raise RemoteProtocolError(f"calls of {message.service} that may take {message.timeout} s")
    elif isinstance(message, ServiceClosed):
        _check_text(message.reason)
    elif isinstance(message, ServiceOpened):
        _check_service_route(message.requests)
        if not is_crossing_type(message.type) or not _MD5.fullmatch(message.md5):
            raise RemoteProtocolError(f"a service of type {message.type[:200]!r} and md5 sum {message.md5[:64]!r}")
        for name in (message.request_type, message.response_type):
            if name and not is_crossing_type(name):
                raise RemoteProtocolError(f"{name[:200]!r} is not a type of requests or responses")


def _check_service_route(route: int) -> None:
    if not limits.SERVICE_ROUTES <= route <= UINT32_MAX:
        raise RemoteProtocolError(f"route {route} of a service is not from {limits.SERVICE_ROUTES} to {UINT32_MAX}")


def _validate_agent(message: AgentMessage) -> None:
    if isinstance(message, Response):
        _check_text(message.error)
        _check_text(message.remedy)
    elif len(message.what) > limits.ASK_NAME_MAX:
        raise LimitExceeded("name of a question", len(message.what), limits.ASK_NAME_MAX)
    if isinstance(message, Request | Response) and not 0 < message.number <= UINT32_MAX:
        raise RemoteProtocolError(f"question {message.number} is not a 32-bit number above 0")


def _check_terms(message: OpenRoute | RouteOpened) -> None:
    """Checks a peer's contract, and that its numbers have 32 bits."""
    check_contract(message.contract, f"route {message.route}")
    numbers = [message.epoch, message.after if isinstance(message, OpenRoute) else message.first]
    if isinstance(message, RouteOpened) and not isinstance(message.following, msgspec.UnsetType):
        numbers.append(message.following)
    if any(not 0 <= number <= UINT32_MAX for number in numbers):
        raise RemoteProtocolError(f"route {message.route}: a contract with the numbers {numbers} cannot be")


def check_contract(contract: Contract, what: str) -> None:
    """Check that a peer's contract has only values that ``rmpa.toml`` allows.

    Args:
        contract: The contract.
        what: What it is for, as text for the error.

    Raises:
        RemoteProtocolError: A value is out of its range.
    """
    times = (contract.deadline, contract.lifespan, contract.liveliness_lease)
    lowest, highest = config_limits.CONTRACT_TIME_MIN, config_limits.CONTRACT_TIME_MAX
    lowest_rate = config_limits.CONTRACT_RATE_MIN
    if not 1 <= contract.depth <= config_limits.CONTRACT_DEPTH_MAX:
        problem = f"a depth of {contract.depth}"
    elif any(t is not None and not (math.isfinite(t) and lowest <= t <= highest) for t in times):
        problem = f"times of {times} seconds"
    elif contract.max_rate is not None and not lowest_rate <= contract.max_rate <= config_limits.CONTRACT_RATE_MAX:
        problem = f"a rate of {contract.max_rate}"
    elif not config_limits.OUTAGE_MIN <= contract.outage <= config_limits.OUTAGE_MAX:
        problem = f"an outage of {contract.outage} seconds"
    else:
        return
    raise RemoteProtocolError(f"{what}: a contract with {problem} cannot be")


def _check_names(*names: str) -> None:
    for name in names:
        if not is_crossing_name(name):
            raise RemoteProtocolError(f"{name[:200]!r} is not a global ROS name")


def _check_text(text: str) -> None:
    if len(text) > limits.CONTROL_TEXT_MAX:
        raise LimitExceeded("text in a control message", len(text), limits.CONTROL_TEXT_MAX)
