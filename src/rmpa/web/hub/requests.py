"""What a client's session asks of the hub, and what the hub answers: plain values, no I/O.

Both protocols (rosbridge v2 and the Foxglove WebSocket) speak to the hub by these. A *handle* is an integer that the
session chooses and that names one thing of that session: a subscription, an advertised topic, a call, a served
service, or a question. It is used again in each answer; the hub keeps handles of different sessions apart. Handles
are never reused within a session. Payloads are ROS 1 serialized messages without their length prefix.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias, Union

import msgspec

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.core.errors import RmpaError

ParamValue: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, bytes, list["ParamValue"], dict[str, "ParamValue"], None
]
Payload: TypeAlias = bytes | bytearray | memoryview


# --- from a session to the hub ---


class HubRequest(msgspec.Struct, frozen=True):
    """What a session asks for."""

    handle: int


class Subscribe(HubRequest, frozen=True):
    """Messages of `topic`; any type where `type` is None. Latched messages of each source come first."""

    topic: str
    type: str | None = None


class Unsubscribe(HubRequest, frozen=True):
    """No more messages for `handle`."""


class AdvertiseTopic(HubRequest, frozen=True):
    """A publisher on `topic`; `latch` keeps its last message for newcomers."""

    topic: str
    type: str
    latch: bool = False


class UnadvertiseTopic(HubRequest, frozen=True):
    """The publisher of `handle` ends."""


class PublishMessage(HubRequest, frozen=True):
    """One message of the publisher `handle`."""

    payload: Payload


class CallService(HubRequest, frozen=True):
    """One call; `type` is None where the session does not know it. `timeout` in seconds; None for the hub's own."""

    service: str
    type: str | None
    request: Payload
    timeout: float | None = None


class FindService(HubRequest, frozen=True):
    """Asks for the type of a service whose type the graph does not say; answered by `ServiceFound` or `Failed`."""

    service: str


class FindServices(HubRequest, frozen=True):
    """Asks for the types of all services whose types the graph does not say.

    Answered by `ServiceFound` without a type once the graph has them; some may stay unknown.
    """


class CancelCall(HubRequest, frozen=True):
    """The answer of the call `handle` is no longer wanted."""


class ServeService(HubRequest, frozen=True):
    """The session answers calls of `service` until `EndService`."""

    service: str
    type: str


class EndService(HubRequest, frozen=True):
    """The session answers no more calls of `handle`; open calls fail."""


class Respond(HubRequest, frozen=True):
    """The answer to `ServiceRequest` number `call`: serialized bytes where `ok`, else the error's text."""

    call: int
    ok: bool
    response: Payload | str


class GetParams(HubRequest, frozen=True):
    """Values of `names`, or of all names below `prefix` where `names` is empty ("/" for all)."""

    names: tuple[str, ...] = ()
    prefix: str = "/"


class SetParam(HubRequest, frozen=True):
    """Sets one parameter."""

    name: str
    value: ParamValue


class DeleteParam(HubRequest, frozen=True):
    """Deletes one parameter, with all below it."""

    name: str


class FollowParams(HubRequest, frozen=True):
    """`ParamsChanged` at each change of `names`; of all parameters where `names` is empty."""

    names: tuple[str, ...] = ()


class UnfollowParams(HubRequest, frozen=True):
    """Ends a `FollowParams`."""


class FollowGraph(HubRequest, frozen=True):
    """`GraphChanged` now and at each change of topics, services and their nodes."""


class UnfollowGraph(HubRequest, frozen=True):
    """Ends a `FollowGraph`."""


class DescribeType(HubRequest, frozen=True):
    """Asks for the definition of a message type, or of a service type where `service`.

    `md5sum` asks for the version that a publisher has whose messages came; "" for the one that is known best.
    Answered by `Described`, or by `Failed` where it is not known; then by `Described` if it becomes known later.
    """

    type: str
    service: bool = False
    md5sum: str = ""


class FetchAsset(HubRequest, frozen=True):
    """Asks for a file of a ROS package, `package://NAME/PATH`, of at most `most` bytes.

    The answer is `AssetFetched`, or `Failed`. The hub reads only files inside that package's folder.
    """

    uri: str
    most: int


# --- from the hub to a session ---


class Answer(msgspec.Struct, frozen=True):
    """What the hub answers."""

    handle: int


class ReceivedMessage(Answer, frozen=True):
    """One message for the subscription `handle`. `stamp_ns` is its time of receipt (UTC, nanoseconds).

    `source` is the node that published it in this module's graph; "" for a client of the hub. `md5sum` is that of
    the publisher's version of the type; "" where it is not told.
    `payload` stays valid and unchanged for as long as it is referenced; all sessions share it.
    """

    topic: str
    type: str
    payload: memoryview
    stamp_ns: int
    latched: bool = False
    source: str = ""
    md5sum: str = ""


class OtherType(Answer, frozen=True):
    """Publishers of the subscription `handle` have only another type, `type`: nothing comes from them.

    It is told once for each type; the subscription stays, for publishers of its type.
    """

    topic: str
    type: str


class ServiceResult(Answer, frozen=True):
    """The answer of a `CallService`: `payload` where `ok`, else `error`."""

    ok: bool
    payload: Payload = b""
    error: str = ""


class ServiceFound(Answer, frozen=True):
    """The answer to `FindService`; without a type that to `FindServices`."""

    type: str
    uri: str = ""


class ServiceRequest(Answer, frozen=True):
    """A call to the service that the session serves as `handle`; answered by `Respond` with the same `call`."""

    call: int
    payload: Payload


class ParamsChanged(Answer, frozen=True):
    """Values of parameters; None for a deleted one.

    It answers `GetParams`, `SetParam` and `DeleteParam` (then `handle` is theirs) and follows `FollowParams`.
    """

    values: Mapping[str, ParamValue] = {}


class GraphTopic(msgspec.Struct, frozen=True):
    """A topic with its types (more than one where publishers disagree) and the names of its nodes."""

    name: str
    types: tuple[str, ...]
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()


class GraphService(msgspec.Struct, frozen=True):
    """A service with its type ("" while unknown), the nodes that offer it and its URI (rosrpc://host:port)."""

    name: str
    type: str
    providers: tuple[str, ...] = ()
    uri: str = ""


class GraphChanged(Answer, frozen=True):
    """The whole graph, as it is now, for `FollowGraph`."""

    topics: tuple[GraphTopic, ...]
    services: tuple[GraphService, ...]


class Described(Answer, frozen=True):
    """The definition of a type with all that it embeds, as in a TCPROS header; of a service, of both its halves.

    `text` is the message type's, or that of a service's request; `response` that of a service's response. `md5sum` is
    that of the message type; "" for services.
    """

    type: str
    text: str
    response: str = ""
    md5sum: str = ""


class AssetFetched(Answer, frozen=True):
    """The contents of a file that `FetchAsset` asked for."""

    data: Payload


class Failed(Answer, frozen=True):
    """The request of `handle` failed, or what it opened has ended; `remedy` says what to do."""

    error: str
    remedy: str = ""

    @classmethod
    def of(cls, handle: int, error: RmpaError) -> Failed:
        """The answer for an error, whose text may end with the remedy."""
        remedy = getattr(error, "remedy", "")
        if not isinstance(remedy, str):
            remedy = ""
        return cls(handle, str(error).removesuffix(f"; {remedy}") if remedy else str(error), remedy)
