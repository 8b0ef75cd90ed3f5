"""The session of a Foxglove client, and the connection graph that it is told.

The connection graph that a Foxglove client is told: which nodes publish, subscribe and serve what.
"""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

from rmpa.core.counters import TokenBucket
from rmpa.core.errors import LocalProtocolError, RemoteProtocolError, RmpaError
from rmpa.core.identity import is_global_name, is_type_name
from rmpa.web import limits
from rmpa.web.foxglove import protocol
from rmpa.web.foxglove.channels import ChannelTable, ParameterRequests
from rmpa.web.foxglove.protocol import (
    AdvertisedService,
    BinaryFrame,
    Capability,
    ConnectionGraphUpdate,
    FoxgloveFrame,
    PublishedTopic,
    StatusLevel,
    SubscribedTopic,
)
from rmpa.web.hub import requests
from rmpa.web.hub.node_link import CONTROL_REMEDY, READ_REMEDY

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from rmpa.web.hub.node_link import Rights
    from rmpa.web.hub.requests import GraphChanged, Payload

_UNCHANGED: Final = ConnectionGraphUpdate(
    published_topics=(), subscribed_topics=(), advertised_services=(), removed_topics=(), removed_services=()
)


class ConnectionGraph:
    """The graph as one client has been told it; ``update`` is what differs since."""

    def __init__(self) -> None:
        self._publishers: dict[str, tuple[str, ...]] = {}
        self._subscribers: dict[str, tuple[str, ...]] = {}
        self._providers: dict[str, tuple[str, ...]] = {}

    def update(self, graph: GraphChanged) -> ConnectionGraphUpdate | None:
        """The changes that lead to this graph; ``None`` without any. A topic without nodes counts as removed."""
        publishers = {topic.name: topic.publishers for topic in graph.topics if topic.publishers}
        subscribers = {topic.name: topic.subscribers for topic in graph.topics if topic.subscribers}
        providers = {service.name: service.providers for service in graph.services}
        before = self._publishers.keys() | self._subscribers.keys()
        removed = before - publishers.keys() - subscribers.keys()
        update = ConnectionGraphUpdate(
            published_topics=tuple(
                PublishedTopic(name=name, publisher_ids=ids)
                for name, ids in _changed(self._publishers, publishers, removed)
            ),
            subscribed_topics=tuple(
                SubscribedTopic(name=name, subscriber_ids=ids)
                for name, ids in _changed(self._subscribers, subscribers, removed)
            ),
            advertised_services=tuple(
                AdvertisedService(name=name, provider_ids=ids)
                for name, ids in _changed(self._providers, providers, self._providers.keys() - providers.keys())
            ),
            removed_topics=tuple(sorted(removed)),
            removed_services=tuple(sorted(self._providers.keys() - providers.keys())),
        )
        self._publishers, self._subscribers, self._providers = publishers, subscribers, providers
        return update if update != _UNCHANGED else None


def _changed(
    before: Mapping[str, tuple[str, ...]], now: Mapping[str, tuple[str, ...]], removed: Iterable[str]
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Entries that are new or differ, and with no node those that ended while their name remains in the graph."""
    yield from ((name, ids) for name, ids in now.items() if before.get(name) != ids)
    gone = before.keys() - now.keys() - set(removed)
    yield from ((name, ()) for name in sorted(gone))


# One client of the Foxglove WebSocket protocol: its frames in, frames and requests to the hub out; no I/O.
#
# ``FoxgloveSession`` decodes no message: payloads cross as they come from TCPROS. Definitions, the graph,
# parameters
# and services come from the hub (``web.hub.requests``); a hub that has not answered delays only what it was asked
# for.


CLOCK: Final = ("/clock", "rosgraph_msgs/Clock")
"""The topic that gives the time where ``use_sim_time`` is set, and its type."""
_CLOCK: Final = struct.Struct("<II")
_POLICY_VIOLATION: Final = 1008
"""A WebSocket's close code, RFC 6455, section 7.4.1."""


@dataclass(frozen=True, slots=True)
class FoxgloveClose:
    """The client is to be disconnected, with this WebSocket close code and reason."""

    code: int
    reason: str


Output: TypeAlias = FoxgloveFrame | requests.HubRequest | FoxgloveClose


@dataclass(slots=True)
class _Subscription:
    id: int
    channel_id: int
    handle: int
    delivered: bool = False  # whether a message of it was sent


@dataclass(frozen=True, slots=True)
class _Call:
    service_id: int
    call_id: int


class SessionError(RmpaError):
    """A client asks for what it may not have or what is not there; the session goes on."""


class FoxgloveSession:
    """The server's side of one client.

    ``open`` comes first; then ``receive`` for each frame of the client and ``answer`` for each answer of the hub, in
    any order. What they return is to be done in its order. ``now`` is in seconds of a monotonic clock.

    Args:
        name: The server's name, for users.
        session_id: The same for all clients of one run of the server.
        rights: What the client may do.
        sim_time: Whether ``/clock`` gives the time (``use_sim_time``): it is sent on, and stamps the messages.
    """

    def __init__(self, name: str, session_id: str, rights: Rights, *, sim_time: bool = False) -> None:
        self._name = name
        self._session_id = session_id
        self._rights = rights
        self._sim_time = sim_time
        self._handles = itertools.count(1)
        self._opened = False
        self._errors = TokenBucket(limits.FOXGLOVE_STATUS_RATE, limits.FOXGLOVE_STATUS_BURST)
        self._channels = ChannelTable(self._next_handle, services=rights.control)
        self._parameters = ParameterRequests(self._next_handle)
        self._by_id: dict[int, _Subscription] = {}
        self._by_channel: dict[int, _Subscription] = {}
        self._by_handle: dict[int, _Subscription] = {}
        self._published: dict[int, int] = {}
        self._publishers: set[int] = set()
        self._calls: dict[int, _Call] = {}
        self._assets: dict[int, int] = {}
        self._graph_handle = 0
        self._graph: requests.GraphChanged | None = None
        self._told: ConnectionGraph | None = None
        self._clock_handle = 0
        self._time_ns: int | None = None

    @property
    def capabilities(self) -> tuple[Capability, ...]:
        """What the client is told that it may do."""
        rights = self._rights
        offered = (
            (Capability.CLIENT_PUBLISH, rights.control),
            (Capability.PARAMETERS, rights.view),
            (Capability.PARAMETERS_SUBSCRIBE, rights.view),
            (Capability.SERVICES, rights.control),
            (Capability.TIME, self._sim_time),
            (Capability.CONNECTION_GRAPH, True),
            (Capability.ASSETS, rights.view),
        )
        return tuple(capability for capability, given in offered if given)

    def open(self) -> list[Output]:
        """What comes first: ``serverInfo``, and the request for the graph, from which channels follow.

        Raises:
            LocalProtocolError: The session was opened before.
        """
        if self._opened:
            raise LocalProtocolError("the session is open")
        self._opened = True
        self._graph_handle = self._next_handle()
        out: list[Output] = [
            protocol.ServerInfo(
                name=self._name,
                capabilities=self.capabilities,
                supported_encodings=(protocol.ENCODING,),
                metadata={"ROS_DISTRO": "noetic"},
                session_id=self._session_id,
            ).frame(),
            requests.FollowGraph(self._graph_handle),
        ]
        if self._sim_time:
            self._clock_handle = self._next_handle()
            out.append(requests.Subscribe(self._clock_handle, *CLOCK))
        return out

    def receive(self, data: Payload | str, now: float) -> list[Output]:
        """Handle a frame of the client: text as ``str``, binary as bytes.

        What is wrong with it is told to the client as a status, at most ``limits.FOXGLOVE_STATUS_RATE`` times a
        second in the long run; a client that sends malformed messages at a higher rate is disconnected.
        """
        out: list[Output] = []
        try:
            if isinstance(data, str):
                for each in self._text(protocol.parse_text(data)):
                    out += self._refuse(each, now) if isinstance(each, SessionError) else [each]
            else:
                out += self._binary(protocol.parse_binary(data))
        except RmpaError as error:
            out += self._refuse(error, now)
        return out

    def answer(self, answer: requests.Answer) -> list[Output]:
        """Handle an answer of the hub; one for a handle that has ended is ignored."""
        match answer:
            case requests.ReceivedMessage():
                return self._received(answer)
            case requests.GraphChanged():
                return list(self._graph_changed(answer))
            case requests.ParamsChanged() if self._parameters.owns(answer.handle):
                values = self._parameters.answer(answer)
                return [] if values is None else [values.frame()]
            case requests.ServiceResult() if answer.handle in self._calls:
                call = self._calls.pop(answer.handle)
                if answer.ok:
                    return [protocol.service_response(call.service_id, call.call_id, answer.payload)]
                return [_call_failure(call, answer.error)]
            case requests.Described() | requests.ServiceFound() if self._channels.owns(answer.handle):
                return _framed(self._offered(self._channels.answer(answer)))
            case requests.AssetFetched() if answer.handle in self._assets:
                return [_asset(self._assets.pop(answer.handle), answer.data)]
            case requests.Failed():
                return self._failed(answer)
        return []

    def status(self, level: StatusLevel, message: str, identity: str = "") -> FoxgloveFrame:
        """A status message of the server's own: it says, for example, what a slow client misses."""
        return protocol.FoxgloveStatus(level=level, message=message, id=identity).frame()

    def close(self) -> list[requests.HubRequest]:
        """End everything that the hub does for this client, which is gone."""
        out: list[requests.HubRequest] = [requests.Unsubscribe(handle) for handle in self._by_handle]
        out += [requests.UnadvertiseTopic(handle) for handle in self._published.values()]
        out += [requests.CancelCall(handle) for handle in self._calls]
        out += self._parameters.close()
        if self._clock_handle:
            out.append(requests.Unsubscribe(self._clock_handle))
        if self._graph_handle:
            out.append(requests.UnfollowGraph(self._graph_handle))
        for table in (self._by_id, self._by_channel, self._by_handle, self._published, self._publishers):
            table.clear()
        self._calls.clear()
        self._assets.clear()
        return out

    # --- the client's messages --------------------------------------------------------------------------------

    def _text(self, message: protocol.ClientText) -> Iterator[Output | SessionError]:
        match message:
            case protocol.FoxgloveSubscribe():
                yield from (each for wanted in message.subscriptions for each in self._subscribe(wanted))
            case protocol.FoxgloveUnsubscribe():
                yield from (each for number in message.subscription_ids for each in self._unsubscribe(number))
            case protocol.ClientAdvertise():
                self._check(self._rights.control, "publish")
                yield from (self._advertise(channel) for channel in message.channels)
            case protocol.ClientUnadvertise():
                yield from (self._unadvertise(number) for number in message.channel_ids)
            case protocol.SubscribeConnectionGraph():
                yield from self._follow_graph()
            case protocol.UnsubscribeConnectionGraph():
                self._told = None
            case protocol.FoxgloveFetchAsset():
                yield self._fetch(message)
            case _:
                yield from self._parameter_requests(message)

    def _parameter_requests(
        self,
        message: protocol.GetParameters
        | protocol.SetParameters
        | protocol.SubscribeParameterUpdates
        | protocol.UnsubscribeParameterUpdates,
    ) -> list[requests.HubRequest]:
        if isinstance(message, protocol.SetParameters):
            self._check(self._rights.control, "set parameters")
            return self._parameters.set(message)
        self._check(self._rights.view, "read parameters", READ_REMEDY)
        if isinstance(message, protocol.GetParameters):
            return self._parameters.get(message)
        if isinstance(message, protocol.SubscribeParameterUpdates):
            return self._parameters.follow(message.parameter_names)
        return self._parameters.unfollow(message.parameter_names)

    def _binary(self, message: protocol.ClientBinary) -> list[Output]:
        if isinstance(message, protocol.ServiceCallRequest):
            return [self._call(message)]
        self._check(self._rights.control, "publish")
        handle = self._published.get(message.channel_id)
        if handle is None:
            raise SessionError(f"channel {message.channel_id} is not advertised; advertise it before its messages")
        return [requests.PublishMessage(handle, message.payload)] if handle in self._publishers else []

    def _subscribe(self, wanted: protocol.FoxgloveSubscription) -> Iterator[Output | SessionError]:
        channel = self._channels.channels.get(wanted.channel_id)
        if channel is None:
            yield SessionError(f"there is no channel {wanted.channel_id}; its topic may be gone")
        elif wanted.id in self._by_id:
            yield SessionError(f"subscription {wanted.id} exists; end it first, or choose another number")
        elif wanted.channel_id in self._by_channel:
            yield SessionError(f"channel {wanted.channel_id} ({channel.topic}) has a subscription of this client")
        elif len(self._by_id) >= limits.FOXGLOVE_SUBSCRIPTIONS_MAX:
            yield SessionError(f"{len(self._by_id)} subscriptions are the limit of one client; end some first")
        else:
            subscription = _Subscription(wanted.id, wanted.channel_id, self._next_handle())
            self._by_id[wanted.id] = self._by_channel[wanted.channel_id] = subscription
            self._by_handle[subscription.handle] = subscription
            yield requests.Subscribe(subscription.handle, channel.topic, channel.schema_name)

    def _unsubscribe(self, number: int) -> Iterator[Output | SessionError]:
        subscription = self._by_id.get(number)
        if subscription is None:
            yield SessionError(f"there is no subscription {number} to end")
            return
        self._forget(subscription)
        yield requests.Unsubscribe(subscription.handle)

    def _forget(self, subscription: _Subscription) -> None:
        del self._by_id[subscription.id]
        del self._by_channel[subscription.channel_id]
        del self._by_handle[subscription.handle]

    def _advertise(self, channel: protocol.ClientChannel) -> Output | SessionError:
        if channel.id in self._published:
            return SessionError(f"channel {channel.id} is advertised; withdraw it first, or choose another number")
        if channel.encoding != protocol.ENCODING:
            return SessionError(f"{channel.topic}: the encoding {channel.encoding!r} is not {protocol.ENCODING!r}")
        topic = channel.topic if channel.topic.startswith("/") else f"/{channel.topic}"
        if not is_global_name(topic) or topic == "/":
            return SessionError(f"{channel.topic!r} is not a topic's name; write it like /cmd_vel")
        if not is_type_name(channel.schema_name):
            return SessionError(f"{topic}: {channel.schema_name!r} is not a type; write it like std_msgs/String")
        if len(self._published) >= limits.FOXGLOVE_ADVERTISED_MAX:
            return SessionError(f"{len(self._published)} published topics are the limit of one client")
        handle = self._published[channel.id] = self._next_handle()
        self._publishers.add(handle)
        return requests.AdvertiseTopic(handle, topic, channel.schema_name)

    def _unadvertise(self, number: int) -> Output | SessionError:
        handle = self._published.pop(number, None)
        if handle is None:
            return SessionError(f"channel {number} is not advertised, so it cannot be withdrawn")
        self._publishers.discard(handle)
        return requests.UnadvertiseTopic(handle)

    def _call(self, message: protocol.ServiceCallRequest) -> Output:
        call = _Call(message.service_id, message.call_id)
        service = self._channels.services.get(message.service_id)
        if not self._rights.control:
            return _call_failure(call, f"this client may not call services; {CONTROL_REMEDY}")
        if service is None:
            return _call_failure(call, f"there is no service {message.service_id}; it may be gone")
        if message.encoding != protocol.ENCODING:
            return _call_failure(call, f"the encoding {message.encoding[:80]!r} is not {protocol.ENCODING!r}")
        if len(self._calls) >= limits.FOXGLOVE_CALLS_MAX:
            return _call_failure(call, f"{len(self._calls)} calls wait for their response, which is the limit")
        handle = self._next_handle()
        self._calls[handle] = call
        return requests.CallService(handle, service.name, service.type, message.payload)

    def _fetch(self, message: protocol.FoxgloveFetchAsset) -> Output:
        error = self._asset_problem(message.uri)
        if error:
            return protocol.asset_failure(message.request_id, error)
        handle = self._next_handle()
        self._assets[handle] = message.request_id
        return requests.FetchAsset(handle, message.uri, limits.FOXGLOVE_ASSET_MAX)

    def _asset_problem(self, uri: str) -> str:
        scheme, _, path = uri.partition("://")
        parts = path.split("/")
        if not self._rights.view:
            return f"this client may not fetch assets; {READ_REMEDY}"
        if scheme != "package" or len(parts) < 2 or not all(parts) or not uri.isprintable():
            return "only files of ROS packages can be fetched: package://NAME/PATH"
        if any(part in (".", "..") for part in parts) or "\\" in path or "%" in path:
            return "the path of an asset must not leave its package"
        if len(self._assets) >= limits.FOXGLOVE_ASSETS_MAX:
            return f"{len(self._assets)} assets are being fetched, which is the limit; try again later"
        return ""

    def _follow_graph(self) -> Iterator[Output]:
        self._told = ConnectionGraph()
        if self._graph is not None and (update := self._told.update(self._graph)):
            yield update.frame()

    # --- the hub's answers ------------------------------------------------------------------------------------

    def _received(self, message: requests.ReceivedMessage) -> list[Output]:
        if message.handle == self._clock_handle:
            if len(message.payload) != _CLOCK.size:
                return []
            secs, nsecs = _CLOCK.unpack(message.payload)
            self._time_ns = secs * 1_000_000_000 + nsecs
            return [protocol.server_time(self._time_ns)]
        subscription = self._by_handle.get(message.handle)
        if subscription is None:
            return []
        known = self._channels.md5sums.get(subscription.channel_id)
        if known != message.md5sum and known and message.md5sum:
            channel = self._channels.channels[subscription.channel_id]
            found = self._channels.other_version(channel, message.md5sum, keep=subscription.delivered)
            return _framed(self._offered(found))
        subscription.delivered = True
        stamp = message.stamp_ns if self._time_ns is None else self._time_ns
        return [protocol.message_data(subscription.id, stamp, message.payload)]

    def _graph_changed(self, graph: requests.GraphChanged) -> Iterator[Output]:
        if graph.handle != self._graph_handle:
            return
        self._graph = graph
        yield from _framed(self._offered(self._channels.update(graph)))
        if self._told is not None and (update := self._told.update(graph)):
            yield update.frame()

    def _offered(
        self, messages: Iterable[protocol.ServerMessage | requests.HubRequest]
    ) -> Iterator[protocol.ServerMessage | requests.HubRequest]:
        """The messages; a withdrawn channel ends its subscription too."""
        for message in messages:
            yield message
            if isinstance(message, protocol.FoxgloveUnadvertise):
                for number in message.channel_ids:
                    if subscription := self._by_channel.get(number):
                        self._forget(subscription)
                        yield requests.Unsubscribe(subscription.handle)

    def _failed(self, failed: requests.Failed) -> list[Output]:
        handle = failed.handle
        text = f"{failed.error}; {failed.remedy}" if failed.remedy else failed.error
        if call := self._calls.pop(handle, None):
            return [_call_failure(call, text)]
        if (request := self._assets.pop(handle, None)) is not None:
            return [protocol.asset_failure(request, text)]
        if self._channels.owns(handle):
            return _framed(self._channels.answer(failed))
        out: list[Output] = [self.status(StatusLevel.ERROR, text)]
        if self._parameters.owns(handle):
            values = self._parameters.failed(handle)
            return out if values is None else [*out, values.frame()]
        if handle in self._publishers:
            # The client may not have read it yet: the messages that it sends meanwhile are dropped.
            self._publishers.discard(handle)
            return out
        # A failed subscription keeps its number until the client ends it, or its channel is withdrawn.
        return out if handle in self._by_handle or handle in (self._graph_handle, self._clock_handle) else []

    # --- inside -----------------------------------------------------------------------------------------------

    def _next_handle(self) -> int:
        return next(self._handles)

    def _check(self, right: bool, what: str, remedy: str = CONTROL_REMEDY) -> None:
        if not right:
            raise SessionError(f"this client may not {what}; {remedy}")

    def _refuse(self, error: RmpaError, now: float) -> list[Output]:
        if self._errors.take(now):
            return [self.status(StatusLevel.ERROR, str(error))]
        if isinstance(error, RemoteProtocolError):
            return [FoxgloveClose(_POLICY_VIOLATION, "too many malformed messages")]
        return []


def _framed(messages: Iterable[protocol.ServerMessage | requests.HubRequest]) -> list[Output]:
    return [each.frame() if isinstance(each, protocol.FromServer) else each for each in messages]


def _call_failure(call: _Call, error: str) -> FoxgloveFrame:
    return protocol.ServiceCallFailure(service_id=call.service_id, call_id=call.call_id, message=error).frame()


def _asset(request: int, data: Payload) -> BinaryFrame:
    if len(data) > limits.FOXGLOVE_ASSET_MAX:
        return protocol.asset_failure(request, f"its {len(data)} bytes are more than {limits.FOXGLOVE_ASSET_MAX}")
    return protocol.asset_response(request, data)
