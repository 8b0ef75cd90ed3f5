"""Statistics over rings of fixed size: periods, latencies, rates. Plain Python: numpy would cost the agent 15 MB."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


@dataclass(frozen=True, slots=True)
class SampleSummary:
    """The statistics of a set of samples, in the samples' unit; ``nan`` where there are too few samples."""

    count: int
    mean: float
    sd: float
    minimum: float
    maximum: float
    p50: float
    p95: float
    p99: float

    @classmethod
    def of(cls, samples: Iterable[float]) -> SampleSummary:
        """The summary of some samples; the standard deviation is the population's, as in ``rostopic hz``."""
        data = sorted(samples)
        if not data:
            return cls(0, *[math.nan] * 7)
        mean = math.fsum(data) / len(data)
        # Computed as the distance between two points: ``math.dist`` sums in C, ten times as fast as a loop.
        sd = math.dist(data, [mean] * len(data)) / math.sqrt(len(data))
        return cls(
            len(data),
            mean,
            sd,
            data[0],
            data[-1],
            percentile(data, 50),
            percentile(data, 95),
            percentile(data, 99),
        )


def percentile(ordered: list[float], percent: float) -> float:
    """The percentile of ascending samples, linear between neighbours; ``nan`` of none."""
    if not ordered:
        return math.nan
    position = (len(ordered) - 1) * percent / 100
    low = math.floor(position)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (position - low)


class SampleRing:
    """The last ``size`` samples; adding one takes constant time.

    Args:
        size: How many samples are kept, at least 1.

    Raises:
        ValueError: ``size`` is below 1.
    """

    def __init__(self, size: int) -> None:
        if size < 1:
            raise ValueError(f"a ring holds at least one sample, not {size}")
        self._data = array("d", bytes(8 * size))
        self._next = 0
        self.total = 0
        """The number of samples ever added."""

    def add(self, sample: float) -> None:
        """Add one sample; it replaces the oldest when the ring is full."""
        self._data[self._next] = sample
        self._next = (self._next + 1) % len(self._data)
        self.total += 1

    def clear(self) -> None:
        """Forget all samples."""
        self._next = 0
        self.total = 0

    def __len__(self) -> int:
        return min(self.total, len(self._data))

    def __iter__(self) -> Iterator[float]:
        """Oldest first."""
        if self.total >= len(self._data):
            yield from self._data[self._next :]
        yield from self._data[: self._next]

    def summary(self) -> SampleSummary:
        """The summary of the samples in the ring."""
        return SampleSummary.of(self)


class ArrivalStats:
    """Arrivals of one stream of messages: their periods and bytes, over the last ``window`` messages.

    Args:
        window: How many periods are kept.
    """

    def __init__(self, window: int = 1000) -> None:
        self._periods = SampleRing(window)
        self._sizes = SampleRing(window)
        self._last: float | None = None
        self.messages = 0
        """Messages ever seen."""
        self.bytes = 0
        """Bytes ever seen."""

    def arrived(self, now: float, size: int) -> None:
        """Count one message of ``size`` bytes at ``now`` (monotonic seconds)."""
        if self._last is not None:
            self._periods.add(now - self._last)
            self._sizes.add(size)
        self._last = now
        self.messages += 1
        self.bytes += size

    @property
    def last(self) -> float | None:
        """When the last message arrived, in monotonic seconds; ``None`` before the first."""
        return self._last

    def periods(self) -> SampleSummary:
        """Seconds between messages."""
        return self._periods.summary()

    def rate(self) -> float:
        """Messages per second over the window; ``nan`` before the second message."""
        summary = self.periods()
        return 1 / summary.mean if summary.count and summary.mean > 0 else math.nan

    def bandwidth(self) -> float:
        """Bytes per second over the window; ``nan`` before the second message."""
        elapsed = math.fsum(self._periods)
        return math.fsum(self._sizes) / elapsed if elapsed > 0 else math.nan
