"""The part of the bridge for topics: local sources are sent to peers, and sources of peers are published here.

The two plans are pure (``bridge.topics.imports``, ``bridge.topics.exports``); this part carries them out. The
path of a message::

    publisher → ExportFlow (LocalSubscriptions) → RouteSender ⇢ link
         link ⇢ ImportFlow (PeerTopics) → Publication → subscribers
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from typing import TYPE_CHECKING

from rmpa.bridge import actions as act
from rmpa.bridge.data.quality import shown_seconds
from rmpa.bridge.direct.grants import TopicGrants
from rmpa.bridge.driver import GraphDriver
from rmpa.bridge.messages import Advertise, CloseRoute, Mismatch, OpenRoute, RouteClosed, RouteOpened, Source
from rmpa.bridge.sessions import Part, UnchangedGraph
from rmpa.bridge.topics.direct import TopicPaths
from rmpa.bridge.topics.exports import Exports
from rmpa.bridge.topics.imports import Imports
from rmpa.bridge.topics.local import LocalSources, LocalSubscriptions
from rmpa.bridge.topics.peer_topics import LossReports, PeerTopics, TopicEvents
from rmpa.bridge.topics.subscribers import MismatchReports, RemoteSubscribers
from rmpa.core.contract import Priority
from rmpa.core.counters import RefusalLog
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_own
from rmpa.mesh import limits as mesh_limits
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.runtime.loop import yield_to_data

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping

    from rmpa.bridge.context import Shared
    from rmpa.bridge.data.export import ExportFlow
    from rmpa.bridge.data.quality import QosEvent, QosWatch
    from rmpa.bridge.messages import Message
    from rmpa.bridge.sessions import PeerSession
    from rmpa.ros.node.publication import Publication
    from rmpa.ros.wire.xmlrpc import RosReply

_log = logging.getLogger(__name__)


class Topics(Part, TopicEvents):
    """The topics of all peers, in both directions.

    Args:
        shared: The core, the peers and the rules.
        find: ``(node, slave API, topic)``: the topic of a proxy of this process; see ``LocalSubscriptions``.
    """

    advertisement = "advertise"

    def __init__(self, shared: Shared, find: Callable[[str, str, str], Publication | None]) -> None:
        self._shared = shared
        core, sessions, counters = shared.core, shared.sessions, shared.counters
        context = shared.context
        policy, contracts, names, gate = context.policy, context.contracts, context.names, context.gate
        self._core = core
        self._counters = counters
        self.peers: dict[int, PeerTopics] = {}
        """The topics of each peer in the local graph, by the number of its session."""
        self.imports = Imports(policy, shared.rng, contracts, self._position, names, context.settings.limits, gate)
        """The inbound plan."""
        self.outbound = LocalSubscriptions(
            core,
            shared.node,
            on_described=lambda source, description: self._act(self.exports.described(source, description)),
            on_lost=lambda source, reason, lasts: self._act(self.exports.lost(source, reason, lasts)),
            on_given_up=self._given_up,
            on_missed=self._missed,
            on_oversized=self._oversized,
            on_malformed=lambda source, text: self._driver.warn(
                "publisher.malformed", str(source), f"{source}: {text}"
            ),
            find=find,
        )
        """The subscriptions to local publishers, and the routes to the peers."""
        self.exports = Exports(policy, contracts, names, context.settings.limits, self.outbound.numbering, gate)
        """The outbound plan."""
        refusals = RefusalLog(_log, counters)
        self._driver: GraphDriver[act.Action, Advertise] = GraphDriver(
            sessions,
            refusals,
            exports=self.exports,
            imports=self.imports,
            look_at=self._look_at,
            advertisement=Advertise,
            apply=self._apply,
            do=self._do,
            # The route's data may follow at once, and no waiting action has to precede it.
            is_urgent=lambda action: isinstance(action, act.Describe),
            on_idle=self._settled,
        )
        self._act = self._driver.act
        self._pasts: OrderedDict[str, dict[Source, tuple[QosWatch, str]]] = OrderedDict()
        """By the name of a module: what is remembered of its reliable sources; see ``PeerTopics``."""
        self._unchanged = UnchangedGraph()
        self._mismatches = MismatchReports(self.exports, self.imports, self._act, self._driver.warn)
        self.losses = LossReports(shared, self.exports, self.peers, refusals)
        """Reports messages that do not reach their listeners."""
        self._subscribers = RemoteSubscribers(self.exports, self.imports, sessions, self.peers, refusals, gate)
        self.direct_exports = TopicGrants(shared, self.exports)
        """Direct connections of peers' nodes to local publishers."""
        self.direct_imports = TopicPaths(shared, self._driver.warn, self.imports, self.peers)
        """Direct connections of local nodes to peers' publishers."""
        self._local = LocalSources(core, shared.relay, lambda source: self.exports.description(source) is not None)
        self._ticker: asyncio.TimerHandle | None = None
        self._closed = False

    def of(self, session: PeerSession) -> PeerTopics:
        """The topics of a peer in the local graph."""
        return self.peers[session.peer]

    def mismatches(self, source: Source) -> tuple[str, ...]:
        """Texts about subscribers, here or at peers, whose definition does not fit a source's."""
        return self._mismatches.texts(source)

    @property
    def idle(self) -> bool:
        """Whether all changes of the local graph have been processed."""
        return self._driver.idle

    # --- the bridge's part -------------------------------------------------------------------------------------

    def start(self) -> None:
        """Follow the local graph."""
        self._look_at_all()

    async def close(self) -> None:
        """Leave all local publishers."""
        self._closed = True
        if self._ticker is not None:
            self._ticker.cancel()
        self._driver.close()
        await self.direct_imports.close()
        await self.direct_exports.ports.close()
        self._subscribers.close()
        self.outbound.close()

    def reached_here(self, instance: str, *, reached: bool) -> None:
        """Set whether this module reaches another one outside the mesh; see ``Imports.reached_here``."""
        self._act(self.imports.reached_here(instance, reached=reached))

    def reload(self) -> None:
        """Takes new settings; sources and routes that they do not change go on untouched."""
        context, now = self._shared.context, asyncio.get_running_loop().time()
        policy, contracts, names, limits = context.policy, context.contracts, context.names, context.settings.limits
        self._act(self.exports.apply_rules(policy, contracts, names, limits))
        self._driver.rejudge(self.imports.apply_rules(policy, contracts, names, now, limits))
        self.direct_exports.judge_again()
        self.direct_imports.reload()
        self._look_at_all()

    def link_up(self, session: PeerSession) -> None:
        """Begins the advertisement to a peer, and waits for the peer's own; suspended routes may go on."""
        peer, identity = session.peer, session.link.identity
        if peer in self.peers:
            _log.info("= %s is back: reliable topics go on", session.link.name)
            self.outbound.back(peer)
        else:
            self._begin(session)
        self.imports.ways.instance = self._shared.relay.instance
        instance = identity.instance.hex()
        self._act(self.imports.link_up(peer, identity.name, instance, identity.guid.value))
        self._act(self.exports.link_up(peer, identity.name, instance))
        self.direct_imports.link_up(session)
        self.direct_exports.link_up(session)
        self._driver.schedule()

    def _begin(self, session: PeerSession) -> None:
        peer, name = session.peer, session.link.name
        pasts = self._pasts[name] = self._pasts.pop(name, {})
        if len(self._pasts) > mesh_limits.ABSENT_PEERS_MAX:
            self._pasts.popitem(last=False)
        self.peers[peer] = PeerTopics(self._shared, self, session, pasts)

    def link_down(self, session: PeerSession) -> None:
        """Suspends the peer's routes; after silence its sources stay in the local graph for ``SILENT_GRACE``."""
        peer = session.peer
        self.direct_imports.link_down(session)
        self.direct_exports.link_down(session)
        interrupted = self.peers[peer].link_down()
        if interrupted:
            # Best-effort messages published until the next link get no sequence: their loss cannot be counted.
            self._counters.add("route.interrupted", interrupted)
        self._subscribers.link_down(peer)
        self._driver.link_down(session)
        exports, _ = self.exports.link_away(peer)
        self._act(exports)
        if session.link.silent:
            # Most silences end soon with a new link, so nothing leaves the local graph yet.
            imports, _ = self.imports.link_away(peer, briefly=True)
            self._act(imports)

    def grace_over(self, session: PeerSession) -> bool:
        """Drops the peer's sources that do not outlive their link; return whether any route waits for the peer."""
        peer = session.peer
        if not self.exports.waits_for(peer) and not self.imports.waits_for(peer):
            self._act(self.imports.detached(peer))
            return False
        imports, _ = self.imports.link_away(peer)
        self._act(imports)
        longest = max(*self.imports.outages(peer), self.exports.outage(peer), 0.0)
        _log.info("= %s is away: its reliable topics wait for %s", session.link.name, shown_seconds(longest))
        return True

    def outlasted(self, session: PeerSession, seconds: float) -> float | None:
        """Drops sources whose contract's ``outage`` is over; return the next outage that is longer, in seconds."""
        peer = session.peer
        self._act(self.imports.outlasted(peer, seconds))
        outages = {*self.imports.outages(peer), self.exports.outage(peer)}
        return min((outage for outage in outages if outage > seconds), default=None)

    def gone(self, session: PeerSession) -> None:
        """Retracts the rest of a peer's sources."""
        peer = session.peer
        self.direct_imports.gone(session)
        self.direct_exports.gone(session)
        self.outbound.gone(peer)
        topics = self.peers.pop(peer)
        self._mismatches.peer_gone(session.link.name)
        for action in self.exports.link_down(peer):
            self._act([action])
        # The actions are not carried out: closing the proxies does the same at once.
        self._driver.free(self.imports.link_down(peer))
        self._driver.gone(session)
        self._shared.relay.peer_gone(peer)
        self._act(self.imports.unlinked(peer))
        topics.close()

    def depends(self, session: PeerSession) -> bool:
        """Whether nodes of this module have direct connections to the peer's."""
        return self._driver.waits(session) or any(path.session is session for path in self.direct_imports)

    def lane_lost(self, session: PeerSession) -> None:
        """Aborts messages that came in part over a lost bulk lane, and lets the senders repeat or drop theirs."""
        for flow in self.peers[session.peer].flows.values():
            if flow.contract.priority is not Priority.HIGH:
                flow.torn()
        self.outbound.lane_lost(session.peer)

    # --- messages ----------------------------------------------------------------------------------------------

    def advertised(self, session: PeerSession, payload: bytes) -> None:
        """Queues an advertisement of a peer."""
        self._driver.advertised(session, payload)

    def message(self, session: PeerSession, message: Message) -> bool:
        """Handles the control messages about topics and their routes."""
        peer, now = session.peer, asyncio.get_running_loop().time()
        match message:
            case Advertise():
                for actions in self._apply(session, message):
                    self._act(actions)
            case OpenRoute():
                self._act(self.exports.opened(peer, message))
            case RouteOpened():
                self._act(self.imports.opened(peer, message, now))
            case CloseRoute():
                self._act(self.exports.closed(peer, message))
            case RouteClosed():
                if actions := self.imports.closed(peer, message, now):
                    _log.info("< %s closes route %d: %s", session.link.name, message.route, message.reason)
                    self._act(actions)
            case Mismatch():
                self._mismatches.reported(peer, session.link.name, message)
            case _:
                return self._subscribers.message(session, message)
        return True

    def _apply(self, session: PeerSession, message: Advertise) -> Iterator[list[act.Action]]:
        if message.added or message.removed:
            changes = (len(message.added), len(message.removed))
            _log.info("< %s publishes %d more topics, %d less", session.link.name, *changes)
        now = asyncio.get_running_loop().time
        return (
            self.imports.take_in(session.peer, change, now())
            for change in self.imports.portions(session.peer, message)
        )

    # --- reliable routes ----------------------------------------------------------------------------------------

    def _position(self, peer: int, source: Source) -> tuple[int, int] | None:
        topics = self.peers.get(peer)
        return topics.position(source) if topics is not None else None

    def _missed(self, source: Source, peer: int, count: int) -> None:
        self.losses.missed(source, peer, count)

    def _oversized(self, source: Source, flow: ExportFlow) -> None:
        self.losses.oversized(source, flow)

    def _given_up(self, peer: int, counts: Mapping[Source, int]) -> None:
        self.losses.given_up(peer, counts)
        for source in counts:
            self._act(self.exports.given_up(source, peer))

    # --- the local graph ---------------------------------------------------------------------------------------

    def graph_changed(self, change: GraphChange) -> None:
        """Queues the topic of a registration that came or went, to be looked at."""
        self._local.changed(change)
        self.direct_exports.graph_changed(change)
        self.direct_imports.graph_changed(change)
        if change.kind is RegistrationKind.SUBSCRIBER:
            self._mismatches.registration_changed(change.name, change.node)
        if change.kind is not RegistrationKind.SERVICE:
            self._driver.look((change.name,))

    def _look_at_all(self) -> None:
        self._driver.look((*self.exports.topics, *self._core.state().publishers))

    def _look_at(self, topics: Iterable[str]) -> None:
        for topic in topics:
            local = self._local.of(topic)
            self._act(self.exports.graph(topic, local | self._local.relayed(topic)))
            self._act(self.imports.local_type(topic, next((one.type for one in reversed(local.values())), None)))

    def reconcile(self) -> None:
        """Registers missing publications again; topics without local subscribers miss nothing any more."""
        state = self._core.state()
        compared = self._unchanged.is_due(state, steady=not self._core.unreachable())
        if compared:
            self._look_at_all()

        for pasts in self._pasts.values():
            for source, (watch, missed_at) in pasts.items():
                if all(map(is_own, state.subscribers.get(missed_at, ()))):
                    pasts[source] = watch, ""
        self.direct_exports.reconcile(state.subscribers)
        for topics in list(self.peers.values()):
            yield_to_data()
            if compared:
                topics.reconcile(state.publishers)

    def demand(self, peer: int, source: Source, *, wanted: bool) -> None:
        """Begin or end to want a peer's source."""
        self._act(self.imports.demand(peer, source, asyncio.get_running_loop().time(), wanted=wanted))

    def occurred(self, peer: int, source: Source, event: QosEvent) -> None:
        """Warn of an event of a contract."""
        text = f"{self.peers[peer].session.link.name}: {source}: {event.text}"
        self._driver.warn(f"contract.{event.kind.value}", f"{peer} {source}", text)

    def request(self, peer: int, source: Source, caller: str) -> Awaitable[RosReply | None] | None:
        """Answer a subscriber, perhaps with the publisher's own address."""
        return self.direct_imports.request(peer, source, caller)

    def mismatched(self, peer: int, source: Source, subscriber: str, text: str) -> None:
        """Tell the peer of a subscriber here whose definition does not fit its source."""
        self._mismatches.refused(peer, source, subscriber, text)

    def listeners_changed(self, peer: int, source: Source) -> None:
        """Follow the local subscribers of a peer's source."""
        self._subscribers.changed(peer, source)
        self.direct_imports.listeners_changed(peer, source)

    def _settled(self) -> None:
        """Drops what belongs to sources that are gone, or that new rules keep home."""
        self._mismatches.forget_gone()
        self.direct_exports.judge_again(refused=False)

    # --- carrying out ------------------------------------------------------------------------------------------

    def _do(self, action: act.Action) -> None:
        match action:
            case act.Publish() | act.Retract() | act.Describe() | act.Detach():
                self._do_inbound(action)
            case act.Connect():
                self.outbound.connect(action)
            case act.Disconnect():
                self.outbound.disconnect(action.source)
            case act.SuspendRoute():
                self._subscribers.route_over(action.peer, action.source)
                self.outbound.suspend_route(action)
            case act.AddRoute():
                self._add_route(action)
            case act.RemoveRoute():
                self._subscribers.route_over(action.peer, action.source)
                self.outbound.remove_route(action)
                session = self._shared.sessions.get(action.peer)
                if session is not None and session.linked:
                    session.link.close_route(action.route)

    def _add_route(self, action: act.AddRoute) -> None:
        session = self._shared.sessions.get(action.peer)
        if session is None:
            return
        try:
            self.outbound.add_route(action, session.link)
            self.losses.tell_oversized(action.source, self.outbound.flows[action.source], action.peer)
        except RemoteProtocolError as error:
            # Caught here: the caller may be handling another peer's event. The next link gets a new numbering.
            self._driver.refuse(session, error)
            if session.linked:
                self._act(self.exports.closed(action.peer, CloseRoute(action.route)))
            else:
                self._act(self.exports.given_up(action.source, action.peer))

    def _do_inbound(self, action: act.Incoming) -> None:
        session, topics = self._shared.sessions.get(action.peer), self.peers.get(action.peer)
        if session is None or topics is None:
            return
        match action:
            case act.Publish():
                source = action.source
                name = self._shared.sessions.proxy_name(session, source.node, action.origin)
                place = (action.topic or source.topic, name)
                self._shared.relay.pass_on(session.peer, session.link.identity, source, place, action.origin)
                topics.publish(action)
                self.direct_imports.shown(action.peer, source)
            case act.Retract():
                self._shared.relay.gone(action.peer, action.source)
                self.direct_imports.hidden(action.peer, action.source)
                topics.retract(action.source)
            case act.Describe():
                if self._ticker is None:
                    self._tick_later()
                topics.describe(action)
                self._subscribers.changed(action.peer, action.source)
            case act.Detach():
                topics.detach(action)

    def _tick_later(self) -> None:
        self._ticker = asyncio.get_running_loop().call_later(mesh_limits.STALE_TICK, self._tick)

    def _tick(self) -> None:
        """Wakes up regularly while routes are open, to distinguish a silent link from an agent that slept."""
        self._ticker = None
        if not self._closed and any(topics.flows for topics in self.peers.values()):
            self._tick_later()
