"""The topics of peers in the local graph: publications of proxies, their flows, and reports of losses.

Reports messages that do not reach their listeners, in the log and to the agent at the other end.

These are reliable messages that were given up, and messages that are too long to cross.
"""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.data.quality import shown_seconds
from rmpa.bridge.data.reception import ImportFlow
from rmpa.bridge.messages import Source
from rmpa.bridge.policy import Needs
from rmpa.core.contract import Durability, Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import serial_add
from rmpa.mesh import limits as mesh_limits
from rmpa.ros import limits as ros_limits
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.wire.tcpros import TopicDescription, printable
from rmpa.runtime.loop import MachineTimer, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.bridge.actions import Describe, Detach, Publish, Retract
    from rmpa.bridge.data.export import ExportFlow
    from rmpa.bridge.data.quality import QosEvent
    from rmpa.bridge.data.route import ReceptionHistory
    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.sessions import PeerSession, PeerSessions
    from rmpa.bridge.topics.exports import Exports
    from rmpa.core.counters import Counters, RefusalLog
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.xmlrpc import RosReply


# The topics of one peer: their publications at the proxies, and the flows of their routes.


_log = logging.getLogger(__name__)


class _Published(PublicationEvents):
    """A topic of the peer at its proxy: what its publication tells, and what is registered.

    Args:
        topics: All of the peer.
        action: The source, its local name and its type.
    """

    __slots__ = ("_action", "_topics", "node", "publication")

    def __init__(self, topics: PeerTopics, action: Publish) -> None:
        self._topics = topics
        self._action = action
        self.node: SlaveNode
        self.publication: Publication

    @property
    def source(self) -> Source:
        """The peer's topic and node."""
        return self._action.source

    @property
    def topic(self) -> str:
        """The name in the local graph."""
        return self._action.topic or self._action.source.topic

    @property
    def type(self) -> str:
        """The message type."""
        return self._action.type

    def ready(self, node: SlaveNode) -> None:
        self.node = node
        self._topics.published(self)

    def left(self, node: SlaveNode) -> None:
        self._topics.unpublished(self, node)

    def first_subscriber(self) -> None:
        self._topics.on_demand(self.source, True)

    def last_subscriber(self) -> None:
        self._topics.on_demand(self.source, False)

    def mismatch(self, fields: Mapping[str, str], text: str) -> None:
        self._topics.on_mismatch(self.source, printable(fields.get("callerid", "")), text)

    def listeners_changed(self) -> None:
        self._topics.on_listeners(self.source)

    def request(self, caller: str) -> Awaitable[RosReply | None] | None:
        return self._topics.on_request(self.source, caller)


class PeerTopics:
    """The topics of one peer in the local graph.

    Args:
        core: The local core, in which the proxies are registered as publishers.
        session: The peer: its proxies, its link with the handlers of its routes, and its time.
        counters: Counts messages that reach no subscriber.
        on_demand: Called with a source and whether a local node listens to it.
        on_mismatch: Called with a source, the caller id of a refused subscriber and the text of the refusal.
        on_occurred: Called with a source and an event of its contract.
        on_listeners: Called with a source when the set of its local listeners changes.
        on_request: ``(source, caller id)``: answers a subscriber's ``requestTopic``; see ``Publication``.
        pasts: The history of each reliable source of the module that had a flow and has none now, for its next flow.
            It outlives the session.
    """

    def __init__(
        self,
        core: Core,
        session: PeerSession,
        *,
        counters: Counters | None = None,
        on_demand: Callable[[Source, bool], None],
        on_mismatch: Callable[[Source, str, str], None],
        on_occurred: Callable[[Source, QosEvent], None],
        on_listeners: Callable[[Source], None] = lambda _: None,
        on_request: Callable[[Source, str], Awaitable[RosReply | None] | None] = lambda *_: None,
        pasts: dict[Source, ReceptionHistory] | None = None,
    ) -> None:
        self._core = core
        self.session = session
        self._counters = counters
        self.on_demand = on_demand
        self.on_mismatch = on_mismatch
        self._on_occurred = on_occurred
        self.on_listeners = on_listeners
        self.on_request = on_request
        self._published: dict[Source, _Published] = {}
        self.flows: dict[int, ImportFlow] = {}
        """The flow of each open route, by its id."""
        self._latest: dict[Source, ImportFlow] = {}
        """The flow of each source's route: the open one, or the one that outlived its link."""
        self._watches: dict[Source, MachineTimer] = {}
        """The contract timer of each of these sources."""
        self._pasts = pasts if pasts is not None else {}

    def publication(self, source: Source) -> Publication | None:
        """The publication of a source, if it is in the local graph."""
        published = self._published.get(source)
        return published.publication if published is not None else None

    def flow(self, source: Source, route: int) -> ImportFlow | None:
        """The flow of a source's open route, or the one that waits for its peer to come back."""
        return self.flows.get(route) or self._latest.get(source)

    def publish(self, action: Publish) -> None:
        """Publish a source at its proxy, in a later turn of the loop."""
        published = _Published(self, action)
        self.session.proxies.hold(action.source.node, action.source, published.ready, published.left)

    def retract(self, action: Retract) -> None:
        """Retract a source: its data stops at once, its registration in a later turn of the loop."""
        self._over(action.source, missed=True)
        self.session.proxies.release(action.source.node, action.source)

    def describe(self, action: Describe, on_ack: Callable[[int], None]) -> None:
        """Prepare for data on a newly opened route, and answer the waiting subscribers with its description.

        Args:
            action: The route, its description and its contract.
            on_ack: ``(sequence)``: acknowledges the messages of a reliable route.
        """
        publication = self.publication(action.source)
        if publication is None:
            return
        flow, goes_on = self._flow(action, publication, on_ack)
        self.flows[action.route] = self.session.link.routes[action.route] = flow
        about = action.description
        text = about.definition.encode("latin-1").decode(errors="surrogateescape")
        if publication.describe(TopicDescription(about.type, about.md5, text, about.latching)):
            self._call_back_soon(action.source, publication)
        if not goes_on:
            flow.expect_replay(publication.latched)

    def position(self, source: Source) -> tuple[int, int] | None:
        """Epoch and last sequence from which a reliable source's next route continues; ``None``: it begins anew."""
        flow = self._latest.get(source)
        return flow.position if flow is not None else None

    def past(self, source: Source) -> ReceptionHistory | None:
        """The history of a reliable source without a flow."""
        return self._pasts.get(source)

    def left_out(self, source: Source, count: int, size: int) -> bool:
        """Take the peer's count of messages that were too long; return whether it has changed for a known flow.

        Args:
            source: The source.
            count: Messages since the peer's agent connected to the publisher.
            size: The size of the last one, in bytes.
        """
        flow = self._latest.get(source)
        if flow is None or (count, size) == (flow.oversized, flow.oversized_bytes):
            return False
        flow.oversized, flow.oversized_bytes = count, size
        return True

    def _flow(
        self, action: Describe, publication: Publication, on_ack: Callable[[int], None]
    ) -> tuple[ImportFlow, bool]:
        """The flow of a newly opened route, and whether it continues exactly where the last link ended."""
        source, contract = action.source, action.contract
        reliable = contract.reliability is Reliability.RELIABLE
        flow = self._latest.pop(source, None)
        outlived = flow is not None and flow.contract.same_route(contract) and reliable
        past = self._pasts.pop(source, None)
        if flow is not None and outlived:
            flow.contract = contract
            flow.rebind(on_ack)
            for occurred in flow.watch.link_up(asyncio.get_running_loop().time()):
                self._on_occurred(source, occurred)
            missed = True
        else:
            if flow is not None:
                past = flow.past(publication.topic, missed=True)
                self._end(source, flow)
            missed = past is not None and past.missed
            flow = ImportFlow(
                publication,
                contract,
                self.session.time,
                on_ack=on_ack,
                on_torn=lambda: self._call_back_soon(source, publication),
                on_broken=lambda occurred: self._on_occurred(source, occurred),
                counters=self._counters,
                past=past if reliable else None,
            )
        same = outlived and flow.position is not None and flow.position[0] == action.epoch
        flow.begin_epoch(action.epoch, action.first)
        publication.bound(contract.depth)
        if contract.durability is Durability.TRANSIENT_LOCAL:
            publication.keep(contract.kept)
        self._latest[source] = flow
        if source not in self._watches:
            on_due = partial(self._watch_due, source, flow)
            self._watches[source] = MachineTimer(flow.watch.next_timer, on_due)
        self._watches[source].arm()
        if same and action.following is not None:
            flow.skip(action.following)
        elif reliable and not same and (missed or action.unknown):
            flow.missed_unknown("an agent was restarted, or the route had ended")
        return flow, same

    def _watch_due(self, source: Source, flow: ImportFlow, now: float) -> None:
        for occurred in flow.watch.handle_timer(now):
            self._on_occurred(source, occurred)

    def _end(self, source: Source, flow: ImportFlow) -> None:
        if (timer := self._watches.pop(source, None)) is not None:
            timer.close()
        flow.close()

    def _over(self, source: Source, *, missed: bool) -> None:
        """Ends a source's flow and remembers its history; lost liveliness is reported without waiting for the lease.

        Args:
            source: The source.
            missed: Whether a local node still listens, so that later messages are missed.
        """
        flow = self._latest.pop(source, None)
        if flow is None:
            if not missed and (past := self._pasts.get(source)) is not None:
                past.missed = False
        else:
            self._remember(source, flow, missed=missed)
            for occurred in flow.watch.link_gone(asyncio.get_running_loop().time()):
                self._on_occurred(source, occurred)
            self._end(source, flow)

    def _remember(self, source: Source, flow: ImportFlow, *, missed: bool) -> None:
        publication = self.publication(source)
        past = flow.past(publication.topic if publication is not None else source.topic, missed=missed)
        if past is not None and (missed or past.lost or past.counts):
            self._pasts[source] = past
            if len(self._pasts) > mesh_limits.LOSSES_REMEMBERED:
                del self._pasts[next(iter(self._pasts))]

    def _call_back_soon(self, source: Source, publication: Publication) -> None:
        """Registers the proxy again, so that subscribers that were disconnected connect again.

        rospy connects only when the master names the publisher, and only if it has noticed the end by then. Hence
        the repetition after ``limits.CALL_BACK_DELAYS``.
        """
        for delay in limits.CALL_BACK_DELAYS:
            asyncio.get_running_loop().call_later(delay, self._call_back, source, publication)

    def _call_back(self, source: Source, publication: Publication) -> None:
        published = self._published.get(source)
        if published is not None and published.publication is publication:
            self._register(published)

    def link_down(self) -> int:
        """Abort messages that came in part, and start the liveliness lease of all sources: the link is gone.

        Returns:
            The number of open best-effort routes, whose further losses cannot be counted.
        """
        now = asyncio.get_running_loop().time()
        for flow in self.flows.values():
            flow.torn()
            flow.watch.link_down(now)
        return sum(flow.contract.reliability is not Reliability.RELIABLE for flow in self.flows.values())

    def detach(self, action: Detach) -> None:
        """End a route's data; with ``keep`` its flow waits for the peer's next link."""
        flow = self.flows.pop(action.route, None)
        self.session.link.routes.pop(action.route, None)
        if action.keep:
            if flow is not None:
                self._watches[action.source].arm()
            return
        if flow is not None and action.last is not None:
            flow.skip(serial_add(action.last, 1))
        self._over(action.source, missed=action.missed and action.last is None)
        publication = self.publication(action.source)
        if publication is not None:
            publication.forget_latched()

    def reconcile(self, publishers: Mapping[str, Mapping[str, str]]) -> None:
        """Register publications again that are missing from the local graph."""
        for published in yielding_to_data(list(self._published.values())):
            if publishers.get(published.publication.topic, {}).get(published.node.name) != published.node.uri:
                self._register(published)

    def close(self) -> None:
        """End all flows, and remember the histories of the reliable ones; the publications go with the proxies."""
        for source, flow in list(self._latest.items()):
            self._remember(source, flow, missed=True)
            self._end(source, flow)
        self._latest.clear()
        for route in self.flows:
            self.session.link.routes.pop(route, None)
        self.flows.clear()

    # --- at the proxies ----------------------------------------------------------------------------------------

    def published(self, published: _Published) -> None:
        """Register a topic whose proxy exists."""
        node = published.node
        published.publication = Publication(published.topic, node.name, events=published)
        node.add_publication(published.publication)
        self._published[published.source] = published
        self._register(published)

    def unpublished(self, published: _Published, node: SlaveNode) -> None:
        """Unregister a topic; nothing happens if it was never registered."""
        if self._published.pop(published.source, None) is None:
            return
        topic = published.topic
        self._core.call("unregisterPublisher", node.name, topic, node.uri)
        # rospy does not leave a publisher when the master removes it, so its connection is closed.
        node.remove_publication(topic)

    def _register(self, published: _Published) -> None:
        node, topic = published.node, published.publication.topic
        code, status, _ = self._core.call("registerPublisher", node.name, topic, published.type, node.uri)
        if code != 1:
            _log.error("! the local core does not take %s of %s: %s", topic, node.name, status)


OVERSIZED: Final = "message.oversized"
"""The notification that a publisher sends messages that are too long."""
_NAMED: Final = 3
"""Sources that one line of the log names; further ones are only counted."""


class LossReports:
    """The reports of losses, sent and received, for all peers.

    Args:
        exports: Finds the peers that a source goes to.
        sessions: The peers.
        topics: The peers' topics in the local graph, by the numbers of their sessions.
        rpc: Sends and receives notifications.
        counters: Counts ``message.given_up`` and ``route.given_up``.
        refusals: Logs and counts ``route.missed``, ``message.oversized`` and ``message.oversized_there``.
    """

    def __init__(
        self,
        exports: Exports,
        sessions: PeerSessions,
        topics: Mapping[int, PeerTopics],
        rpc: PeerRpc,
        counters: Counters,
        refusals: RefusalLog,
    ) -> None:
        self._exports = exports
        self._sessions = sessions
        self._topics = topics
        self._rpc = rpc
        self._counters = counters
        self._refusals = refusals
        rpc.on_notification(OVERSIZED, self._oversized_there, Needs((), "the peer's own topics; a text for the log"))

    def away(self, peer: int) -> tuple[str, float]:
        """The name of an absent peer, and for how many seconds it has been away."""
        session = self._topics[peer].session
        return session.link.name, asyncio.get_running_loop().time() - session.away_since

    def given_up(self, peer: int, counts: Mapping[Source, int]) -> None:
        """Report that messages are not kept any more for an absent peer.

        Args:
            peer: The peer's number.
            counts: By source: how many messages it misses until now.
        """
        if not (count := sum(counts.values())):
            return
        name, seconds = self.away(peer)
        shown = ", ".join(map(str, islice(counts, _NAMED)))
        if len(counts) > _NAMED:
            shown += f" and {len(counts) - _NAMED} others"
        text = f"{name} has been away for {shown_seconds(seconds)}: {count} messages for it are given up, of {shown} "
        text += "(the contract's outage is for how long they are kept, "
        text += f"at most {mesh_limits.RESUME_BYTES_MAX >> 20} MiB over all)"
        self._counters.add("message.given_up", count)
        self._counters.add("route.given_up", len(counts) - 1)
        self._say("route.given_up", name, text)

    def missed(self, source: Source, peer: int, count: int) -> None:
        """Report how many messages of a reliable source a peer that is back has missed."""
        name = self._topics[peer].session.link.name
        self._counters.add("message.given_up", count)
        text = f"{source}: {name} has missed {count} messages: it was away for longer than they were kept"
        self._say("route.missed", f"{name} {source}", text)

    def oversized(self, source: Source, flow: ExportFlow) -> None:
        """Report a message that is too long, in the log and to the peers to which its source flows."""
        bound = ros_limits.TCPROS_MESSAGE_MAX
        text = f"{source}: a message of {flow.oversized_bytes} bytes is left out, at most {bound} cross"
        self._say("message.oversized", str(source), f"{text}; others do: send it in parts, or compressed")
        for peer in self._exports.flowing(source):
            self.tell_oversized(source, flow, peer)

    def tell_oversized(self, source: Source, flow: ExportFlow, peer: int) -> None:
        """Report to one peer how many messages of a source were left out until now, if any."""
        session, offer = self._sessions.get(peer), self._exports.offer(peer, source)
        if flow.oversized and session is not None and session.linked and offer is not None:
            told = {"topic": offer.topic, "node": offer.node, "count": flow.oversized, "size": flow.oversized_bytes}
            self._rpc.notify(session, OVERSIZED, told)

    def _oversized_there(self, session: PeerSession, args: dict[str, Any]) -> None:
        """Takes a peer's report of messages that it left out.

        Raises:
            RemoteProtocolError: The report names no source, or no numbers above 0.
        """
        names = (args.get("topic"), args.get("node"))
        numbers = (args.get("count"), args.get("size"))
        match names, numbers:
            case (str(topic), str(node)), (int(count), int(size)) if count > 0 and size > 0:
                source = Source(topic, node)
            case _:
                raise RemoteProtocolError(f"{OVERSIZED} names no source, or no number of messages")
        if self._topics[session.peer].left_out(source, count, size):
            who = f"{session.link.name}: {source}"
            text = f"{who}: its messages of {size} bytes are too long to cross and are left out ({count} until now)"
            self._say("message.oversized_there", who, text)

    def _say(self, kind: str, who: str, text: str) -> None:
        self._refusals.refuse(asyncio.get_running_loop().time(), kind, who, text)
