"""Reports to each peer how much of it this module's ``[limits]`` hide, and keeps the peers' reports.

So a user learns on either machine that something is hidden, and by which setting of which module.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge.catalogue.peer_limits import Beyond, from_json, to_json
from rmpa.bridge.permission_gate import Needs
from rmpa.bridge.session.part import Part

if TYPE_CHECKING:
    from rmpa.bridge.services.io.part import Services
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.bridge.topics.io.part import Topics
    from rmpa.config.settings import LimitSettings, Settings

HIDDEN: Final = "limits.hidden"
"""The notification of what the sender hides of the receiver: ``Beyond`` in JSON; empty if nothing is hidden."""


class LimitReports(Part):
    """The part of the bridge that sends and receives reports about limits.

    Args:
        sessions: The peers.
        rpc: Sends and receives the notifications.
        topics: The part with the topics' plans.
        services: The part with the services' plans.
        limit_settings: The limits of this module.
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
        rpc.on_notification(HIDDEN, self._told_by_peer, Needs((), "numbers that `rmpa peer info` shows"))

    def here(self, peer: int) -> tuple[Beyond, ...]:
        """How much of a peer is hidden here, by each limit."""
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
        """How much of this module a peer hides, as it last reported."""
        return self._there.get(peer, ())

    def own(self) -> tuple[Beyond, ...]:
        """How much of this module is offered to no peer, by each limit."""
        return tuple(one for one in (self._topics.exports.beyond, self._services.exports.beyond) if one.hidden)

    def reload(self, settings: Settings) -> None:
        """Take the limits of new settings."""
        self._limit_settings = settings.limits

    def reconcile(self) -> None:
        """Notify the peers for which the hidden amount has changed."""
        for session in self._sessions.linked():
            found = self.here(session.peer)
            if found != self._told.get(session.peer, ()):
                self._told[session.peer] = found
                self._rpc.notify(session, HIDDEN, to_json(found))

    def link_up(self, session: PeerSession) -> None:
        """Forget earlier reports, so that the peer is notified anew."""
        self._told.pop(session.peer, None)
        self._there.pop(session.peer, None)

    def gone(self, session: PeerSession) -> None:
        """Forget the reports about a peer that will not come back."""
        self.link_up(session)

    def _told_by_peer(self, session: PeerSession, args: dict[str, Any]) -> None:
        self._there[session.peer] = from_json(args)
