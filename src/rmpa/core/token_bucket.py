"""A token bucket: limits the rate of an action."""

from __future__ import annotations

from typing import Final

_ROUNDING: Final = 1e-9


class TokenBucket:
    """Allows an action ``rate`` times a second, and ``burst`` times at once after a rest.

    Args:
        rate: Tokens a second.
        burst: The capacity in tokens, at least 1.
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate = rate
        self._burst = burst
        self._level = burst
        self._at = float("-inf")

    def take(self, now: float) -> bool:
        """Take a token at ``now`` (monotonic seconds); return whether there was one."""
        self._fill(now)
        if self._level < 1 - _ROUNDING:
            return False
        self._level -= 1
        return True

    def put_back(self) -> None:
        """Return a token that was taken but not used."""
        self._level = min(self._burst, self._level + 1)

    def next(self, now: float) -> float:
        """When there is a token again, not before ``now``."""
        self._fill(now)
        return now + max(0.0, 1 - self._level) / self._rate

    def _fill(self, now: float) -> None:
        if now > self._at:
            self._level = min(self._burst, self._level + (now - self._at) * self._rate)
            self._at = now
