"""The topics of peers in the local graph: publications of proxies and their flows; and reports of messages lost.

Reported are reliable messages that were given up, and messages that are too long to cross: in the log, and to the
agent at the other end.
"""

from __future__ import annotations

import asyncio
import logging
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from msgspec import UnsetType

from rmpa.bridge import limits
from rmpa.bridge.data.quality import shown_seconds
from rmpa.bridge.data.reception import ImportFlow
from rmpa.bridge.messages import Source
from rmpa.bridge.policy import Needs
from rmpa.core.contract import Durability, Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import OWN_NODE, serial_add
from rmpa.mesh import limits as mesh_limits
from rmpa.ros import limits as ros_limits
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.wire.tcpros import TopicDescription, printable
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.bridge.data.export import ExportFlow
    from rmpa.bridge.data.quality import QosEvent, QosWatch
    from rmpa.bridge.messages import RouteOpened
    from rmpa.bridge.offers import Effects
    from rmpa.bridge.proxies import PeerProxies
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.shared import Shared
    from rmpa.bridge.topics.exports import Exports
    from rmpa.bridge.topics.imports import RemoteTopic
    from rmpa.ros.node.publication import Receiver, SubscriberConnection
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.xmlrpc import RosReply

_log = logging.getLogger(__name__)


# What is remembered of the reliable sources of a module, by topic here and node there; see ``PeerTopics``.
Pasts = dict[Source, tuple["QosWatch", str]]


class TopicEvents:
    """What the topics of peers tell the part that has them; for subclasses. All give the peer and its source."""

    def demand(self, peer: int, source: Source, *, wanted: bool) -> None:
        """A local node wants a source, or none does any more."""

    def mismatched(self, peer: int, source: Source, subscriber: str, text: str) -> None:
        """The type or definition of a local subscriber does not fit; the subscriber's name and the reason."""

    def join(self, topic: PeerTopic, connection: SubscriberConnection) -> Receiver | None:  # noqa: ARG002
        """A further subscriber connects to an open topic; see ``PublicationEvents``."""
        return None

    def listeners_changed(self, peer: int, source: Source) -> None:
        """The set of local subscribers has changed."""

    def occurred(self, peer: int, source: Source, event: QosEvent) -> None:
        """Something happened to a contract."""

    def request(self, peer: int, source: Source, caller: str) -> Awaitable[RosReply | None] | None:  # noqa: ARG002
        """Answer the ``requestTopic`` of a subscriber; see ``PublicationEvents``."""
        return None


class PeerTopic(PublicationEvents):
    """One source at its proxy: the publication, and the flow of its route, whichever peer carries it.

    Args:
        peer: All topics of the peer that carries it.
        entry: The source.

    Attributes:
        topic: The name in the local graph.
        flow: The flow of its route: the open one, or the one that outlived its link.
        on_open: Called when its route is open, where this module has to pass it on since before.
    """

    __slots__ = (
        "_key",
        "_pasts",
        "_peer",
        "flow",
        "node",
        "on_open",
        "publication",
        "release",
        "source",
        "topic",
        "type",
    )

    def __init__(self, peer: PeerTopics, entry: RemoteTopic) -> None:
        self._peer = peer
        self.source, self.type = entry.wire, entry.type
        self.topic = entry.name
        # Where its events are remembered, by its names in its module and here: another peer may carry it next.
        self._pasts = peer.pasts(entry.module[1])
        self._key = Source(entry.name, entry.node if entry.origin is None else entry.origin.node)
        self.node: SlaveNode
        self.publication: Publication
        self.release: Callable[[], None]
        self.flow: ImportFlow | None = None
        self.on_open: Callable[[], object] | None = None

    def move(self, peer: PeerTopics, source: Source) -> None:
        """Let another peer carry it, which calls it ``source``."""
        before, was = self._peer, self.source
        before.held.pop(was, None)
        registered = before.topics.pop(was, None)
        self._peer, self.source = peer, source
        peer.held[source] = self
        if registered is not None:
            peer.topics[source] = self

    # --- at the proxy ------------------------------------------------------------------------------------------

    def ready(self, node: SlaveNode) -> None:
        """Register the topic: its proxy exists."""
        self.node, self.publication = node, Publication(self.topic, node.name, events=self)
        node.add_publication(self.publication)
        self._peer.topics[self.source] = self
        self.register()

    def left(self, node: SlaveNode) -> None:
        """Unregister the topic; nothing happens if it was never registered."""
        if self._peer.topics.get(self.source) is self:
            del self._peer.topics[self.source]
            self._peer.core.call("unregisterPublisher", node.name, self.topic, node.uri)
            # rospy does not leave a publisher when the master removes it, so its connection is closed.
            node.remove_publication(self.topic)

    def register(self) -> None:
        """Register the proxy as a publisher; without effect once the topic has left."""
        if self._peer.topics.get(self.source) is not self:
            return
        node = self.node
        code, status, _ = self._peer.core.call("registerPublisher", node.name, self.topic, self.type, node.uri)
        if code != 1:
            _log.error("! the ROS core does not accept %s of %s: %s [core-refuses]", self.topic, node.name, status)

    def first_subscriber(self) -> None:
        """The source is wanted."""
        self._peer.part.demand(self._peer.session.peer, self.source, wanted=True)

    def last_subscriber(self) -> None:
        """It is not wanted any more."""
        self._peer.part.demand(self._peer.session.peer, self.source, wanted=False)

    def mismatch(self, fields: Mapping[str, str], text: str) -> None:
        """The peer is told of it."""
        subscriber = printable(fields.get("callerid", ""))
        self._peer.part.mismatched(self._peer.session.peer, self.source, subscriber, text)

    def listeners_changed(self) -> None:
        """The peer may have to know their names."""
        self._peer.part.listeners_changed(self._peer.session.peer, self.source)

    def join(self, connection: SubscriberConnection) -> Receiver | None:
        """The publisher may have something to say to it alone."""
        return self._peer.part.join(self, connection)

    @property
    def session(self) -> PeerSession:
        """The peer."""
        return self._peer.session

    def request(self, caller: str) -> Awaitable[RosReply | None] | None:
        """A subscriber may get a direct connection."""
        return self._peer.part.request(self._peer.session.peer, self.source, caller)

    # --- the flow ----------------------------------------------------------------------------------------------

    @property
    def watch(self) -> QosWatch | None:
        """The watch of its flow, or of the last one of a reliable source."""
        return self.flow.watch if self.flow is not None else self._pasts.get(self._key, (None, ""))[0]

    def occurred(self, event: QosEvent) -> None:
        """An event of the contract."""
        self._peer.part.occurred(self._peer.session.peer, self.source, event)

    def torn(self) -> None:
        """Register the proxy again, so that subscribers that were disconnected connect again.

        rospy connects only when the master names the publisher, and only if it has noticed the end by then. Hence
        the repetition after ``limits.CALL_BACK_DELAYS``.
        """
        for delay in limits.CALL_BACK_DELAYS:
            asyncio.get_running_loop().call_later(delay, self.register)

    def open(self, opened: RouteOpened) -> ImportFlow:
        """Take the data of a newly opened route; a reliable flow continues where the last link ended.

        The count of a reliable source goes on in any case. Where it cannot know what was lost, that is an event.
        """
        contract, flow, session = opened.contract, self.flow, self._peer.session
        past, missed_at = self._pasts.pop(self._key, (None, ""))
        known = flow is not None
        if flow is not None and flow.contract.reliability is Reliability.RELIABLE:
            past, missed_at = flow.watch, self.topic
        reliable = contract.reliability is Reliability.RELIABLE
        cut, had = known and not reliable, flow.position if flow is not None else None
        continues = had is not None and had[0] == opened.epoch
        # An older agent does not number best-effort routes: their epoch is 0, and each begins anew.
        if flow is None or not flow.contract.same_route(contract) or not opened.epoch:
            if flow is not None:
                flow.close()
            flow = ImportFlow(
                self.publication,
                contract,
                session.time,
                self._peer.counters,
                self.occurred,
                self.torn,
                past if reliable else None,
                numbering=flow.numbering if flow is not None and continues else None,
                relays=self._peer.relays,
            )
        is_other = flow is not self.flow
        self.flow, flow.contract, flow.link_time = flow, contract, session.time
        goes_on = flow.bind(session.link, opened.route, opened.epoch, opened.first)
        renumbered = (is_other or not goes_on) and self.publication.description is not None
        if self._peer.relays and renumbered and self.on_open is None:
            self.publication.hang_up(OWN_NODE)  # what is relayed has other numbers from now on
        self.publication.bound(contract.queue_depth)
        if contract.durability is Durability.TRANSIENT_LOCAL:
            self.publication.keep(contract.kept)
        if goes_on and not isinstance(opened.following, UnsetType):
            flow.skip(opened.following)
        elif not goes_on and (cut or (reliable and (missed_at or opened.unknown is True))):
            flow.missed_unknown("an agent was restarted, or the route had ended")
        about = opened.description
        text = about.definition.encode("latin-1").decode(errors="surrogateescape")
        if self.publication.describe(TopicDescription(about.type, about.md5, text, about.latching)):
            self.torn()
        if not goes_on:
            flow.expect_replay(self.publication.latched)
        if opened.shared is True and not known:
            self.publication.join()
        on_open, self.on_open = self.on_open, None
        if on_open is not None:
            on_open()
        return flow

    def end(self, *, missed: bool, gone: bool = True) -> None:
        """End the flow, if there is one, and remember the events of a reliable one.

        Args:
            missed: Whether a local node still listens, so that later messages are missed.
            gone: Whether the source leaves the graph or its route has ended: lost liveliness does not wait for its
                lease.
        """
        flow, self.flow, pasts, key = self.flow, None, self._pasts, self._key
        if flow is None:
            if not missed and key in pasts:
                pasts[key] = pasts[key][0], ""
            return
        if flow.contract.reliability is Reliability.RELIABLE and (missed or flow.watch.counts):
            pasts[key] = flow.watch, self.topic if missed else ""
            if len(pasts) > mesh_limits.LOSSES_REMEMBERED:
                del pasts[next(iter(pasts))]
        if gone:
            for event in flow.watch.link_gone(asyncio.get_running_loop().time()):
                self.occurred(event)
        flow.close()


class PeerTopics:
    """The topics of one peer in the local graph.

    Args:
        shared: What the parts share.
        part: Is told of demand, of listeners and of events.
        session: The peer: its proxies, its link with the handlers of its routes, and its time.
        pasts: Returns, by the name of a module, of each of its reliable sources that had a flow and has none now: its
            watch, for its next flow, and its topic while a local node listens, so that messages are missed.

    Attributes:
        held: Those that the peer carries, with their proxies.
        topics: Those of them that are registered.
        flows: The flow of each open route, by its id.
    """

    def __init__(
        self, shared: Shared, part: TopicEvents, session: PeerSession, pasts: Callable[[str], Pasts]
    ) -> None:
        self.core, self.counters, self.relays = shared.core, shared.counters, shared.relay.enabled
        self.part = part
        self.session = session
        self.pasts = pasts
        self.held: dict[Source, PeerTopic] = {}
        self.topics: dict[Source, PeerTopic] = {}
        self.flows: dict[int, ImportFlow] = {}

    def publication(self, source: Source) -> Publication | None:
        """The publication of a source, if it is in the local graph."""
        topic = self.topics.get(source)
        return topic.publication if topic is not None else None

    def flow(self, source: Source) -> ImportFlow | None:
        """The flow of a source's open route, or the one that waits for its peer to come back."""
        topic = self.topics.get(source)
        return topic.flow if topic is not None else None

    def watch(self, source: Source) -> QosWatch | None:
        """The watch of a source's flow, or of the last one of a reliable source."""
        if (held := self.held.get(source)) is not None:
            return held.watch
        return self.pasts(self.session.link.name).get(source, (None, ""))[0]

    def publish(self, entry: RemoteTopic, proxies: PeerProxies, node: str) -> None:
        """Publish a source at the proxy of its node, in a later turn of the loop."""
        topic = self.held[entry.wire] = PeerTopic(self, entry)
        topic.release = lambda: proxies.release(node, topic.topic)
        proxies.hold(node, topic.topic, topic.ready, topic.left)

    def position(self, source: Source) -> tuple[int, int] | None:
        """Epoch and last sequence from which a reliable source's next route continues; ``None``: it begins anew."""
        flow = self.flow(source)
        return flow.position if flow is not None else None

    def retract(self, source: Source) -> None:
        """Retract a source: its data stops at once, its registration in a later turn of the loop."""
        if (topic := self.topics.get(source)) is not None:
            topic.end(missed=True)
        if (held := self.held.pop(source, None)) is not None:
            held.release()

    def describe(self, source: Source, opened: RouteOpened) -> None:
        """Prepare for data on a newly opened route, and answer the waiting subscribers with its description."""
        if (topic := self.topics.get(source)) is not None:
            self.flows[opened.route] = self.session.link.routes[opened.route] = topic.open(opened)

    def detach(
        self, source: Source, route: int, *, keep: bool = False, missed: bool = False, last: int | None = None
    ) -> None:
        """End a route's data; with ``keep`` its flow waits for the peer's next link; see ``Topics.detach``."""
        flow = self.flows.pop(route, None)
        self.session.link.routes.pop(route, None)
        topic = self.topics.get(source)
        if keep or topic is None:
            return
        if flow is not None and last is not None:
            flow.skip(serial_add(last, 1))
            flow.numbering.complete = True
        topic.end(missed=missed and last is None)
        topic.publication.forget_latched()

    def link_down(self) -> int:
        """Abort messages that came in part, and start the liveliness lease of all sources: the link is gone.

        Returns:
            The number of open best-effort routes, whose further losses cannot be counted.
        """
        for flow in self.flows.values():
            flow.link_down()
        return sum(flow.contract.reliability is not Reliability.RELIABLE for flow in self.flows.values())

    def reconcile(self, publishers: Mapping[str, Mapping[str, str]]) -> None:
        """Register publications again that are missing from the local graph."""
        for topic in yielding_to_data(list(self.topics.values())):
            if publishers.get(topic.topic, {}).get(topic.node.name) != topic.node.uri:
                topic.register()

    def close(self) -> None:
        """Retract all topics, and remember the events of the reliable ones."""
        for topic in self.topics.values():
            topic.end(missed=True, gone=False)
        for topic in self.held.values():
            topic.release()
        self.held.clear()
        for route in self.flows:
            self.session.link.routes.pop(route, None)
        self.flows.clear()


# The notification that a publisher sends messages that are too long.
OVERSIZED: Final = "message.oversized"
# Sources that one line of the log names; further ones are only counted.
_NAMED: Final = 3


class LossReports:
    """The reports of losses, sent and received, for all peers.

    Args:
        shared: What the parts share.
        exports: Finds the peers that a source goes to.
        peers: The peers' topics in the local graph, by the numbers of their sessions.
        out: Warns of losses.
    """

    def __init__(self, shared: Shared, exports: Exports, peers: Mapping[int, PeerTopics], out: Effects) -> None:
        self._shared, self._exports, self._peers, self._out = shared, exports, peers, out
        needs = Needs((), "the peer's own topics; a text for the log")
        shared.rpc.on_notification(OVERSIZED, self._oversized_there, needs)

    def away(self, peer: int) -> tuple[str, float]:
        """The name of an absent peer, and for how many seconds it has been away."""
        session = self._peers[peer].session
        return session.link.name, asyncio.get_running_loop().time() - session.away_since

    def given_up(self, peer: int, counts: Mapping[Source, int]) -> None:
        """Report that messages are not kept any more for an absent peer.

        Args:
            peer: The peer's number.
            counts: By source: how many messages it misses until now.
        """
        if not (count := sum(counts.values())) or peer not in self._peers:
            return
        name, seconds = self.away(peer)
        shown = ", ".join(map(str, islice(counts, _NAMED)))
        if len(counts) > _NAMED:
            shown += f" and {len(counts) - _NAMED} others"
        text = f"{name} has been away for {shown_seconds(seconds)}: {count} messages for it are given up, of {shown} "
        text += "(the contract's outage is for how long they are kept, "
        text += f"at most {mesh_limits.RESUME_BYTES_MAX >> 20} MiB over all)"
        self._shared.counters.add("message.given_up", count)
        self._shared.counters.add("route.given_up", len(counts) - 1)
        self._out.warn("route.given_up", name, text)

    def missed(self, source: Source, peer: int, count: int) -> None:
        """Report how many messages of a reliable source a peer that is back has missed."""
        name = self._peers[peer].session.link.name
        self._shared.counters.add("message.given_up", count)
        text = f"{source}: {name} has missed {count} messages: it was away for longer than they were kept"
        self._out.warn("route.missed", f"{name} {source}", text)

    def oversized(self, source: Source, flow: ExportFlow, size: int) -> None:
        """Count a message that is too long, and report it in the log and to the peers to which its source flows."""
        flow.oversized += 1
        flow.oversized_bytes = size
        text = f"{source}: a message of {size} bytes is left out, at most {ros_limits.TCPROS_MESSAGE_MAX} cross"
        self._out.warn("message.oversized", str(source), f"{text}; others do: send it in parts, or compressed")
        for peer in self._exports.flowing(source):
            self.tell_oversized(source, flow, peer)

    def tell_oversized(self, source: Source, flow: ExportFlow, peer: int) -> None:
        """Report to one peer how many messages of a source were left out until now, if any."""
        session, offer = self._shared.sessions.get(peer), self._exports.offer(peer, source)
        if flow.oversized and session is not None and session.linked and offer is not None:
            told = {"topic": offer.topic, "node": offer.node, "count": flow.oversized, "size": flow.oversized_bytes}
            self._shared.rpc.notify(session, OVERSIZED, told)

    def _oversized_there(self, session: PeerSession, args: dict[str, Any]) -> None:
        """Takes a peer's report of messages that it left out.

        Raises:
            RemoteProtocolError: The report names no source, or no numbers above 0.
        """
        match args:
            case {"topic": str(topic), "node": str(node), "count": int(count), "size": int(size)} if (
                min(count, size) > 0
            ):
                source = Source(topic, node)
            case _:
                raise RemoteProtocolError(f"{OVERSIZED} names no source, or no number of messages")
        flow = self._peers[session.peer].flow(source)
        if flow is not None and (count, size) != (flow.oversized, flow.oversized_bytes):
            flow.oversized, flow.oversized_bytes = count, size
            who = f"{session.link.name}: {source}"
            text = f"{who}: its messages of {size} bytes are too long to cross and are left out ({count} until now)"
            self._out.warn("message.oversized_there", who, text)
