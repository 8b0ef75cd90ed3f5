"""Tells each peer how much of it is beyond this module's ``[limits]``, and keeps what peers say of ours.

So a user learns on either machine that something is hidden, and by which setting of which module.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge.bounds import Beyond, from_json, to_json
from rmpa.bridge.session.part import Part

if TYPE_CHECKING:
    from rmpa.bridge.io.bridge import Bridge, PeerSession
    from rmpa.bridge.services.io.part import Services
    from rmpa.config.settings import LimitSettings, Settings

HIDDEN: Final = "limits.hidden"
"""The news: what of the peer that gets it is hidden here (``bridge.bounds.to_json``); empty when nothing is."""


class Bounds(Part):
    """The part of the bridge that is about limits.

    Args:
        bridge: Its imports, and its links; add this part to it.
        services: The part with the services' imports.
        most: The limits.
    """

    def __init__(self, bridge: Bridge, services: Services, most: LimitSettings) -> None:
        self._bridge = bridge
        self._services = services
        self._most = most
        self._told: dict[int, tuple[Beyond, ...]] = {}
        self._there: dict[int, tuple[Beyond, ...]] = {}
        bridge.asks.on_tell(HIDDEN, self._told_by_peer)

    def here(self, peer: int) -> tuple[Beyond, ...]:
        """What of a peer is hidden here."""
        topics, services = self._bridge.imports.crowded(peer), self._services.imports.crowded(peer)
        nodes = Beyond(
            "nodes",
            self._most.nodes,
            len(topics.keys() | services.keys()),
            sum(map(len, topics.values())),
            sum(map(len, services.values())),
        )
        found = (nodes, self._bridge.imports.beyond(peer), self._services.imports.beyond(peer))
        return tuple(one for one in found if one.hidden)

    def there(self, peer: int) -> tuple[Beyond, ...]:
        """What of ours is hidden at a peer, as it says."""
        return self._there.get(peer, ())

    def own(self) -> tuple[Beyond, ...]:
        """What of ours is offered to no peer."""
        return tuple(one for one in (self._bridge.exports.beyond, self._services.exports.beyond) if one.hidden)

    def reload(self, settings: Settings) -> None:
        """Other limits hold from now on."""
        self._most = settings.limits

    def reconcile(self) -> None:
        """Tell what has changed."""
        for attached in self._bridge.attached():
            found = self.here(attached.peer)
            if found != self._told.get(attached.peer, ()):
                self._told[attached.peer] = found
                self._bridge.asks.tell(attached, HIDDEN, to_json(found))

    def link_up(self, attached: PeerSession) -> None:
        """The peer may be another run; what is hidden is told anew."""
        self._told.pop(attached.peer, None)
        self._there.pop(attached.peer, None)

    def gone(self, attached: PeerSession) -> None:
        """The peer will not come back."""
        self.link_up(attached)

    def _told_by_peer(self, attached: PeerSession, args: dict[str, Any]) -> None:
        self._there[attached.peer] = from_json(args)
