"""Names local subscribers to the publishing peer, and connects to local publishers for a peer's subscribers.

See ``bridge.topics.audience`` for the topics that need it.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.messages import Audience, encode
from rmpa.bridge.permission_gate import OPEN_GATE, PermissionGate
from rmpa.bridge.proxy_names import proxied_node, proxy_name
from rmpa.bridge.topics.audience import audience, is_watched
from rmpa.bridge.topics.remote_topic import RouteState
from rmpa.config.peer_rules import Access
from rmpa.ros.node.subscription import PublisherConnection

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.messages import Message, Source
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.bridge.topics.exports import Exports
    from rmpa.bridge.topics.imports import Imports
    from rmpa.bridge.topics.io.peer_topics import PeerTopics
    from rmpa.core.counters import RefusalLog

_log = logging.getLogger(__name__)


def _ignore(_: memoryview) -> None:
    """Drops a message: the bridge gets it by its own connection."""


class _IgnoreParts:
    """Drops messages that come in parts."""

    def begin(self, size: int) -> None:
        """A message of ``size`` bytes begins."""

    def part(self, part: memoryview) -> None:
        """A part of it."""

    def abort(self) -> None:
        """The rest does not come."""


class RemoteSubscribers:
    """The names of listeners, sent and received, for all peers.

    Args:
        exports: Finds the source of a peer's route.
        imports: Finds the route of a peer's source.
        sessions: The peers.
        topics: The peers' topics in the local graph, by the numbers of their sessions.
        refusals: Logs and counts ``audience.too_many``.
        gate: Decides which modules behind a relay may listen.
    """

    def __init__(
        self,
        exports: Exports,
        imports: Imports,
        sessions: PeerSessions,
        topics: Mapping[int, PeerTopics],
        refusals: RefusalLog,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._gate = gate
        self._exports = exports
        self._imports = imports
        self._sessions = sessions
        self._topics = topics
        self._refusals = refusals
        self._told: dict[tuple[int, Source], tuple[int, tuple[str, ...]]] = {}
        """Route id and listeners as they were last sent to each peer, by source."""
        self._changed: dict[tuple[int, Source], None] = {}
        self._soon: asyncio.Handle | None = None
        self._shown: dict[tuple[int, Source], dict[str, PublisherConnection]] = {}
        """The connections that stand for a peer's listeners, by the listeners' local names."""

    def shown(self, peer: int, source: Source) -> tuple[str, ...]:
        """The names under which a peer's listeners are connected to a local publisher."""
        return tuple(sorted(self._shown.get((peer, source), ())))

    # --- our listeners, to the peer that publishes ------------------------------------------------------------------

    def changed(self, peer: int, source: Source) -> None:
        """Send the listeners of a peer's source again soon: they have changed, or its route was opened."""
        entry = self._imports.get(peer, source)
        if entry is None or not is_watched(entry.type):
            return
        self._changed[peer, source] = None
        if self._soon is None:
            # In the next turn: several changes become one message, and a listener's header is answered first.
            self._soon = asyncio.get_running_loop().call_soon(self._tell)

    def _tell(self) -> None:
        self._soon = None
        changed, self._changed = self._changed, {}
        for peer, source in changed:
            session, entry = self._sessions.get(peer), self._imports.get(peer, source)
            if session is None or entry is None or entry.state not in {RouteState.OPEN, RouteState.LINGERING}:
                self._told.pop((peer, source), None)
                continue
            publication = self._topics[peer].publication(source)
            names = audience(publication.listeners) if publication is not None else ()
            before, known = self._told.get((peer, source), (0, ()))
            if names != (known if before == entry.route else ()):
                self._told[peer, source] = (entry.route, names)
                session.link.send_control(encode(Audience(entry.route, names)))

    # --- the peer's listeners, to our publisher ---------------------------------------------------------------------

    def message(self, session: PeerSession, message: Message) -> bool:
        """Takes the listeners that a peer names for a route; ignored if the route was closed meanwhile."""
        if not isinstance(message, Audience):
            return False
        source = self._exports.source(session.peer, message.route)
        local = self._exports.offered.get(source) if source is not None else None
        if source is None or local is None or not is_watched(local.type):
            return True
        if self._exports.description(source) is None:
            return True  # its publisher is not connected
        names = {name for node in message.nodes if (name := self._name(session, node, source.topic))}
        shown = self._shown.setdefault((session.peer, source), {})
        for name in shown.keys() - names:
            shown.pop(name).close()
        for name in sorted(names - shown.keys()):
            if self._count(session.peer) >= limits.AUDIENCES_MAX:
                text = f"{session.link.name}: more than {limits.AUDIENCES_MAX} of its nodes listen to actions here"
                now = asyncio.get_running_loop().time()
                self._refusals.refuse(now, "audience.too_many", session.link.name, text)
                break
            shown[name] = self._connect(source, local.uri, name)
        if not shown:
            del self._shown[session.peer, source]
        return True

    def _name(self, session: PeerSession, node: str, topic: str) -> str:
        """The local name of a peer's listener; empty for a proxy of a module that the peer may not speak for."""
        whose = proxied_node(node)
        if whose is None:
            return proxy_name(session.proxies.prefix, node)
        relay = session.link.name
        if not any((o.name, via) == (whose[0], relay) for o, via in self._imports.ways):
            return ""
        return node if self._gate.admits(Access.SUBSCRIBE, whose[0], topic, relay=relay) else ""

    def _count(self, peer: int) -> int:
        return sum(len(shown) for (owner, _), shown in self._shown.items() if owner == peer)

    def _connect(self, source: Source, uri: str, name: str) -> PublisherConnection:
        _log.debug("> %s: %s listens", source, name)
        connection = PublisherConnection(source.topic, uri, name, on_message=_ignore, on_parts=_IgnoreParts())
        connection.start()
        return connection

    def route_over(self, peer: int, source: Source) -> None:
        """Close the connections for a source's listeners at a peer, since its route has ended."""
        for connection in self._shown.pop((peer, source), {}).values():
            connection.close()

    def link_down(self, peer: int) -> None:
        """Close the connections for all listeners of a peer whose link is gone."""
        for owner, source in [key for key in self._shown if key[0] == peer]:
            self.route_over(owner, source)
        for key in [key for key in self._told if key[0] == peer]:
            del self._told[key]

    def close(self) -> None:
        """Close all connections."""
        if self._soon is not None:
            self._soon.cancel()
        for peer, source in list(self._shown):
            self.route_over(peer, source)
