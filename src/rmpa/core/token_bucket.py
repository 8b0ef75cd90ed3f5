"""A token bucket: limits the rate of an action."""

from __future__ import annotations

from typing import Final

_ROUNDING: Final = 1e-9


class TokenBucket:
    """Allows an action ``rate`` times a second, and ``burst`` times at once after a rest.

    An action may be of several tokens. One of more than ``burst`` is allowed when the bucket is full, and is paid off
    afterwards.

    Args:
        rate: Tokens a second.
        burst: The capacity in tokens, at least 1.
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate = rate
        self._burst = burst
        self._level = burst
        self._at = float("-inf")

    def has(self, now: float, amount: float = 1) -> bool:
        """Whether there are enough tokens at ``now`` (monotonic seconds) for an action of ``amount``."""
        self._fill(now)
        return self._level >= min(amount, self._burst) * (1 - _ROUNDING)

    def spend(self, amount: float = 1) -> None:
        """Take tokens that ``has`` has told of."""
        self._level -= amount

    def take(self, now: float) -> bool:
        """Take a token at ``now`` (monotonic seconds); return whether there was one."""
        if not self.has(now):
            return False
        self.spend()
        return True

    def put_back(self) -> None:
        """Return a token that was taken but not used."""
        self._level = min(self._burst, self._level + 1)

    def next(self, now: float, amount: float = 1) -> float:
        """When there are enough tokens for an action of ``amount``, not before ``now``."""
        self._fill(now)
        return now + max(0.0, min(amount, self._burst) - self._level) / self._rate

    def _fill(self, now: float) -> None:
        if now > self._at:
            self._level = min(self._burst, self._level + (now - self._at) * self._rate)
            self._at = now
