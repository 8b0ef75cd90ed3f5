"""What this module's nodes publish: local sources, subscriptions to them, and direct connections to them.

The publisher's side of direct transport for topics: grants subscribers of peers a connection to a local node.

A rospy publisher keeps one connection for each caller id: a second subscriber of that name closes the first one's
connection without a word (docs/design/ros-traps.md, trap 12). Therefore a name is granted once for each source, and
not at all while a local node of that name subscribes to the topic.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.data.export import ExportFlow, ReliableRouteSender
from rmpa.bridge.direct.grants import Grants
from rmpa.bridge.direct.nodes import Condition, Grant, Unmet, unmet_by_contract
from rmpa.bridge.direct.paths import Interruptions
from rmpa.bridge.messages import Description, Source
from rmpa.bridge.policy import OPEN_GATE, Needs, PermissionGate
from rmpa.bridge.topics.exports import LocalSource
from rmpa.bridge.topics.subscribers import compares_names
from rmpa.config.peer_rules import Access
from rmpa.core.contract import combine
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import OWN_NODE, is_own, is_type_name
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.reliable import ResumeTable
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.node.subscription import InProcessConnection, PublisherConnection
from rmpa.ros.wire.tcpros import ANY
from rmpa.ros.wire.tcpros import TopicDescription as TcprosDescription
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.bridge.actions import AddRoute, Connect, RemoveRoute, SuspendRoute
    from rmpa.bridge.data.export import RouteSender
    from rmpa.bridge.direct.grants import DirectAsk, Want
    from rmpa.bridge.direct.nodes import LocalEndpoints
    from rmpa.bridge.policy import Relay
    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.sessions import PeerSession, PeerSessions
    from rmpa.bridge.topics.exports import Exports
    from rmpa.core.contract import Contracts
    from rmpa.core.counters import Counters
    from rmpa.mesh.io.link import PeerLink
    from rmpa.mesh.reliable import ReliableSender
    from rmpa.ros.core.external import Core
    from rmpa.ros.master.registrations import Unreachable
    from rmpa.ros.node.publication import Publication
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.node.subscription import TopicConnection


class DirectExporter(Grants):
    """The direct connections of peers' subscribers to local publishers.

    Args:
        core: The local core.
        exports: Knows what is offered to each peer.
        contracts: The contracts of this module; replaced by ``reload``.
        endpoints: Finds the ports of local nodes.
        sessions: The peers.
        rpc: Carries the requests.
        counters: Count ``direct.granted`` and ``direct.ended``.
        gate: Whether the mesh is secured.
    """

    kind = "topic"

    def __init__(
        self,
        core: Core,
        exports: Exports,
        contracts: Contracts,
        endpoints: LocalEndpoints,
        sessions: PeerSessions,
        rpc: PeerRpc,
        counters: Counters,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        super().__init__(sessions, rpc, counters, gate)
        rpc.on_request("direct.topic", self._ask, Needs((Access.SUBSCRIBE,), "the topic: only what is offered"))
        rpc.on_notification("direct.topic_release", self._released, Needs((), "what was granted to the peer itself"))
        self._core = core
        self._exports = exports
        self._contracts = contracts
        self._endpoints = endpoints
        self.interruptions = Interruptions()
        """When peers' subscribers were without a grant because their link was lost."""
        self._standing: dict[tuple[int, str, str], set[str]] = {}
        """By peer, subscriber and topic: the granted nodes for which the subscriber's proxy is registered."""

    def reload(self, contracts: Contracts) -> None:
        """Take new contracts, and end what they do not allow."""
        self._contracts = contracts
        self.judge_again()

    def graph_changed(self, change: GraphChange) -> None:
        """Have peers ask again for what a registration that came or went touches."""
        if change.kind is RegistrationKind.SUBSCRIBER and not is_own(change.node):
            self._again(lambda want: (want.name, want.user) == (change.name, change.node))
        elif change.kind is RegistrationKind.PUBLISHER:
            self._endpoints.forget(change.api)
            self._again(lambda want: (want.name, want.node) == (change.name, change.node))

    def link_down(self, session: PeerSession, *, crashed: bool) -> None:
        """As of ``Grants``."""
        now = asyncio.get_running_loop().time()
        for peer, want, _ in self if not crashed else ():
            if peer == session.peer:
                self.interruptions.begin(session.link.name, want, now)
        super().link_down(session, crashed=crashed)

    async def close(self) -> None:
        """Cancel the questions to local nodes; direct connections go on."""
        await self._endpoints.close()

    # --- the local graph --------------------------------------------------------------------------------------------

    def _changed(self, session: PeerSession, want: Want, *, granted: bool) -> None:
        """Has the proxy of a peer's subscriber stand in the graph as a subscriber while it is granted."""
        key = (session.peer, want.user, want.name)
        nodes = self._standing.setdefault(key, set())
        before = bool(nodes)
        (nodes.add if granted else nodes.discard)(want.node)
        if not nodes:
            del self._standing[key]
        if granted:
            self.interruptions.end(session.link.name, want, asyncio.get_running_loop().time())
        if before == bool(nodes):
            return
        held, topic = f"subscriber of {want.name}", want.name
        if nodes:
            session.proxies.hold(
                want.user, held, lambda proxy: self._stand(topic, proxy), lambda proxy: self._go(topic, proxy)
            )
        else:
            session.proxies.release(want.user, held)

    def _stand(self, topic: str, proxy: SlaveNode) -> None:
        self._core.call("registerSubscriber", proxy.name, topic, ANY, proxy.uri)

    def _go(self, topic: str, proxy: SlaveNode) -> None:
        self._core.call("unregisterSubscriber", proxy.name, topic, proxy.uri)

    def reconcile(self, subscribers: Mapping[str, Mapping[str, str]]) -> None:
        """Register missing subscribers again: the core has been restarted."""
        for peer, subscriber, topic in list(self._standing):
            session = self._sessions.get(peer)
            proxy = session.proxies.get(subscriber) if session is not None else None
            if proxy is not None and proxy.name not in subscribers.get(topic, {}):
                self._stand(topic, proxy)

    # --- conditions -------------------------------------------------------------------------------------------------

    def _uri(self, want: Want) -> str:
        """The slave API of a publisher now; the exports learn a new one a little later."""
        return self._core.publishers(want.name).get(want.node, "")

    async def _find(self, session: PeerSession, want: Want) -> Grant | Unmet:
        uri = self._uri(want)
        found = await self._endpoints.of_topic(session, want.node, uri, want.name)
        if self._uri(want) not in {uri, ""}:
            return Unmet(Condition.NODE, f"{want.node} has restarted just now")
        return found

    def _broke(self, want: Want) -> None:
        self._endpoints.forget(self._uri(want))
        self._core.suspect(want.node)

    def _unmet(self, session: PeerSession, asked: DirectAsk) -> Unmet | None:
        if asked.contract is None:
            raise RemoteProtocolError("direct transport: a topic is asked for without a contract")
        source, where = Source(asked.name, asked.node), "the publisher's module"
        local = self._exports.local(session.peer, source)
        if local is None:
            return Unmet(Condition.OFFERED, f"{source} is not offered")
        if local != source:
            return Unmet(Condition.NAME, f"it is {local.topic} in the publisher's module")
        offered = self._exports.offered[source]
        if offered.origin is not None:
            return Unmet(Condition.OWN_SOURCE, "it comes by a relay")
        if compares_names(offered.type):
            return Unmet(Condition.ACTION, f"actions compare the names of the nodes at {offered.type}")
        contract = combine(self._contracts.of(source.topic, offered.type), asked.contract)
        unmet = unmet_by_contract(contract, where) or self._unmet_by_trust(session, where)
        if unmet is not None:
            return unmet
        if not self._uri(asked.want):
            return Unmet(Condition.NODE, f"{source.node} has just left")
        if asked.user in self._core.subscribers(source.topic):
            return Unmet(Condition.CALLER_ID, f"a node {asked.user} of the publisher's module subscribes too")
        return None


# The publishers of a topic in the local graph, each with its own type, as input of the exports.


class LocalSources:
    """The core's publishers, each with the type that it registered itself.

    The master keeps one type for each topic, the last one registered; peers need the type of each publisher.

    Args:
        core: The local core.
        relay: Knows which proxies are offered to other modules.
        flows: Whether the agent is connected to a source; such a source counts as reachable, whatever the core found.
    """

    def __init__(self, core: Core, relay: Relay, flows: Callable[[Source], bool] = lambda _: False) -> None:
        self._core = core
        self._flows = flows
        self._relay = relay
        self._types: dict[Source, str] = {}

    def changed(self, change: GraphChange) -> None:
        """Remembers the type of a publisher that registers; forgets it when the publisher leaves."""
        if change.kind is RegistrationKind.PUBLISHER:
            if is_own(change.node) and not self._relay.enabled:
                return  # thousands of proxies, whose types only a relay needs
            source = Source(change.name, change.node)
            if not change.added:
                self._types.pop(source, None)
            elif is_type_name(change.type):
                self._types[source] = change.type

    def of(self, topic: str) -> dict[str, LocalSource]:
        """This module's own publishers of a topic, by node, without those that cannot be reached."""
        unreachable = self._core.unreachable()
        nodes = {
            node: uri
            for node, uri in self._core.publishers(topic).items()
            if not is_own(node) and not (node in unreachable and self._withdrawn(unreachable[node], topic, node))
        }
        said = self._core.type_of(topic) if nodes else ""
        return {node: LocalSource(self._type(topic, node, said), uri) for node, uri in nodes.items()}

    def relayed(self, topic: str) -> dict[str, LocalSource]:
        """The proxies of a topic that this agent relays, by node, with their origin; empty if it is no relay."""
        if not self._relay.enabled:
            return {}
        said = self._core.type_of(topic)
        publishers: Mapping[str, str] = self._core.publishers(topic)
        return {
            node: LocalSource(self._type(topic, node, said), uri, origin)
            for node, uri in publishers.items()
            if (origin := self._relay.origin((topic, node))) is not None
        }

    def _withdrawn(self, found: Unreachable, topic: str, node: str) -> bool:
        return found.withdrawn and not self._flows(Source(topic, node))

    def _type(self, topic: str, node: str, otherwise: str) -> str:
        return self._types.get(Source(topic, node)) or otherwise


# Carries out the export plan: one subscription to each local publisher that a peer wants.


_log = logging.getLogger(__name__)


class LocalSubscriptions:
    """Subscriptions to local publishers, as the agent's own node.

    Args:
        core: The local core; the agent's subscriptions are registered there, so that ROS tools show them.
        node: The agent's own node.
        on_described: Called with a source and its publisher's header.
        on_lost: Called with a source, a reason and, by peer, the last message of each reliable route when its
            publisher is no longer connected.
        on_given_up: ``(peer, messages by source)``: called when messages are not kept any more for an absent peer.
        on_missed: Called with a source, a peer, and the number of messages that it has missed over an outage.
        on_oversized: Called with a source and its flow when a message that is too long was left out.
        on_malformed: Called with a source and a text when its publisher breaks TCPROS; ``on_lost`` follows.
        find: ``(node, slave API, topic)``: the topic of a proxy of this process, which is subscribed to without a
            socket; ``None`` for others.
    """

    def __init__(
        self,
        core: Core,
        node: SlaveNode,
        *,
        on_described: Callable[[Source, Description], None],
        on_lost: Callable[[Source, str, Mapping[int, int]], None],
        on_given_up: Callable[[int, Mapping[Source, int]], None],
        on_missed: Callable[[Source, int, int], None],
        on_oversized: Callable[[Source, ExportFlow], None],
        on_malformed: Callable[[Source, str], None],
        find: Callable[[str, str, str], Publication | None] = lambda *_: None,
    ) -> None:
        self._find = find
        self._on_malformed = on_malformed
        self._on_oversized = on_oversized
        self._core = core
        self._node = node
        self._on_described = on_described
        self._on_lost = on_lost
        self._connections: dict[Source, TopicConnection] = {}
        self.flows: dict[Source, ExportFlow] = {}
        """The flow of each connected source, for snapshots."""
        self._senders: dict[tuple[int, int], RouteSender] = {}
        self._parked: ResumeTable[tuple[int, Source]] = ResumeTable()
        # Kept messages are dropped when their outage is over.
        self._timer = MachineTimer(self._parked.next_timer, lambda now: self._give_up(self._parked.expire(now)))
        self._on_given_up = on_given_up
        self._on_missed = on_missed

    @property
    def connections(self) -> Iterable[TopicConnection]:
        """The connections to local publishers."""
        return self._connections.values()

    def connect(self, action: Connect) -> None:
        """Subscribe to one publisher; ``on_described`` or ``on_lost`` reports the outcome."""
        source = action.source
        flow = self.flows[source] = ExportFlow()
        if sum(s.topic == source.topic for s in self.flows) == 1:
            self._core.call("registerSubscriber", OWN_NODE, source.topic, "*", self._node.uri)
        _log.debug("> subscribe to %s at %s", source, action.uri)
        connection = self._connections[source] = self._connection(source, action.uri, flow)
        connection.start()

    def _connection(self, source: Source, uri: str, flow: ExportFlow) -> TopicConnection:
        """A connection to a publisher, without a socket if it is a proxy of this process."""

        def find() -> Callable[[InProcessConnection], None] | None:
            publication = self._find(source.node, uri, source.topic)
            return publication.attach if publication is not None else None

        kind = PublisherConnection if find() is None else InProcessConnection
        connection: TopicConnection = kind(
            source.topic,
            uri,
            OWN_NODE,
            on_message=flow.message,
            on_parts=flow,
            on_header=lambda fields: self._header(source, fields),
            on_refused=lambda text: self._gone(source, connection, f"its publisher refuses: {text}"),
            on_lost=lambda reason: self._gone(source, connection, reason),
            on_oversized=lambda size: self._left_out(source, flow, size),
            number=self._node.next_number(),
            find=find,
        )
        return connection

    def disconnect(self, source: Source) -> None:
        """Disconnect one publisher, and drop its routes."""
        connection = self._connections.pop(source, None)
        if connection is not None:
            connection.close()
        self._drop(source)

    def add_route(self, action: AddRoute, link: PeerLink) -> None:
        """Send a source to one more peer, or resume its suspended route.

        Raises:
            RemoteProtocolError: The peer resumes after a message that was never sent.
        """
        flow = self.flows[action.source]
        route_sender = flow.by_peer.get(action.peer)
        self._claim(action.peer, action.source)
        if (
            action.after is not None
            and isinstance(route_sender, ReliableRouteSender)
            and route_sender.sender.epoch == action.epoch
        ):
            try:
                route_sender.resume(link, action.route, action.after)
            except RemoteProtocolError:
                flow.remove(action.peer)  # the caller closes the link; the next one gets a new numbering
                raise
            if missed := route_sender.missed():
                self._on_missed(action.source, action.peer, missed)
        else:
            self._end(action.source, action.peer)
            route_sender = flow.add(action.peer, link, action.route, action.contract, action.epoch)
        self._senders[action.peer, action.route] = route_sender

    def suspend_route(self, action: SuspendRoute) -> None:
        """Keep a reliable source's messages for a peer whose link is gone; does nothing for best effort."""
        flow = self.flows.get(action.source)
        if flow is not None:
            route_sender = flow.by_peer.get(action.peer)
            self._forget(route_sender, action.peer)
            if isinstance(route_sender, ReliableRouteSender):
                key = (action.peer, action.source)
                flow.suspend(action.peer, self._keeper(key))
                until = asyncio.get_running_loop().time() + action.outage
                self._give_up(self._parked.park(key, route_sender.sender, until))
                self._timer.arm()

    def _keeper(self, key: tuple[int, Source]) -> Callable[[bytes, int], object]:
        """Returns the function that keeps a source's messages for an absent peer."""
        return lambda payload, stamp: self._give_up(self._parked.offer(key, payload, stamp))

    def back(self, peer: int) -> None:
        """Give a peer that has a link again ``mesh.limits.RESUME_CLAIM`` to open its suspended routes."""
        until = asyncio.get_running_loop().time() + mesh_limits.RESUME_CLAIM
        self._parked.limit([(peer, source) for source in self.flows], until)
        self._timer.arm()

    def gone(self, peer: int) -> None:
        """Give up the messages that are kept for a peer that will not come back."""
        keys = [(peer, source) for source in self.flows]
        self._give_up([key for key in keys if self._parked.claim(key) is not None])

    def remove_route(self, action: RemoveRoute) -> None:
        """End a source's route to a peer."""
        self._claim(action.peer, action.source)
        self._end(action.source, action.peer)

    def numbering(self, source: Source, peer: int) -> ReliableSender | None:
        """The sender of a source's reliable route to a peer, suspended or not; ``None`` if there is none."""
        flow = self.flows.get(source)
        route_sender = flow.by_peer.get(peer) if flow is not None else None
        return route_sender.sender if isinstance(route_sender, ReliableRouteSender) else None

    def _end(self, source: Source, peer: int) -> None:
        """Removes a source's sender to a peer, if there is one."""
        flow = self.flows.get(source)
        route_sender = flow.by_peer.get(peer) if flow is not None else None
        if flow is not None and route_sender is not None:
            self._forget(route_sender, peer)
            flow.remove(peer)

    def _claim(self, peer: int, source: Source) -> None:
        self._parked.claim((peer, source))
        self._timer.arm()

    def _give_up(self, keys: list[tuple[int, Source]]) -> None:
        """Reports routes whose messages are not kept any more for absent peers."""
        for peer in dict.fromkeys(peer for peer, _ in keys):
            counts = {}
            for source in (source for one, source in keys if one == peer):
                route_sender = self.flows[source].by_peer.get(peer)
                if isinstance(route_sender, ReliableRouteSender):
                    counts[source] = route_sender.missed() + route_sender.sender.pending
            self._on_given_up(peer, counts)

    def sender(self, peer: int, route: int) -> RouteSender | None:
        """The sender of a peer's route; ``None`` if the route is not open."""
        return self._senders.get((peer, route))

    def lane_lost(self, peer: int) -> None:
        """Report the loss of a peer's bulk lane to its routes."""
        for (owner, _), route_sender in list(self._senders.items()):
            if owner == peer:
                route_sender.lane_lost()

    def _forget(self, route_sender: RouteSender | None, peer: int) -> None:
        if route_sender is not None and self._senders.get((peer, route_sender.route)) is route_sender:
            del self._senders[peer, route_sender.route]

    def close(self) -> None:
        """Disconnect all publishers."""
        for source in list(self._connections):
            self.disconnect(source)
        self._timer.close()

    def _header(self, source: Source, fields: Mapping[str, str]) -> None:
        about = TcprosDescription.from_header(fields)
        text = about.definition.encode(errors="surrogateescape").decode("latin-1")
        description = Description(about.type, about.md5sum, text, about.latching)
        if description.problem:
            self._gone(source, self._connections[source], description.problem)
            return
        if description.latching:
            self.flows[source].latch()
        self._on_described(source, description)

    def _left_out(self, source: Source, flow: ExportFlow, size: int) -> None:
        flow.left_out(size)
        self._on_oversized(source, flow)

    def _gone(self, source: Source, connection: TopicConnection, reason: str) -> None:
        if self._connections.get(source) is not connection:
            return
        self._connections.pop(source).close()
        short = DESCRIPTORS.problem  # reported once for the process; the node itself may be well
        _log.log(logging.DEBUG if short else logging.INFO, "= %s: %s", source, reason)
        if connection.malformed:
            self._on_malformed(source, reason)
        numberings = {peer: self.numbering(source, peer) for peer in self.flows[source].by_peer}
        self._drop(source)  # first: what follows may connect the source anew
        lasts = {peer: numbering.last for peer, numbering in numberings.items() if numbering is not None}
        self._on_lost(source, reason[: limits.CONTROL_TEXT_MAX], lasts)
        if not short:
            self._core.suspect(source.node)

    def _drop(self, source: Source) -> None:
        flow = self.flows.pop(source, None)
        if flow is not None:
            for peer in list(flow.by_peer):
                self._claim(peer, source)
                self._forget(flow.by_peer[peer], peer)
            flow.close()
        if flow is not None and not any(s.topic == source.topic for s in self.flows):
            self._core.call("unregisterSubscriber", OWN_NODE, source.topic, self._node.uri)
