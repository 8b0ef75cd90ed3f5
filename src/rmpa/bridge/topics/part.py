"""The part of the bridge for topics: local sources are sent to peers, and sources of peers are published here.

``topics.exports`` and ``topics.imports`` decide; this part and its routes carry out what they decide. A message::

    publisher → ExportFlow → RouteSender (of each ExportRoute) ⇢ link
         link ⇢ ImportFlow → Publication (of its ImportRoute) → subscribers
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge.data.quality import QosWatch, shown_seconds
from rmpa.bridge.direct.grants import TopicGrants
from rmpa.bridge.graph_part import GraphPart
from rmpa.bridge.messages import Audience, CloseRoute, Message, Mismatch, OpenRoute, RouteClosed, RouteOpened, Source
from rmpa.bridge.policy import Needs, Place
from rmpa.bridge.topics.direct import TopicPaths
from rmpa.bridge.topics.exports import Exports, local_sources
from rmpa.bridge.topics.imports import Imports
from rmpa.bridge.topics.joins import JOIN, JoiningSubscriber, serve
from rmpa.bridge.topics.reports import OVERSIZED, Mismatches, oversized_there
from rmpa.core.contract import Priority, Reliability
from rmpa.core.identity import is_own
from rmpa.mesh import limits as mesh_limits
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.runtime.loop import yielding_to_data
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.peer_offers import Remote
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.import_route import Pasts, RemoteTopic

_log = logging.getLogger(__name__)

# The longest time between two wake-ups of an agent that receives data: data that arrived since the last one was not
# delayed by an outage.
STALE_TICK: Final = 0.04


class Topics(GraphPart):
    """The topics of all peers, in both directions.

    Args:
        bridge: The core, the peers and the rules.

    Attributes:
        mismatches: Reports subscribers whose definition does not fit.
        tasks: Ask for joining subscribers.
        _pasts: By the name of a module: what is remembered of its reliable sources.
    """

    advertisement = "advertise"
    verb = "publishes"
    exports: Exports
    imports: Imports
    direct_exports: TopicGrants
    direct_imports: TopicPaths

    def __init__(self, bridge: Bridge) -> None:
        super().__init__(bridge, Exports, Imports)
        self._pasts: OrderedDict[str, Pasts] = OrderedDict()
        self.mismatches = Mismatches(self)
        self.tasks = OwnedTasks()
        bridge.rpc.on_request(JOIN, partial(serve, self), Needs((), "a route that the peer has open"))
        told = Needs((), "the peer's own topics; a text for the log")
        bridge.rpc.on_notification(OVERSIZED, partial(oversized_there, self), told)
        self.direct_exports = TopicGrants(bridge, self.exports)
        self.direct_imports = TopicPaths(bridge, self.warn, self.imports)
        self.direct = self.direct_imports, self.direct_exports
        self._ticker: asyncio.TimerHandle | None = None

    def watch(self, entry: RemoteTopic) -> QosWatch | None:
        """The watch of a peer's source, or that of the last flow of a reliable one."""
        if entry.flow is not None:
            return entry.flow.watch
        return self._pasts.get(entry.module[1], {}).get(entry.past, (None, ""))[0]

    async def close(self) -> None:
        """Leave all local publishers."""
        await super().close()
        if self._ticker is not None:
            self._ticker.cancel()
        await self.direct_imports.close()
        await self.direct_exports.ports.close()
        self.tasks.cancel()
        self.exports.close()

    def reload(self) -> None:
        """As of ``GraphPart``."""
        super().reload()
        self.direct_exports.judge_again()
        self.direct_imports.reload()

    def link_up(self, session: PeerSession) -> None:
        """As of ``GraphPart``; suspended routes may go on."""
        if session.away_since:
            _log.info("= %s is back: reliable topics go on", session.link.name)
            self.exports.link_back(session.peer)
        super().link_up(session)

    def pasts(self, name: str) -> Pasts:
        """What is remembered of the reliable sources of a module."""
        pasts = self._pasts[name] = self._pasts.pop(name, {})
        if len(self._pasts) > mesh_limits.ABSENT_PEERS_MAX:
            self._pasts.popitem(last=False)
        return pasts

    def link_down(self, session: PeerSession) -> None:
        """Suspend the peer's routes; after silence its sources stay in the local graph for ``SILENT_GRACE``."""
        for each in self.direct:
            each.link_down(session)
        peer, flows = session.peer, self.imports.flows(session.peer)
        for flow in flows:
            flow.link_down()
        # Those whose further losses cannot be counted.
        if interrupted := sum(flow.contract.reliability is not Reliability.RELIABLE for flow in flows):
            self.bridge.counters.add("route.interrupted", interrupted)
        for handler in list(session.link.routes.values()):
            if isinstance(handler, JoiningSubscriber):
                handler.release()
        # Without a pause for data: among it could be the peer's new link, which must find all routes suspended.
        self.exports.link_away(peer, briefly=session.silent)
        if session.silent:
            # Most silences end soon with a new link, so nothing leaves the local graph yet.
            self.imports.link_away(peer, briefly=True)

    def grace_over(self, session: PeerSession) -> bool:
        """Drop the peer's sources that do not outlive their link; return whether any route waits for the peer."""
        peer = session.peer
        if not self.exports.outage(peer) and not self.imports.waits_for(peer):
            self.imports.detached(peer)
            return False
        self.imports.link_away(peer)  # without a pause, as in ``link_down``
        longest = max({*self.imports.outlasted(peer, 0.0), self.exports.outage(peer)})
        _log.info("= %s is away: its reliable topics wait for %s", session.link.name, shown_seconds(longest))
        return True

    def outlasted(self, session: PeerSession, seconds: float) -> float | None:
        """Drop sources whose contract's ``outage`` is over; return the next outage that is longer, in seconds."""
        outages = {*self.imports.outlasted(session.peer, seconds), self.exports.outage(session.peer)}
        return min((outage for outage in outages if outage > seconds), default=None)

    def gone(self, session: PeerSession) -> None:
        """Retract the rest of a peer's sources."""
        peer = session.peer
        for each in self.direct:
            each.gone(session)
        entries = self.imports.forget(peer)
        self.mismatches.peer_gone(session.link.name)
        self.run(self.exports.gone(peer))
        self.bridge.relay.peer_gone(peer)
        for route in [entry.route for entry in entries.values() if entry.route is not None]:
            route.end(missed=True, gone=False)
            route.release()
        self.slowly(_freed(entries))

    def depends(self, session: PeerSession) -> bool:
        """As of ``GraphPart``; or whether nodes of this module have direct connections to the peer's."""
        return super().depends(session) or any(path.session is session for path in self.direct_imports)

    def lane_lost(self, session: PeerSession) -> None:
        """Abort messages that came in part over a lost bulk lane, and let the senders repeat or drop theirs."""
        for flow in self.imports.flows(session.peer):
            if flow.contract.priority is not Priority.HIGH:
                flow.torn()
        for sender in self.exports.senders(session.peer):
            sender.lane_lost()

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
                self.mismatches.reported(peer, session.link.name, message)
            case Audience():
                self.exports.named(session, message)
            case _:
                return False
        return True

    def graph_changed(self, change: GraphChange) -> None:
        """Have the topic of a registration that came or went looked at."""
        self.direct_exports.graph_changed(change)
        self.direct_imports.graph_changed(change)
        if change.kind is RegistrationKind.SUBSCRIBER:
            self.mismatches.registration_changed(change.name, change.node)
        if change.kind is not RegistrationKind.SERVICE:
            self.look((change.name,))

    def _names(self) -> Iterable[str]:
        return (*self.exports.topics, *self.bridge.core.state().publishers)

    def _look_at(self, name: str) -> None:
        bridge = self.bridge
        found = local_sources(
            bridge.core, bridge.relay, name, lambda source: self.exports.description(source) is not None
        )
        self.exports.look(name, found)
        own = (one.type for one in reversed(found.values()) if one.origin is None)
        self.imports.local_type(name, next(own, None))

    def reconcile(self) -> None:
        """Register missing publications again; topics without local subscribers miss nothing any more."""
        state, compared = self.bridge.core.state(), self.look_again()
        for pasts in self._pasts.values():
            for source, (watch, missed_at) in pasts.items():
                if all(map(is_own, state.subscribers.get(missed_at, ()))):
                    pasts[source] = watch, ""
        for entry in yielding_to_data(list(self.imports)) if compared else ():
            if (route := entry.route) is not None and route.is_missing(state.publishers):
                route.register()

    def _settled(self) -> None:
        """Drop what belongs to sources that are gone, or that new rules keep home."""
        self.mismatches.forget_gone()
        self.direct_exports.judge_again(refused=False)

    def _relayed(self, entry: Remote[Any], proxy: str) -> tuple[Source, Place]:
        return entry.wire, (entry.name, proxy)

    def keep_awake(self) -> None:
        """Wake up regularly while routes are open, to distinguish a silent link from an agent that slept."""
        if self._ticker is None and not self._closed and self.imports.flowing:
            self._ticker = asyncio.get_running_loop().call_later(STALE_TICK, self._tick)

    def _tick(self) -> None:
        self._ticker = None
        self.keep_awake()


def _freed(entries: dict[Source, RemoteTopic]) -> Iterator[None]:
    """Free entries one by one: freeing thousands at once takes long."""
    while entries:
        entries.popitem()
        yield
