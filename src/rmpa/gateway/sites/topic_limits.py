"""The limits of rate and size of one topic that goes out: a thin link is protected at its near end. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.core.counters import TokenBucket
from rmpa.gateway import limits

if TYPE_CHECKING:
    from collections.abc import Iterator


class TopicLimits:
    """Admits the messages of one topic within its limits.

    Args:
        rate: Messages a second; ``None``: no limit.
        size: Bytes a second; ``None``: no limit. A message that is larger than ``limits.LIMIT_BURST`` seconds of it
            passes after a rest, and later ones wait until it is paid off.
    """

    def __init__(self, rate: float | None, size: int | None) -> None:
        self._rate = None if rate is None else TokenBucket(rate, max(1.0, rate * limits.LIMIT_BURST))
        self._size = None if size is None else TokenBucket(size, max(1.0, size * limits.LIMIT_BURST))
        self.dropped = 0
        """Messages that the limits kept back; the caller counts them here."""

    def __bool__(self) -> bool:
        """Whether there is a limit."""
        return self._rate is not None or self._size is not None

    def admit(self, now: float, size: int) -> bool:
        """Whether a message of ``size`` bytes may cross at ``now`` (monotonic seconds)."""
        if all(bucket.has(now, amount) for bucket, amount in self._buckets(size)):
            for bucket, amount in self._buckets(size):
                bucket.spend(amount)
            return True
        return False

    def next(self, now: float, size: int) -> float:
        """When a message of this size may cross, if no other does before; not before ``now``."""
        return max((bucket.next(now, amount) for bucket, amount in self._buckets(size)), default=now)

    def _buckets(self, size: int) -> Iterator[tuple[TokenBucket, int]]:
        if self._rate is not None:
            yield self._rate, 1
        if self._size is not None:
            yield self._size, size
