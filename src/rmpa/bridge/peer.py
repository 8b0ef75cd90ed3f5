"""One run of a peer: the facts by which it is decided what crosses. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto


class PeerState(Enum):
    """The state of a peer.

    ::

    LINKED ──silence──► SILENT ──SILENT_GRACE► AWAY ──nothing waits any more──► (gone)
      ▲  ├──closed in order──────────────────►  │
      ├──┼────────────── a new link ────────────┘   (from SILENT, too)

    Attributes:
        LINKED: The peer has a link.
        SILENT: Its link ended by silence; most peers are back within ``mesh.limits.SILENT_GRACE``.
        AWAY: It has no link, and a part of the bridge keeps something for it.
    """

    LINKED = auto()
    SILENT = auto()
    AWAY = auto()


@dataclass(slots=True, eq=False, kw_only=True)
class PeerRun:
    """One run of a peer, across its links.

    Args:
        peer: Its number in this agent; never used again for another run.
        name: Its name, which selects the rules for it.
        instance: The run, as 32 hexadecimal digits.
        rank: The value of its GUID.
        state: Whether it has a link.
        silent: Whether its last link ended by silence.
        away_since: When its last link ended, monotonic seconds; 0 before.
    """

    peer: int
    name: str = ""
    instance: str = ""
    rank: int = 0
    state: PeerState = PeerState.LINKED
    silent: bool = False
    away_since: float = 0.0

    @property
    def linked(self) -> bool:
        """Whether the peer has a link now."""
        return self.state is PeerState.LINKED
