"""When the next portion of a catalogue is sent to a peer.

Commands share the lane with advertisements, and must not wait until a whole catalogue has been sent.
"""

from __future__ import annotations

import math

from rmpa.bridge import limits


class Pacing:
    """The time of the last portion for each peer. Topics and services have one instance each."""

    def __init__(self) -> None:
        self._told: dict[int, float] = {}

    def ready(self, peer: int, now: float, *, busy: bool) -> bool:
        """Return whether a portion may be sent to a peer now; if so, remember ``now`` as the time of its last one.

        On a busy lane a portion waits, but no longer than ``limits.TELL_PATIENCE`` after the one before.

        Args:
            peer: The peer's number.
            now: Monotonic seconds.
            busy: Whether the portion would have to wait on the lane.
        """
        if busy and now - self._told.get(peer, -math.inf) < limits.TELL_PATIENCE:
            return False
        self._told[peer] = now
        return True

    def forget(self, peer: int) -> None:
        """Drop what is remembered of a peer whose session has ended."""
        self._told.pop(peer, None)
