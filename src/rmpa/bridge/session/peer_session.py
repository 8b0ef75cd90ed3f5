"""The state that the bridge keeps for one run of a peer, across its links."""

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
    """The state of a session.

    ::

    LINKED ──silence──► SILENT ──SILENT_GRACE► AWAY ──nothing waits any more──► (gone)
      ▲  ├──closed in order──────────────────►  │
      ├──┼────────────── a new link ────────────┘   (from SILENT, too)
    """

    LINKED = auto()
    """The peer has a link."""
    SILENT = auto()
    """Its link ended by silence; most peers are back within ``mesh.limits.SILENT_GRACE``."""
    AWAY = auto()
    """It has no link, and a part of the bridge keeps something for it."""


@dataclass(slots=True, eq=False)
class PeerSession:
    """One run of a peer.

    Args:
        peer: Its number in this agent; never used again for another run.
        link: Its link, or the last one while it has none.
        proxies: The nodes that stand for its nodes in the local graph.
        handlers: The handler of each open route's data, by the route's id; the parts fill it.
        time: The time base of its link: the offset between its clock and the local one.
        state: Whether it has a link.
        away_since: When its last link ended, monotonic seconds.
        wait: Seconds from ``away_since`` to ``due``; ``None`` while it has a link.
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
    def same_machine(self) -> bool:
        """Whether the peer's agent runs on this machine, so that both modules share its loopback device."""
        return self.link.local_address == self.link.remote_endpoint[0]

    @property
    def address(self) -> str:
        """The address at which the peer's nodes are reached: that of its link, or loopback on this machine."""
        return "127.0.0.1" if self.same_machine else self.link.remote_endpoint[0]

    @property
    def own_address(self) -> str:
        """The address at which the peer reaches the nodes of this module; see ``address``."""
        return "127.0.0.1" if self.same_machine else self.link.local_address

    @property
    def due(self) -> float | None:
        """When something kept for the absent peer expires next, monotonic seconds; ``None``: nothing does."""
        return None if self.wait is None else self.away_since + self.wait
