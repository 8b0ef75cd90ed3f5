"""Deadlines until which a peer that is back may open its suspended routes again (claim them). Pure."""

from __future__ import annotations

from rmpa.mesh import limits


class ClaimDeadlines:
    """One deadline for each peer that is back.

    The short deadline, ``RESUME_CLAIM``, begins when the peer has received the full advertisement. That may take long
    for a large graph on a busy lane; until then ``RESUME_CLAIM_MAX`` holds.
    """

    def __init__(self) -> None:
        self._due: dict[int, float] = {}
        self._untold: set[int] = set()

    def begin(self, peer: int, now: float) -> None:
        """Starts the long deadline of a peer that is back."""
        self._due[peer] = now + limits.RESUME_CLAIM_MAX
        self._untold.add(peer)

    def told(self, peer: int, now: float) -> None:
        """Starts the short deadline: a peer has received the full advertisement."""
        if peer in self._untold:
            self._untold.discard(peer)
            self._due[peer] = now + limits.RESUME_CLAIM

    def forget(self, peer: int) -> None:
        """Ends the deadline of a peer whose link is gone."""
        self._due.pop(peer, None)
        self._untold.discard(peer)

    @property
    def untold(self) -> frozenset[int]:
        """The peers that are back and have not received the full advertisement yet."""
        return frozenset(self._untold)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, monotonic seconds; ``None`` if no peer has a deadline."""
        return min(self._due.values(), default=None)

    def handle_timer(self, now: float) -> list[int]:
        """Return the peers whose deadline is over, and forget them; their unclaimed routes can end."""
        over = [peer for peer, due in self._due.items() if due <= now]
        for peer in over:
            self.forget(peer)
        return over
