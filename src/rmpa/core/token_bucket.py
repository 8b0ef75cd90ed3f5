"""How often something may happen (a token bucket)."""

from __future__ import annotations

from typing import Final

_ROUNDING: Final = 1e-9


class TokenBucket:
    """Lets something happen ``rate`` times a second, and ``burst`` times at once after a rest.

    Args:
        rate: Times a second.
        burst: At once, at least 1.
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate = rate
        self._burst = burst
        self._level = burst
        self._at = float("-inf")

    def take(self, now: float) -> bool:
        """Whether it may happen at ``now`` (monotonic seconds); if so it counts as done."""
        self._fill(now)
        if self._level < 1 - _ROUNDING:
            return False
        self._level -= 1
        return True

    def put_back(self) -> None:
        """One that was taken did not count after all."""
        self._level = min(self._burst, self._level + 1)

    def next(self, now: float) -> float:
        """When it may happen again, not before ``now``."""
        self._fill(now)
        return now + max(0.0, 1 - self._level) / self._rate

    def _fill(self, now: float) -> None:
        if now > self._at:
            self._level = min(self._burst, self._level + (now - self._at) * self._rate)
            self._at = now
