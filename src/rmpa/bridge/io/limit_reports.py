"""Tells each peer how much of it is beyond this module's ``[limits]``, and keeps what peers say of ours.

So a user learns on either machine that something is hidden, and by which setting of which module.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge.catalogue.peer_limits import Beyond, from_json, to_json
from rmpa.bridge.session.part import Part

if TYPE_CHECKING:
    from rmpa.bridge.services.io.part import Services
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.bridge.topics.io.part import Topics
    from rmpa.config.settings import LimitSettings, Settings

HIDDEN: Final = "limits.hidden"
"""The news: what of the peer that gets it is hidden here, as ``Beyond`` in JSON; empty when nothing is."""


class LimitReports(Part):
    """The part of the bridge that is about limits.

    Args:
        sessions: The peers.
        rpc: Brings news to the peers, and from them.
        topics: The part with the topics' plans.
        services: The part with the services' plans.
        limit_settings: The limits.
    """

    def __init__(
        self, sessions: PeerSessions, rpc: PeerRpc, topics: Topics, services: Services, limit_settings: LimitSettings
    ) -> None:
        self._sessions = sessions
        self._rpc = rpc
        self._topics = topics
        self._services = services
        self._limit_settings = limit_settings
        self._told: dict[int, tuple[Beyond, ...]] = {}
        self._there: dict[int, tuple[Beyond, ...]] = {}
        rpc.on_notification(HIDDEN, self._told_by_peer)

    def here(self, peer: int) -> tuple[Beyond, ...]:
        """What of a peer is hidden here."""
        topics, services = self._topics.imports.crowded(peer), self._services.imports.crowded(peer)
        nodes = Beyond(
            "nodes",
            self._limit_settings.nodes,
            len(topics.keys() | services.keys()),
            sum(map(len, topics.values())),
            sum(map(len, services.values())),
        )
        found = (nodes, self._topics.imports.beyond(peer), self._services.imports.beyond(peer))
        return tuple(one for one in found if one.hidden)

    def there(self, peer: int) -> tuple[Beyond, ...]:
        """What of ours is hidden at a peer, as it says."""
        return self._there.get(peer, ())

    def own(self) -> tuple[Beyond, ...]:
        """What of ours is offered to no peer."""
        return tuple(one for one in (self._topics.exports.beyond, self._services.exports.beyond) if one.hidden)

    def reload(self, settings: Settings) -> None:
        """Other limits hold from now on."""
        self._limit_settings = settings.limits

    def reconcile(self) -> None:
        """Tell what has changed."""
        for session in self._sessions.linked():
            found = self.here(session.peer)
            if found != self._told.get(session.peer, ()):
                self._told[session.peer] = found
                self._rpc.notify(session, HIDDEN, to_json(found))

    def link_up(self, session: PeerSession) -> None:
        """The peer may be another run; what is hidden is told anew."""
        self._told.pop(session.peer, None)
        self._there.pop(session.peer, None)

    def gone(self, session: PeerSession) -> None:
        """The peer will not come back."""
        self.link_up(session)

    def _told_by_peer(self, session: PeerSession, args: dict[str, Any]) -> None:
        self._there[session.peer] = from_json(args)
