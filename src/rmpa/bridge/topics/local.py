"""What this module's nodes publish: the publishers of a topic, each with its own type, and subscriptions to them."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.data.export import ExportFlow, ReliableRouteSender
from rmpa.bridge.messages import Description, Source
from rmpa.bridge.topics.exports import LocalSource
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import OWN_NODE, is_own, is_type_name
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.reliable import ResumeTable
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.node.subscription import InProcessConnection, PublisherConnection
from rmpa.ros.wire.tcpros import TopicDescription as TcprosDescription
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.bridge.data.export import RouteSender
    from rmpa.bridge.offers import Effects
    from rmpa.bridge.policy import Relay
    from rmpa.bridge.shared import Shared
    from rmpa.bridge.topics.exports import ExportRoute, Exports
    from rmpa.bridge.topics.peer_topics import LossReports
    from rmpa.mesh.io.link import PeerLink
    from rmpa.mesh.reliable import ReliableSender
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.publication import Publication
    from rmpa.ros.node.subscription import TopicConnection


_log = logging.getLogger(__name__)


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
        return {
            node: LocalSource(self._type(topic, node), uri)
            for node, uri in self._core.publishers(topic).items()
            if not is_own(node)
            and (node not in unreachable or not unreachable[node].withdrawn or self._flows(Source(topic, node)))
        }

    def relayed(self, topic: str) -> dict[str, LocalSource]:
        """The proxies of a topic that this agent relays, by node, with their origin; empty if it is no relay."""
        publishers: Mapping[str, str] = self._core.publishers(topic) if self._relay.enabled else {}
        return {
            node: LocalSource(self._type(topic, node), uri, origin)
            for node, uri in publishers.items()
            if (origin := self._relay.origin((topic, node))) is not None
        }

    def _type(self, topic: str, node: str) -> str:
        return self._types.get(Source(topic, node)) or self._core.type_of(topic)


class LocalSubscriptions:
    """Subscriptions to local publishers that a peer wants, as the agent's own node, and the routes to the peers.

    Args:
        shared: The local core and the agent's node; its subscriptions are registered, so that ROS tools show them.
        exports: Is told what publishers say.
        losses: Reports what peers miss.
        out: Warns of publishers that break TCPROS.
        find: ``(node, slave API, topic)``: the topic of a proxy of this process, which is subscribed to without a
            socket; ``None`` for others.

    Attributes:
        flows: The flow of each source that the agent is connected to, for snapshots.
        senders: The sender of each open route, by its peer and its id.
    """

    def __init__(
        self,
        shared: Shared,
        exports: Exports,
        losses: LossReports,
        out: Effects,
        find: Callable[[str, str, str], Publication | None] = lambda *_: None,
    ) -> None:
        self._core = shared.core
        self._node = shared.node
        self._exports, self._losses, self._out = exports, losses, out
        self._find = find
        self.flows: dict[Source, ExportFlow] = {}
        self.senders: dict[tuple[int, int], RouteSender] = {}
        self._parked: ResumeTable[tuple[int, Source]] = ResumeTable()
        # Kept messages are dropped when their outage is over.
        self._timer = MachineTimer(self._parked.next_timer, lambda now: self._give_up(self._parked.expire(now)))

    @property
    def connections(self) -> Iterable[TopicConnection]:
        """The connections to local publishers."""
        return [flow.connection for flow in self.flows.values()]

    def connect(self, source: Source, uri: str) -> None:
        """Subscribe to a publisher at its slave API; the exports are told its header later, or that it is lost."""

        def find() -> Callable[[InProcessConnection], None] | None:
            publication = self._find(source.node, uri, source.topic)
            return publication.attach if publication is not None else None

        if not any(one.topic == source.topic for one in self.flows):
            self._core.call("registerSubscriber", OWN_NODE, source.topic, "*", self._node.uri)
        _log.debug("> subscribe to %s at %s", source, uri)
        flow = self.flows[source] = ExportFlow()
        kind = PublisherConnection if find() is None else InProcessConnection
        flow.connection = kind(
            source.topic,
            uri,
            OWN_NODE,
            on_message=flow.message,
            on_parts=flow,
            on_header=lambda fields: self._header(source, fields),
            on_refused=lambda text: self._gone(source, flow, f"its publisher refuses: {text}"),
            on_lost=lambda reason: self._gone(source, flow, reason),
            on_oversized=lambda size: self._losses.oversized(source, flow, size),
            number=self._node.next_number(),
            find=find,
        )
        flow.connection.start()

    def disconnect(self, source: Source) -> None:
        """Disconnect one publisher, and drop its routes."""
        if (flow := self.flows.get(source)) is not None:
            flow.connection.close()
            for peer in list(flow.by_peer):
                self.remove_route(source, peer)
            flow.close()
            del self.flows[source]
            if not any(one.topic == source.topic for one in self.flows):
                self._core.call("unregisterSubscriber", OWN_NODE, source.topic, self._node.uri)

    def add_route(self, source: Source, peer: int, route: ExportRoute, link: PeerLink) -> None:
        """Send a source to one more peer, or resume its suspended route.

        Raises:
            RemoteProtocolError: The peer resumes after a message that was never sent.
        """
        flow = self.flows[source]
        sender = flow.by_peer.get(peer)
        if route.after is not None and isinstance(sender, ReliableRouteSender) and sender.sender.epoch == route.epoch:
            self._parked.claim((peer, source))
            self._timer.arm()
            try:
                sender.resume(link, route.number, route.after)
            except RemoteProtocolError:
                flow.remove(peer)  # the caller closes the link; the next one gets a new numbering
                raise
            if missed := sender.missed():
                self._losses.missed(source, peer, missed)
        else:
            self.remove_route(source, peer)
            sender = flow.add(peer, link, route.number, route.contract, route.epoch)
        self.senders[peer, route.number] = sender

    def suspend_route(self, source: Source, peer: int, outage: float) -> None:
        """Keep a reliable source's messages for an absent peer, for a time in seconds; best effort keeps none."""
        sender = self._sender_of(source, peer)
        self._forget(peer, sender)
        if isinstance(sender, ReliableRouteSender):
            key = (peer, source)
            sender.suspend(lambda payload, stamp: self._give_up(self._parked.offer(key, payload, stamp)))
            loop = asyncio.get_running_loop()
            if full := self._parked.park(key, sender.sender, loop.time() + outage):
                loop.call_soon(self._give_up, full)  # later: the exports are at work on these routes now
            self._timer.arm()

    def back(self, peer: int) -> None:
        """Give a peer that has a link again ``mesh.limits.RESUME_CLAIM`` to open its suspended routes."""
        until = asyncio.get_running_loop().time() + mesh_limits.RESUME_CLAIM
        self._parked.limit([(peer, source) for source in self.flows], until)
        self._timer.arm()

    def gone(self, peer: int) -> None:
        """Give up the messages that are kept for a peer that will not come back."""
        keys = [(peer, source) for source in self.flows]
        self._give_up([key for key in keys if self._parked.claim(key) is not None])

    def remove_route(self, source: Source, peer: int) -> None:
        """End a source's route to a peer, if there is one, suspended or not."""
        self._parked.claim((peer, source))
        self._timer.arm()
        if (sender := self._sender_of(source, peer)) is not None:
            self._forget(peer, sender)
            self.flows[source].remove(peer)

    def numbering(self, source: Source, peer: int) -> ReliableSender | None:
        """The sender of a source's reliable route to a peer, suspended or not; ``None`` if there is none."""
        sender = self._sender_of(source, peer)
        return sender.sender if isinstance(sender, ReliableRouteSender) else None

    def _sender_of(self, source: Source, peer: int) -> RouteSender | None:
        flow = self.flows.get(source)
        return flow.by_peer.get(peer) if flow is not None else None

    def _give_up(self, keys: list[tuple[int, Source]]) -> None:
        """Reports routes whose messages are not kept any more for absent peers."""
        for peer in dict.fromkeys(peer for peer, _ in keys):
            counts = {}
            for source in (source for one, source in keys if one == peer):
                sender = self._sender_of(source, peer)
                if isinstance(sender, ReliableRouteSender):
                    counts[source] = sender.missed() + sender.sender.pending
            self._losses.given_up(peer, counts)
            for source in counts:
                self._exports.given_up(source, peer)

    def lane_lost(self, peer: int) -> None:
        """Report the loss of a peer's bulk lane to its routes."""
        for (owner, _), route_sender in list(self.senders.items()):
            if owner == peer:
                route_sender.lane_lost()

    def _forget(self, peer: int, sender: RouteSender | None) -> None:
        """Takes no marks of a route any more; of a suspended one another route may have the id since."""
        if sender is not None and self.senders.get((peer, sender.route)) is sender:
            del self.senders[peer, sender.route]

    def close(self) -> None:
        """Disconnect all publishers."""
        for source in list(self.flows):
            self.disconnect(source)
        self._timer.close()

    def _header(self, source: Source, fields: Mapping[str, str]) -> None:
        about = TcprosDescription.from_header(fields)
        text = about.definition.encode(errors="surrogateescape").decode("latin-1")
        description = Description(about.type, about.md5sum, text, about.latching)
        if description.problem:
            self._gone(source, self.flows[source], description.problem)
            return
        if description.latching:
            self.flows[source].latch()
        self._exports.described(source, description)

    def _gone(self, source: Source, flow: ExportFlow, reason: str) -> None:
        if self.flows.get(source) is not flow:
            return
        short = DESCRIPTORS.problem  # reported once for the process; the node itself may be well
        _log.log(logging.DEBUG if short else logging.INFO, "= %s: %s", source, reason)
        if flow.connection.malformed:
            self._out.warn("publisher.malformed", str(source), f"{source}: {reason}")
        lasts = {peer: one.last for peer in flow.by_peer if (one := self.numbering(source, peer)) is not None}
        self.disconnect(source)  # first: what follows may connect the source anew
        self._exports.lost(source, reason[: limits.CONTROL_TEXT_MAX], lasts)
        if not short:
            self._core.suspect(source.node)
