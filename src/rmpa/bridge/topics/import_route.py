"""A peer's source: as a peer offers it, and in the local graph, with its publication and the flow of its route."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from msgspec import UnsetType

from rmpa.bridge import limits
from rmpa.bridge.data.reception import ImportFlow
from rmpa.bridge.messages import Audience, Description, RouteOpened, Source
from rmpa.bridge.peer_offers import Remote
from rmpa.bridge.topics.joins import join
from rmpa.bridge.topics.reports import audience, compares_names, is_watched
from rmpa.core.contract import Contract, Durability, Reliability
from rmpa.core.identity import OWN_NODE, serial_add
from rmpa.mesh import limits as mesh_limits
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.wire.tcpros import TopicDescription, printable

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.bridge.data.quality import QosEvent, QosWatch
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.part import Topics
    from rmpa.core.timers import Backoff
    from rmpa.ros.node.publication import Receiver, SubscriberConnection
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.xmlrpc import RosReply

_log = logging.getLogger(__name__)

# What is remembered of the reliable sources of a module that had a flow and have none now, by topic here and node
# there: the watch, for the next flow, and the topic while a local node listens, so that messages are missed.
Pasts = dict[Source, tuple["QosWatch", str]]


# What a source is, whichever peer offers it: the run and the name of its module, its node there, and its topic here.
StreamKey = tuple[str, str, str, str]


@dataclass(slots=True, eq=False, kw_only=True)
class RemoteTopic(Remote[Source]):
    """One source as one peer offers it, and the facts of its route over that peer's link.

    Args:
        module: The run and the name of the module that publishes it.
        objection: Why it is not in the local graph, whichever others offer it, or empty.
        hidden: Why it is not in the local graph: that, or who carries it; or empty.
        wanted: Whether a local node listens.
        number: The route's id while it is requested or open, else 0.
        open: Whether the peer has opened the route.
        until: When the present state is over, monotonic seconds; ``None``: it lasts. A source without route that is
            wanted waits for the peer's next link then.
        asked: The contract that was last requested.
        contract: The contract of the last open route; ``None`` before the first one.
        description: The header of the publisher, once known.
        backoff: Delays between attempts to open a route, after the first one that failed.
        direct: Whether a local node is connected to its publisher directly, and only the peer's agent has died.
        route: The publication and the flow, while this peer carries the source; ``None``: another one does, or none.
    """

    type: str
    module: tuple[str, str]
    objection: str = ""
    hidden: str = ""
    wanted: bool = False
    number: int = 0
    open: bool = False
    until: float | None = None
    asked: Contract | None = None
    contract: Contract | None = None
    description: Description | None = None
    backoff: Backoff | None = None
    direct: bool = False
    route: ImportRoute | None = None

    @property
    def publication(self) -> Publication | None:
        """What local nodes subscribe to; ``None`` if that is not in the local graph, or not by this peer."""
        return self.route.publication if self.route is not None else None

    @property
    def flow(self) -> ImportFlow | None:
        """The flow of its open route, or the one that waits for its peer to come back."""
        return self.route.flow if self.route is not None else None

    @property
    def past(self) -> Source:
        """Its name here, and its node in its module: what is remembered when it is over."""
        return Source(self.name, self.node if self.origin is None else self.origin.node)

    @property
    def key(self) -> StreamKey:
        """What it is, whichever peer offers it."""
        return *self.module, self.node if self.origin is None else self.origin.node, self.name

    @property
    def state(self) -> str:
        """The state of the route, as in the figure above."""
        if not self.number:
            return "waiting" if self.wanted else "idle"
        if not self.open:
            return "opening"
        return "open" if self.wanted else "lingering"

    @property
    def reliable(self) -> bool:
        """Whether no message is to be lost, as far as its contract is known."""
        return self.contract is not None and self.contract.reliability is Reliability.RELIABLE

    @property
    def outage(self) -> float:
        """For how many seconds it outlives its link: the contract's outage, or the default if it is not reliable."""
        return (self.contract if self.contract is not None and self.reliable else Contract()).resume_window

    def outlives(self, *, silent: bool) -> bool:
        """Whether the source stays in the local graph when its peer's link is gone.

        Only a source with a listener does. A reliable one stays, so that no message is lost. A latched one stays if
        the link fell silent (``silent``): its subscribers stay connected and do not get the same message again when
        the peer is back, and new subscribers get it meanwhile. A source with direct subscribers stays if only its
        agent has died: its messages go on.
        """
        if self.direct or not self.wanted:
            return self.direct
        latching = self.description is not None and self.description.latching
        return self.reliable or (silent and latching)


class ImportRoute(PublicationEvents):
    """One source on its way to the local subscribers, whichever peer carries it; holds a proxy until ``release``.

    Args:
        part: The part, which is told what subscribers want.
        session: The peer that carries it.
        entry: The source, as that peer offers it; its number is that of the route.

    Attributes:
        topic: The name in the local graph.
        node: Its proxy; ``None`` while it is not registered.
        publication: What subscribers connect to; ``None`` before its proxy exists.
        flow: The flow of its route: the open one, or the one that outlived its link.
        on_open: Called when its route is open, where this module has to pass it on since before.
        _pasts, _key: Where its events are remembered.
        _told: The listeners of which the publisher's agent was told on the route that is open.
    """

    __slots__ = (
        "_bridge", "_key", "_owner", "_part", "_pasts", "_proxies", "_telling", "_told",
        "entry", "flow", "node", "on_open", "publication", "session", "topic",
    )  # fmt: skip

    def __init__(self, part: Topics, session: PeerSession, entry: RemoteTopic) -> None:
        self._bridge, self._part, self.session, self.entry = part.bridge, part, session, entry
        self.topic = entry.name
        # By its names in its module and here: another peer may carry it next.
        self._pasts, self._key = part.pasts(entry.module[1]), entry.past
        self.node: SlaveNode | None = None
        self.publication: Publication | None = None
        self.flow: ImportFlow | None = None
        self.on_open: Callable[[], object] | None = None
        self._told: tuple[str, ...] = ()
        self._telling: asyncio.Handle | None = None
        self._proxies, self._owner = part.bridge.sessions.proxies(session, entry.node, entry.origin)
        self._proxies.hold(self._owner, self.topic, self.ready, self.left)

    def release(self) -> None:
        """Let its proxy go, which unregisters the topic in a later turn of the loop."""
        self._proxies.release(self._owner, self.topic)

    def ready(self, node: SlaveNode) -> None:
        """Register the topic: its proxy exists."""
        self.node, self.publication = node, Publication(self.topic, node.name, events=self)
        node.add_publication(self.publication)
        self.register()

    def left(self, node: SlaveNode) -> None:
        """Unregister the topic; nothing happens if it was never registered."""
        if self.node is not None:
            self.node = self.publication = None
            self._bridge.core.call("unregisterPublisher", node.name, self.topic, node.uri)
            # rospy does not leave a publisher when the master removes it, so its connection is closed.
            node.remove_publication(self.topic)

    def register(self) -> None:
        """Register the proxy as a publisher; without effect once the topic has left."""
        if (node := self.node) is None:
            return
        params = (node.name, self.topic, self.entry.type, node.uri)
        code, status, _ = self._bridge.core.call("registerPublisher", *params)
        if code != 1:
            _log.error("! the ROS core does not accept %s of %s: %s [core-refuses]", self.topic, node.name, status)

    def is_missing(self, publishers: Mapping[str, Mapping[str, str]]) -> bool:
        """Whether the local graph has lost its registration; the nodes with their URIs, by topic."""
        return self.node is not None and publishers.get(self.topic, {}).get(self.node.name) != self.node.uri

    def first_subscriber(self) -> None:
        """The source is wanted."""
        self._part.imports.demand(self.entry, self._part.now(), wanted=True)

    def last_subscriber(self) -> None:
        """It is not wanted any more."""
        self._part.imports.demand(self.entry, self._part.now(), wanted=False)

    def mismatch(self, fields: Mapping[str, str], text: str) -> None:
        """The peer is told of it."""
        subscriber = printable(fields.get("callerid", ""))
        self._part.mismatches.refused(self.entry.peer, self.entry.wire, subscriber, text)

    def listeners_changed(self) -> None:
        """The peer may have to know their names."""
        self._tell_soon()
        self._part.direct_imports.listeners_changed(self.entry.peer, self.entry.wire)

    def join(self, connection: SubscriberConnection) -> Receiver | None:
        """The publisher may have something to say to it alone."""
        flow, publication = self.flow, self.publication
        if flow is None or publication is None or compares_names(self.entry.type):
            return None  # clients of actions are seen by their names
        return join(self._part, self.session, publication, flow, connection)

    def request(self, caller: str) -> Awaitable[RosReply | None] | None:
        """A subscriber may get a direct connection."""
        return self._part.direct_imports.request(self.entry.peer, self.entry.wire, caller)

    def _occurred(self, event: QosEvent) -> None:
        who, text = (
            f"{self.entry.peer} {self.entry.wire}",
            f"{self.session.link.name}: {self.entry.wire}: {event.text}",
        )
        self._part.warn(f"contract.{event.kind.value}", who, text)

    def _torn(self) -> None:
        """Register the proxy again, so that subscribers that were disconnected connect again.

        rospy connects only when the master names the publisher, and only if it has noticed the end by then. Hence
        the repetition after ``limits.CALL_BACK_DELAYS``.
        """
        for delay in limits.CALL_BACK_DELAYS:
            asyncio.get_running_loop().call_later(delay, self.register)

    def open(self, opened: RouteOpened) -> None:
        """Take the data of a newly opened route, and answer the waiting subscribers with its description.

        A reliable flow continues where the last link ended, and its count goes on in any case. Where it cannot know
        what was lost, that is an event.
        """
        if (publication := self.publication) is None:
            return
        contract, before, self._told = opened.contract, self.flow, ()
        reliable = contract.reliability is Reliability.RELIABLE
        past, missed_at = self._pasts.pop(self._key, (None, ""))
        if before is not None and before.contract.reliability is Reliability.RELIABLE:
            past, missed_at = before.watch, self.topic
        flow = self._flow(opened, publication, past if reliable else None)
        link = self.session.link
        goes_on = flow.bind(link, opened.route, opened.epoch, opened.first)
        link.routes[opened.route] = flow
        renumbered = (flow is not before or not goes_on) and publication.description is not None
        if self._bridge.relay.enabled and renumbered and self.on_open is None:
            publication.hang_up(OWN_NODE)  # what is relayed has other numbers from now on
        publication.bound(contract.queue_depth)
        if contract.durability is Durability.TRANSIENT_LOCAL:
            publication.keep(contract.kept)
        cut = before is not None and not reliable
        if goes_on and not isinstance(opened.following, UnsetType):
            flow.skip(opened.following)
        elif not goes_on and (cut or (reliable and (missed_at or opened.unknown is True))):
            flow.missed_unknown("an agent was restarted, or the route had ended")
        about = opened.description
        text = about.definition.encode("latin-1").decode(errors="surrogateescape")
        if publication.describe(TopicDescription(about.type, about.md5, text, about.latching)):
            self._torn()
        if not goes_on:
            flow.expect_replay(publication.latched)
        if opened.shared is True and before is None:
            publication.join()
        on_open, self.on_open = self.on_open, None
        if on_open is not None:
            on_open()
        self._part.keep_awake()
        self._tell_soon()

    def _tell_soon(self) -> None:
        if self._telling is None and is_watched(self.entry.type):
            # In the next turn: several changes become one message, and a listener's header is answered first.
            self._telling = asyncio.get_running_loop().call_soon(self._tell)

    def _tell(self) -> None:
        """Tell the peer the names of the listeners, where they are others than it was told on this route."""
        self._telling = None
        if self.flow is not None and self.publication is not None and self.entry.open:
            names = audience(self.publication.listeners)
            if names != self._told:
                self._told = names
                self._part.send(self.entry.peer, Audience(self.entry.number, names))

    def _flow(self, opened: RouteOpened, publication: Publication, past: QosWatch | None) -> ImportFlow:
        """The flow of a newly opened route: the one that it had, or a new one."""
        contract, flow, time = opened.contract, self.flow, self.session.time
        # An older agent does not number best-effort routes: their epoch is 0, and each begins anew.
        if flow is None or not flow.contract.same_route(contract) or not opened.epoch:
            had = flow.position if flow is not None else None
            numbering = flow.numbering if flow is not None and had is not None and had[0] == opened.epoch else None
            if flow is not None:
                flow.close()
            flow = ImportFlow(
                publication,
                contract,
                time,
                self._bridge.counters,
                self._occurred,
                self._torn,
                past,
                numbering=numbering,
                relays=self._bridge.relay.enabled,
            )
        self.flow, flow.contract, flow.link_time = flow, contract, time
        return flow

    def detach(self, *, missed: bool, last: int | None) -> None:
        """End the data of its route, and forget the latched message: a new route brings it again."""
        if self.flow is not None and self.entry.open and last is not None:
            self.flow.skip(serial_add(last, 1))
            self.flow.numbering.complete = True
        self.end(missed=missed and last is None)
        if self.publication is not None:
            self.publication.forget_latched()

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
                self._occurred(event)
        flow.close()
