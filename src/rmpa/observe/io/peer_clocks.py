"""The clocks of all peers over the last minute; those of peers that are away for a moment are kept."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.data.quality import PeerClockHistory

if TYPE_CHECKING:
    from rmpa.bridge.bridge import Bridge


class PeerClocks:
    """Records each link's estimate of its peer's clock; ``follow`` is called once a second.

    Args:
        bridge: Has the links.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._clocks: dict[int, PeerClockHistory] = {}

    def __getitem__(self, peer: int) -> PeerClockHistory:
        """The clock of a peer, by its session's number."""
        return self._clocks[peer]

    def follow(self, now: float) -> None:
        """Record the present estimates; forget peers that are gone. ``now`` is monotonic seconds."""
        before, self._clocks = self._clocks, {}
        for session in self._bridge.sessions:
            clock = self._clocks[session.peer] = before.get(session.peer) or PeerClockHistory()
            offset, error = session.link.clock_offset, session.link.clock_error
            if offset is not None and error is not None and session.linked:
                clock.add(offset, error, now)
