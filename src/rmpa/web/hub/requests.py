"""What a client's session asks of the hub, and what the hub answers: plain values, no I/O.

Both protocols (rosbridge v2 and the Foxglove WebSocket) speak to the hub by these. A *handle* is an integer that the
session chooses and that names one thing of that session: a subscription, an advertised topic, a call, a served
service, or a question. It is used again in each answer; the hub keeps handles of different sessions apart. Handles
are never reused within a session. Payloads are ROS 1 serialized messages without their length prefix.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias, Union

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.core.errors import RmpaError

ParamValue: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, bytes, list["ParamValue"], dict[str, "ParamValue"], None
]
Payload: TypeAlias = bytes | bytearray | memoryview


# --- from a session to the hub ---


@dataclass(frozen=True, slots=True)
class Subscribe:
    """Messages of `topic`; any type where `type` is None. Latched messages of each source come first."""

    handle: int
    topic: str
    type: str | None = None


@dataclass(frozen=True, slots=True)
class Unsubscribe:
    """No more messages for `handle`."""

    handle: int


@dataclass(frozen=True, slots=True)
class AdvertiseTopic:
    """A publisher on `topic`; `latch` keeps its last message for newcomers."""

    handle: int
    topic: str
    type: str
    latch: bool = False


@dataclass(frozen=True, slots=True)
class UnadvertiseTopic:
    """The publisher of `handle` ends."""

    handle: int


@dataclass(frozen=True, slots=True)
class PublishMessage:
    """One message of the publisher `handle`."""

    handle: int
    payload: Payload


@dataclass(frozen=True, slots=True)
class CallService:
    """One call; `type` is None where the session does not know it. `timeout` in seconds; None for the hub's own."""

    handle: int
    service: str
    type: str | None
    request: Payload
    timeout: float | None = None


@dataclass(frozen=True, slots=True)
class FindService:
    """Asks for the type of a service whose type the graph does not say; answered by `ServiceFound` or `Failed`."""

    handle: int
    service: str


@dataclass(frozen=True, slots=True)
class FindServices:
    """Asks for the types of all services whose types the graph does not say.

    Answered by `ServiceFound` without a type once the graph has them; some may stay unknown.
    """

    handle: int


@dataclass(frozen=True, slots=True)
class CancelCall:
    """The answer of the call `handle` is no longer wanted."""

    handle: int


@dataclass(frozen=True, slots=True)
class ServeService:
    """The session answers calls of `service` until `EndService`."""

    handle: int
    service: str
    type: str


@dataclass(frozen=True, slots=True)
class EndService:
    """The session answers no more calls of `handle`; open calls fail."""

    handle: int


@dataclass(frozen=True, slots=True)
class Respond:
    """The answer to `ServiceRequest` number `call`: serialized bytes where `ok`, else the error's text."""

    handle: int
    call: int
    ok: bool
    response: Payload | str


@dataclass(frozen=True, slots=True)
class GetParams:
    """Values of `names`, or of all names below `prefix` where `names` is empty ("/" for all)."""

    handle: int
    names: tuple[str, ...] = ()
    prefix: str = "/"


@dataclass(frozen=True, slots=True)
class SetParam:
    """Sets one parameter."""

    handle: int
    name: str
    value: ParamValue


@dataclass(frozen=True, slots=True)
class DeleteParam:
    """Deletes one parameter, with all below it."""

    handle: int
    name: str


@dataclass(frozen=True, slots=True)
class FollowParams:
    """`ParamsChanged` at each change of `names`; of all parameters where `names` is empty."""

    handle: int
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class UnfollowParams:
    """Ends a `FollowParams`."""

    handle: int


@dataclass(frozen=True, slots=True)
class FollowGraph:
    """`GraphChanged` now and at each change of topics, services and their nodes."""

    handle: int


@dataclass(frozen=True, slots=True)
class UnfollowGraph:
    """Ends a `FollowGraph`."""

    handle: int


@dataclass(frozen=True, slots=True)
class DescribeType:
    """Asks for the definition of a message type, or of a service type where `service`.

    `md5sum` asks for the version that a publisher has whose messages came; "" for the one that is known best.
    Answered by `Described`, or by `Failed` where it is not known; then by `Described` if it becomes known later.
    """

    handle: int
    type: str
    service: bool = False
    md5sum: str = ""


@dataclass(frozen=True, slots=True)
class FetchAsset:
    """Asks for a file of a ROS package, `package://NAME/PATH`, of at most `most` bytes.

    The answer is `AssetFetched`, or `Failed`. The hub reads only files inside that package's folder.
    """

    handle: int
    uri: str
    most: int


Request: TypeAlias = (
    Subscribe
    | Unsubscribe
    | AdvertiseTopic
    | UnadvertiseTopic
    | PublishMessage
    | CallService
    | FindService
    | FindServices
    | CancelCall
    | ServeService
    | EndService
    | Respond
    | GetParams
    | SetParam
    | DeleteParam
    | FollowParams
    | UnfollowParams
    | FollowGraph
    | UnfollowGraph
    | DescribeType
    | FetchAsset
)


# --- from the hub to a session ---


@dataclass(frozen=True, slots=True)
class ReceivedMessage:
    """One message for the subscription `handle`. `stamp_ns` is its time of receipt (UTC, nanoseconds).

    `source` is the node that published it in this module's graph; "" for a client of the hub. `md5sum` is that of
    the publisher's version of the type; "" where it is not told.
    `payload` stays valid and unchanged for as long as it is referenced; all sessions share it.
    """

    handle: int
    topic: str
    type: str
    payload: memoryview
    stamp_ns: int
    latched: bool = False
    source: str = ""
    md5sum: str = ""


@dataclass(frozen=True, slots=True)
class OtherType:
    """Publishers of the subscription `handle` have only another type, `type`: nothing comes from them.

    It is told once for each type; the subscription stays, for publishers of its type.
    """

    handle: int
    topic: str
    type: str


@dataclass(frozen=True, slots=True)
class ServiceResult:
    """The answer of a `CallService`: `payload` where `ok`, else `error`."""

    handle: int
    ok: bool
    payload: Payload = b""
    error: str = ""


@dataclass(frozen=True, slots=True)
class ServiceFound:
    """The answer to `FindService`; without a type that to `FindServices`."""

    handle: int
    type: str
    uri: str = ""


@dataclass(frozen=True, slots=True)
class ServiceRequest:
    """A call to the service that the session serves as `handle`; answered by `Respond` with the same `call`."""

    handle: int
    call: int
    payload: Payload


@dataclass(frozen=True, slots=True)
class ParamsChanged:
    """Values of parameters; None for a deleted one.

    It answers `GetParams`, `SetParam` and `DeleteParam` (then `handle` is theirs) and follows `FollowParams`.
    """

    handle: int
    values: Mapping[str, ParamValue] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class GraphTopic:
    """A topic with its types (more than one where publishers disagree) and the names of its nodes."""

    name: str
    types: tuple[str, ...]
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class GraphService:
    """A service with its type ("" while unknown), the nodes that offer it and its URI (rosrpc://host:port)."""

    name: str
    type: str
    providers: tuple[str, ...] = ()
    uri: str = ""


@dataclass(frozen=True, slots=True)
class GraphChanged:
    """The whole graph, as it is now, for `FollowGraph`."""

    handle: int
    topics: tuple[GraphTopic, ...]
    services: tuple[GraphService, ...]


@dataclass(frozen=True, slots=True)
class Described:
    """The definition of a type with all that it embeds, as in a TCPROS header; of a service, of both its halves.

    `text` is the message type's, or that of a service's request; `response` that of a service's response. `md5sum` is
    that of the message type; "" for services.
    """

    handle: int
    type: str
    text: str
    response: str = ""
    md5sum: str = ""


@dataclass(frozen=True, slots=True)
class AssetFetched:
    """The contents of a file that `FetchAsset` asked for."""

    handle: int
    data: Payload


@dataclass(frozen=True, slots=True)
class Failed:
    """The request of `handle` failed, or what it opened has ended; `remedy` says what to do."""

    handle: int
    error: str
    remedy: str = ""

    @classmethod
    def of(cls, handle: int, error: RmpaError) -> Failed:
        """The answer for an error, whose text may end with the remedy."""
        remedy = getattr(error, "remedy", "")
        if not isinstance(remedy, str):
            remedy = ""
        return cls(handle, str(error).removesuffix(f"; {remedy}") if remedy else str(error), remedy)


Answer: TypeAlias = (
    ReceivedMessage
    | OtherType
    | ServiceResult
    | ServiceFound
    | ServiceRequest
    | ParamsChanged
    | GraphChanged
    | Described
    | AssetFetched
    | Failed
)
