"""The limits of rate and size of one topic that goes out: a thin link is protected at its near end. Sans-I/O."""

from __future__ import annotations

from rmpa.gateway import limits


class _Allowance:
    """A token bucket in any unit; one thing larger than the bucket passes when it is full, and is paid off after."""

    __slots__ = ("_at", "_burst", "_level", "_rate")

    def __init__(self, rate: float, burst: float) -> None:
        self._rate = rate
        self._burst = burst
        self._level = burst
        self._at = float("-inf")

    def fill(self, now: float) -> None:
        if now > self._at:
            gained = (now - self._at) * self._rate
            self._level = min(self._burst, self._level + gained)
            self._at = now

    def ready(self, amount: float) -> bool:
        return self._level >= min(amount, self._burst) * (1 - 1e-9)

    def spend(self, amount: float) -> None:
        self._level -= amount

    def next(self, amount: float) -> float:
        """Seconds until it is ready."""
        return max(0.0, min(amount, self._burst) - self._level) / self._rate


class TopicLimits:
    """Admits the messages of one topic within its limits.

    Args:
        rate: Messages a second; ``None``: no limit.
        size: Bytes a second; ``None``: no limit. A message that is larger than ``limits.LIMIT_BURST`` seconds of it
            passes after a rest, and later ones wait until it is paid off.
    """

    def __init__(self, rate: float | None, size: int | None) -> None:
        self._rate = None if rate is None else _Allowance(rate, max(1.0, rate * limits.LIMIT_BURST))
        self._size = None if size is None else _Allowance(size, max(1.0, size * limits.LIMIT_BURST))
        self.dropped = 0
        """Messages that the limits kept back; the caller counts them here."""

    def __bool__(self) -> bool:
        """Whether there is a limit."""
        return self._rate is not None or self._size is not None

    def admit(self, now: float, size: int) -> bool:
        """Whether a message of ``size`` bytes may cross at ``now`` (monotonic seconds)."""
        if not self._ready_in(now, size):
            if self._rate is not None:
                self._rate.spend(1)
            if self._size is not None:
                self._size.spend(size)
            return True
        return False

    def next(self, now: float, size: int) -> float:
        """When a message of this size may cross, if no other does before; not before ``now``."""
        return now + self._ready_in(now, size)

    def _ready_in(self, now: float, size: int) -> float:
        """Seconds until a message of this size may cross; 0: now."""
        wait = 0.0
        for allowance, amount in ((self._rate, 1), (self._size, size)):
            if allowance is not None:
                allowance.fill(now)
                if not allowance.ready(amount):
                    wait = max(wait, allowance.next(amount))
        return wait
