"""Exponential back-off with a cap and jitter: retries go on forever, and not in step with those of other agents."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Backoff:
    """Delays that double from ``first`` to ``cap`` seconds, each spread over 50 % to 100 % of its value.

    Args:
        first: The first delay.
        cap: The longest delay before the spread.
        rng: Uniform numbers in [0, 1); seeded by simulations.
    """

    __slots__ = ("_first", "_next", "_rng", "cap")

    def __init__(self, first: float, cap: float, rng: Callable[[], float]) -> None:
        self._first = first
        self.cap = cap
        """The longest delay, from the next one on."""
        self._rng = rng
        self._next = first

    def delay(self) -> float:
        """The next delay in seconds."""
        base = min(self._next, self.cap)
        self._next = min(self.cap, base * 2)
        return base * (0.5 + 0.5 * self._rng())

    def reset(self) -> None:
        """Start again at ``first``, after a successful attempt."""
        self._next = self._first
