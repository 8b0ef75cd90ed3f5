"""The part of the bridge for topics: local sources are sent to peers, and sources of peers are published here.

``topics.exports`` and ``topics.imports`` decide; this part carries out what they decide. The path of a message::

    publisher → ExportFlow (LocalSubscriptions) → RouteSender ⇢ link
         link ⇢ ImportFlow (PeerTopics) → Publication → subscribers
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict, deque
from typing import TYPE_CHECKING, Final

from rmpa.bridge.data.quality import shown_seconds
from rmpa.bridge.direct.grants import TopicGrants
from rmpa.bridge.graph_part import GraphPart
from rmpa.bridge.messages import CloseRoute, Mismatch, OpenRoute, RouteClosed, RouteOpened, Source
from rmpa.bridge.topics.direct import TopicPaths
from rmpa.bridge.topics.exports import Exports
from rmpa.bridge.topics.imports import Imports
from rmpa.bridge.topics.joins import Joins
from rmpa.bridge.topics.local import (
    LocalSources,
    LocalSubscriptions,
    Mismatches,
    RemoteSubscribers,
    compares_names,
)
from rmpa.bridge.topics.peer_topics import LossReports, PeerTopic, PeerTopics, TopicEvents
from rmpa.core.contract import Priority
from rmpa.core.identity import is_own
from rmpa.mesh import limits as mesh_limits
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.runtime.loop import yield_to_data

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from rmpa.bridge.data.quality import QosEvent
    from rmpa.bridge.data.route import RouteBegin
    from rmpa.bridge.messages import Message
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.shared import Shared
    from rmpa.bridge.topics.exports import ExportRoute
    from rmpa.bridge.topics.imports import RemoteTopic
    from rmpa.bridge.topics.peer_topics import Pasts
    from rmpa.ros.node.publication import Publication, Receiver, SubscriberConnection
    from rmpa.ros.wire.xmlrpc import RosReply

_log = logging.getLogger(__name__)

# The longest time between two wake-ups of an agent that receives data: data that arrived since the last one was not
# delayed by an outage.
STALE_TICK: Final = 0.04


class Topics(GraphPart, TopicEvents):
    """The topics of all peers, in both directions.

    Args:
        shared: The core, the peers and the rules.
        find: ``(node, slave API, topic)``: the topic of a proxy of this process; see ``LocalSubscriptions``.

    Attributes:
        peers: The topics of each peer in the local graph, by the number of its session.
        _pasts: By the name of a module: what is remembered of its reliable sources; see ``PeerTopics``.
        losses: Reports messages that do not reach their listeners.
        outbound: The subscriptions to local publishers, and the routes to the peers.
        _nodes: By topic: the nodes that publish it, as it was looked at last.
    """

    advertisement = "advertise"
    verb = "publishes"
    exports: Exports
    imports: Imports
    direct_exports: TopicGrants
    direct_imports: TopicPaths

    def __init__(self, shared: Shared, find: Callable[[str, str, str], Publication | None]) -> None:
        super().__init__(shared, Exports, Imports)
        self.peers: dict[int, PeerTopics] = {}
        self._pasts: OrderedDict[str, Pasts] = OrderedDict()
        self.losses = LossReports(shared, self.exports, self.peers, self)
        self.outbound = LocalSubscriptions(
            shared, self.exports, self.losses, self, find, lambda source: self.look((source.topic,))
        )
        self._mismatches = Mismatches(self, self.exports, self.imports)
        self._subscribers = RemoteSubscribers(shared, self, self.exports, self.imports, self.peers)
        self._joins = Joins(shared, self.exports, self.imports, self.outbound, self._subscribers)
        self.direct_exports = TopicGrants(shared, self.exports)
        self.direct_imports = TopicPaths(shared, self.warn, self.imports, self.peers)
        self._local = LocalSources(shared.core, shared.relay, lambda s: self.exports.description(s) is not None)
        self._nodes: dict[str, tuple[str, ...]] = {}
        self._ticker: asyncio.TimerHandle | None = None

    def mismatches(self, source: Source) -> tuple[str, ...]:
        """Texts about subscribers, here or at peers, whose definition does not fit a source's."""
        return self._mismatches.texts(source)

    # --- the bridge's part -------------------------------------------------------------------------------------

    async def close(self) -> None:
        """Leave all local publishers."""
        await super().close()
        if self._ticker is not None:
            self._ticker.cancel()
        await self.direct_imports.close()
        await self.direct_exports.ports.close()
        self._subscribers.close()
        self._joins.close()
        self.outbound.close()

    def reload(self) -> None:
        """As of ``GraphPart``."""
        super().reload()
        self.direct_exports.judge_again()
        self.direct_imports.reload()

    def link_up(self, session: PeerSession) -> None:
        """As of ``GraphPart``; suspended routes may go on."""
        peer, name = session.peer, session.link.name
        if peer in self.peers:
            _log.info("= %s is back: reliable topics go on", name)
            self.outbound.back(peer)
        else:
            self.peers[peer] = PeerTopics(self._shared, self, session, self._pasts_of)
        super().link_up(session)

    def _pasts_of(self, name: str) -> Pasts:
        """What is remembered of the reliable sources of a module."""
        pasts = self._pasts[name] = self._pasts.pop(name, {})
        if len(self._pasts) > mesh_limits.ABSENT_PEERS_MAX:
            self._pasts.popitem(last=False)
        return pasts

    def link_down(self, session: PeerSession) -> None:
        """Suspend the peer's routes; after silence its sources stay in the local graph for ``SILENT_GRACE``."""
        super().link_down(session)
        peer = session.peer
        if interrupted := self.peers[peer].link_down():
            self._shared.counters.add("route.interrupted", interrupted)
        self._subscribers.link_down(peer)
        self._joins.link_down(peer)
        # Without a pause for data: among it could be the peer's new link, which must find all routes suspended.
        deque(self.exports.link_away(peer, briefly=session.link.silent), 0)
        if session.link.silent:
            # Most silences end soon with a new link, so nothing leaves the local graph yet.
            deque(self.imports.link_away(peer, briefly=True), 0)

    def grace_over(self, session: PeerSession) -> bool:
        """Drop the peer's sources that do not outlive their link; return whether any route waits for the peer."""
        peer = session.peer
        if not self.exports.outage(peer) and not self.imports.waits_for(peer):
            self.imports.detached(peer)
            return False
        deque(self.imports.link_away(peer), 0)  # without a pause, as in ``link_down``
        longest = max(*self.imports.outages(peer), self.exports.outage(peer), 0.0)
        _log.info("= %s is away: its reliable topics wait for %s", session.link.name, shown_seconds(longest))
        return True

    def outlasted(self, session: PeerSession, seconds: float) -> float | None:
        """Drop sources whose contract's ``outage`` is over; return the next outage that is longer, in seconds."""
        peer = session.peer
        self.imports.outlasted(peer, seconds)
        outages = {*self.imports.outages(peer), self.exports.outage(peer)}
        return min((outage for outage in outages if outage > seconds), default=None)

    def gone(self, session: PeerSession) -> None:
        """Retract the rest of a peer's sources."""
        peer = session.peer
        super().gone(session)
        self.outbound.gone(peer)
        self._freeing.append(self.imports.link_down(peer))
        topics = self.peers.pop(peer)
        self._mismatches.peer_gone(session.link.name)
        self.run(self.exports.link_down(peer))
        self._shared.relay.peer_gone(peer)
        self.schedule()
        topics.close()

    def depends(self, session: PeerSession) -> bool:
        """As of ``GraphPart``; or whether nodes of this module have direct connections to the peer's."""
        return super().depends(session) or any(path.session is session for path in self.direct_imports)

    def lane_lost(self, session: PeerSession) -> None:
        """Abort messages that came in part over a lost bulk lane, and let the senders repeat or drop theirs."""
        for flow in self.peers[session.peer].flows.values():
            if flow.contract.priority is not Priority.HIGH:
                flow.torn()
        self.outbound.lane_lost(session.peer)

    def message(self, session: PeerSession, message: Message) -> bool:
        """Handle the control messages about topics and their routes."""
        peer = session.peer
        match message:
            case OpenRoute():
                self.exports.opened(peer, message)
            case RouteOpened():
                self.imports.opened(peer, message, self.now())
            case CloseRoute():
                self.exports.closed(peer, message)
            case RouteClosed():
                _log.info("< %s closes route %d: %s", session.link.name, message.route, message.reason)
                self.imports.closed(peer, message, self.now())
            case Mismatch():
                self._mismatches.reported(peer, session.link.name, message)
            case _:
                return self._subscribers.message(session, message)
        return True

    # --- the local graph ---------------------------------------------------------------------------------------

    def graph_changed(self, change: GraphChange) -> None:
        """Have the topic of a registration that came or went looked at."""
        self._local.changed(change)
        self.direct_exports.graph_changed(change)
        self.direct_imports.graph_changed(change)
        if change.kind is RegistrationKind.SUBSCRIBER:
            self._mismatches.registration_changed(change.name, change.node)
        if change.kind is not RegistrationKind.SERVICE:
            self.look((change.name,))

    def _names(self) -> Iterable[str]:
        return (*self._nodes, *self._shared.core.state().publishers)

    def _look_at(self, name: str) -> None:
        local, before = self._local.of(name), self._nodes.pop(name, ())
        publishers = local | self._local.relayed(name)
        nodes = dict.fromkeys((*before, *publishers))
        leaving = [node for node in nodes if node not in publishers and self.outbound.leave(Source(name, node))]
        if publishers or leaving:
            self._nodes[name] = (*publishers, *leaving)
        for node in nodes:
            if node not in leaving:
                self.exports.put(Source(name, node), publishers.get(node))
        self.imports.local_type(name, next((one.type for one in reversed(local.values())), None))

    def reconcile(self) -> None:
        """Register missing publications again; topics without local subscribers miss nothing any more."""
        state, compared = self._shared.core.state(), self.look_again()
        for pasts in self._pasts.values():
            for source, (watch, missed_at) in pasts.items():
                if all(map(is_own, state.subscribers.get(missed_at, ()))):
                    pasts[source] = watch, ""
        self.direct_exports.reconcile(state.subscribers)
        for topics in list(self.peers.values()):
            yield_to_data()
            if compared:
                topics.reconcile(state.publishers)

    def _settled(self) -> None:
        """Drop what belongs to sources that are gone, or that new rules keep home."""
        self._mismatches.forget_gone()
        self.direct_exports.judge_again(refused=False)

    # --- what local connections tell ---------------------------------------------------------------------------

    def demand(self, peer: int, source: Source, *, wanted: bool) -> None:
        """Begin or end to want a peer's source."""
        self.imports.demand(peer, source, self.now(), wanted=wanted)

    def occurred(self, peer: int, source: Source, event: QosEvent) -> None:
        """Warn of an event of a contract."""
        text = f"{self.peers[peer].session.link.name}: {source}: {event.text}"
        self.warn(f"contract.{event.kind.value}", f"{peer} {source}", text)

    def request(self, peer: int, source: Source, caller: str) -> Awaitable[RosReply | None] | None:
        """Answer a subscriber, perhaps with the publisher's own address."""
        return self.direct_imports.request(peer, source, caller)

    def mismatched(self, peer: int, source: Source, subscriber: str, text: str) -> None:
        """Tell the peer of a subscriber here whose definition does not fit its source."""
        self._mismatches.refused(peer, source, subscriber, text)

    def join(self, topic: PeerTopic, connection: SubscriberConnection) -> Receiver | None:
        """Let a publisher see a further subscriber; clients of actions are seen by their names."""
        return None if compares_names(topic.type) else self._joins.join(topic.session, topic, connection)

    def listeners_changed(self, peer: int, source: Source) -> None:
        """Follow the local subscribers of a peer's source."""
        self._subscribers.changed(peer, source)
        self.direct_imports.listeners_changed(peer, source)

    # --- effects of the exports --------------------------------------------------------------------------------

    def add_route(self, source: Source, peer: int, route: ExportRoute, begin: RouteBegin) -> None:
        """Begin to send a source's messages to a peer; first those that its contract or publisher keeps."""
        session = self._shared.sessions.get(peer)
        if session is None:
            return
        self.outbound.add_route(source, peer, route, begin, session.link)
        self.losses.tell_oversized(source, self.outbound.flows[source], peer)

    def suspend_route(self, source: Source, peer: int, outage: float) -> None:
        """Keep the unacknowledged and all further messages of a route for an absent peer, for a time in seconds."""
        self._subscribers.route_over(peer, source)
        self.outbound.suspend_route(source, peer, outage)

    def remove_route(self, source: Source, peer: int, number: int) -> None:
        """End a source's route to a peer, and drop its waiting messages; a suspended one has the number 0."""
        self._subscribers.route_over(peer, source)
        self.outbound.remove_route(source, peer)
        session = self._shared.sessions.get(peer)
        if session is not None and session.linked:
            session.link.close_route(number)

    # --- effects of the imports --------------------------------------------------------------------------------

    def position(self, entry: RemoteTopic) -> tuple[int, int] | None:
        """Epoch and last message of a source, behind which a route goes on, by this way or another; or ``None``."""
        carrier = self.imports.carrier(entry)
        topics = self.peers.get(carrier.peer) if carrier is not None else None
        if carrier is None or topics is None or (topic := topics.topics.get(carrier.wire)) is None:
            return None
        if topic.flow is not None:
            return topic.flow.position
        return self.exports.position(Source(topic.topic, topic.node.name))  # a relay has what its peer has

    def publish(self, entry: RemoteTopic) -> None:
        """Publish a peer's source at its proxy, in a later turn of the loop."""
        session, topics = self._shared.sessions.get(entry.peer), self.peers.get(entry.peer)
        if session is not None and topics is not None:
            proxies, node = self._shared.sessions.proxies(session, entry.node, entry.origin)
            self._pass_on(entry, session)
            topics.publish(entry, proxies, node)
            self.direct_imports.shown(entry)

    def moved(self, old: RemoteTopic, new: RemoteTopic) -> None:
        """Let another way carry a source, whose proxy and subscribers stay."""
        session, before = self._shared.sessions.get(new.peer), self.peers[old.peer]
        if session is not None and (topic := before.held.get(old.wire)) is not None:
            topic.move(self.peers[new.peer], new.wire)
            self._pass_on(new, session)
            self._shared.relay.gone(old.peer, old.wire)
            self.direct_imports.hidden(old)
            self.direct_imports.shown(new)
            self.look((new.name,))

    def path_changed(self, entry: RemoteTopic) -> None:
        """Offer what is relayed with the path that it has now."""
        if entry.shown and (session := self._shared.sessions.get(entry.peer)) is not None:
            self._pass_on(entry, session)
            self.look((entry.name,))

    def _pass_on(self, entry: RemoteTopic, session: PeerSession) -> None:
        name = self._shared.sessions.proxy_name(session, entry.node, entry.origin)
        place = (entry.name, name)
        self._shared.relay.pass_on(session.peer, session.link.identity, entry.wire, place, entry.origin)

    def retract(self, entry: RemoteTopic) -> None:
        """Remove a peer's source from the local graph: unregister it and close its sockets."""
        if (topics := self.peers.get(entry.peer)) is not None:
            self._shared.relay.gone(entry.peer, entry.wire)
            self.direct_imports.hidden(entry)
            topics.retract(entry.wire)

    def describe(self, entry: RemoteTopic, opened: RouteOpened) -> None:
        """Prepare for data on a newly opened route, and answer the waiting local subscribers with its description."""
        if (topics := self.peers.get(entry.peer)) is not None:
            if self._ticker is None:
                self._tick_later()
            topics.describe(entry.wire, opened)
            self._subscribers.changed(entry.peer, entry.wire)

    def detach(
        self, entry: RemoteTopic, *, keep: bool = False, missed: bool = False, last: int | None = None
    ) -> None:
        """End a route's data; unless ``keep``, the latched message is forgotten (a new route brings it again).

        Args:
            entry: The source and its route.
            keep: The link is gone, and the next one will continue after the last message that came.
            missed: Local nodes still listen, so they miss what is published before a route is open again.
            last: If the publisher has gone: the sequence of its last message.
        """
        if (topics := self.peers.get(entry.peer)) is not None:
            topics.detach(entry.wire, entry.route, keep=keep, missed=missed, last=last)

    def _tick_later(self) -> None:
        self._ticker = asyncio.get_running_loop().call_later(STALE_TICK, self._tick)

    def _tick(self) -> None:
        """Wake up regularly while routes are open, to distinguish a silent link from an agent that slept."""
        self._ticker = None
        if not self._closed and any(topics.flows for topics in self.peers.values()):
            self._tick_later()
