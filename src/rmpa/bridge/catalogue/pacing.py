"""When a peer gets the next portion of a graph: commands share its lane, and must not wait behind all of it."""

from __future__ import annotations

import math

from rmpa.bridge import limits


class Pacing:
    """One for each direction of telling (topics, services)."""

    def __init__(self) -> None:
        self._told: dict[int, float] = {}

    def ready(self, peer: int, now: float, *, busy: bool) -> bool:
        """Whether a portion may go to a peer now; it does then.

        Args:
            peer: Which.
            now: Monotonic seconds.
            busy: Whether it would wait on its lane.
        """
        if busy and now - self._told.get(peer, -math.inf) < limits.TELL_PATIENCE:
            return False
        self._told[peer] = now
        return True

    def forget(self, peer: int) -> None:
        """A peer is gone."""
        self._told.pop(peer, None)
