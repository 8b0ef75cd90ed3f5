"""What the bridge knows of one run of a peer, across the links that come and go."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto
from typing import TYPE_CHECKING

from rmpa.bridge.data.io.link_time import LinkTime

if TYPE_CHECKING:
    from rmpa.bridge.data.io.receiver import DataHandler
    from rmpa.bridge.session.peer_proxies import PeerProxies
    from rmpa.mesh.io.link import PeerLink


class PeerState(Enum):
    """Where a session stands.

    ::

    LINKED ──silence──► SILENT ──AWAY_GRACE──► AWAY ──nothing waits any more──► (gone)
      ▲  └──closed in order──────────────────►  │
      └───────────────── a new link ────────────┘   (from SILENT, too)
    """

    LINKED = auto()
    """The peer has a link."""
    SILENT = auto()
    """Its link fell silent; most peers are back within ``mesh.limits.AWAY_GRACE``."""
    AWAY = auto()
    """It has no link, and some part keeps what belongs to it."""


@dataclass(slots=True, eq=False)
class PeerSession:
    """One run of a peer.

    Args:
        peer: Its number in this agent; never used again for another run.
        link: Its link, or the last one while it has none.
        proxies: The nodes that stand for its nodes in the local graph.
        handlers: What takes the data of each open route, by the route's id; filled by the parts.
        time: How the messages of its link are dated here.
        state: Whether it has a link.
        away_since: When its last link ended, monotonic seconds.
        wait: While it has no link: seconds behind ``away_since`` after which its absence is looked at next.
    """

    peer: int
    link: PeerLink
    proxies: PeerProxies
    handlers: dict[int, DataHandler] = field(default_factory=dict)
    time: LinkTime = field(default_factory=LinkTime)
    state: PeerState = PeerState.LINKED
    away_since: float = 0.0
    wait: float | None = None

    @property
    def linked(self) -> bool:
        """Whether the peer has a link now."""
        return self.state is PeerState.LINKED

    @property
    def due(self) -> float | None:
        """When its absence is looked at next, monotonic seconds; ``None`` while it has a link."""
        return None if self.wait is None else self.away_since + self.wait
