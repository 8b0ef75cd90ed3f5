"""Until when a peer that is back may claim the routes that waited for it. Pure."""

from __future__ import annotations

from rmpa.mesh import limits


class ClaimDeadlines:
    """One deadline for each peer that is back: it claims its routes soon after it was told everything.

    A large graph takes long to tell on a busy lane, so the short deadline begins only then.
    """

    def __init__(self) -> None:
        self._due: dict[int, float] = {}
        self._untold: set[int] = set()

    def begin(self, peer: int, now: float) -> None:
        """A peer is back."""
        self._due[peer] = now + limits.RESUME_CLAIM_MAX
        self._untold.add(peer)

    def told(self, peer: int, now: float) -> None:
        """A peer has been told everything once."""
        if peer in self._untold:
            self._untold.discard(peer)
            self._due[peer] = now + limits.RESUME_CLAIM

    def forget(self, peer: int) -> None:
        """A peer has no link any more."""
        self._due.pop(peer, None)
        self._untold.discard(peer)

    @property
    def untold(self) -> frozenset[int]:
        """The peers that are back and were not told everything yet."""
        return frozenset(self._untold)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, monotonic seconds."""
        return min(self._due.values(), default=None)

    def handle_timer(self, now: float) -> list[int]:
        """The peers whose time is over: what they have not claimed is not wanted any more."""
        over = [peer for peer, due in self._due.items() if due <= now]
        for peer in over:
            self.forget(peer)
        return over
