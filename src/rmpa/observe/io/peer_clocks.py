"""What the clocks of all peers were over the last minute, those that are away for a moment included."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.data.peer_clock import PeerClock

if TYPE_CHECKING:
    from rmpa.bridge.io.bridge import Bridge


class PeerClocks:
    """Follows the links; to be asked to once a second, that no time is without an estimate.

    Args:
        bridge: Knows the links.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._clocks: dict[int, PeerClock] = {}

    def __getitem__(self, peer: int) -> PeerClock:
        """The clock of a peer, by the bridge's number of its link."""
        return self._clocks[peer]

    def follow(self, now: float) -> None:
        """Take down what each link knows now (monotonic seconds); forget peers that are gone."""
        before, self._clocks = self._clocks, {}
        for attached in self._bridge.everyone():
            clock = self._clocks[attached.peer] = before.get(attached.peer) or PeerClock()
            offset, error = attached.link.clock_offset, attached.link.clock_error
            if offset is not None and error is not None and attached.linked:
                clock.told(offset, error, now)
