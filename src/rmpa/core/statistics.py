"""What is counted and measured: named counters, and statistics of periods and latencies.

Plain Python: numpy would cost the agent 15 MB.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Any, Self

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterable


class Counters:
    """Named counters of one room, shown in snapshots (``beacon.malformed``, ``link.refused.version``)."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, name: str, amount: int = 1) -> None:
        """Add to a count; a new name starts at 0."""
        self._counts[name] += amount

    def __getitem__(self, name: str) -> int:
        return self._counts[name]

    def as_dict(self) -> dict[str, int]:
        """All counts, by name in order."""
        return dict(sorted(self._counts.items()))


class SampleSpread(msgspec.Struct, kw_only=True, frozen=True):
    """The statistics of a set of samples, in the samples' unit; in a snapshot seconds. ``nan``: there are too few.

    Attributes:
        count: The number of samples.
        mean: Their mean.
        sd: Their standard deviation: the population's, as in ``rostopic hz``.
        min: The least.
        max: The greatest.
        p50: The median.
        p99: The 99th percentile. Percentiles are interpolated linearly.
    """

    count: int
    mean: float
    sd: float
    min: float
    max: float
    p50: float
    p99: float

    @classmethod
    def of(cls, samples: Iterable[float], **more: Any) -> Self:
        """The statistics of some samples; ``more`` are the fields of a subclass."""
        data = sorted(samples)
        count, nan = len(data), math.nan
        if not data:
            return cls(count=0, mean=nan, sd=nan, min=nan, max=nan, p50=nan, p99=nan, **more)
        mean = math.fsum(data) / count
        # Computed as the distance between two points: ``math.dist`` sums in C, ten times as fast as a loop.
        sd = math.dist(data, [mean] * count) / math.sqrt(count)
        p50, p99 = percentile(data, 50), percentile(data, 99)
        return cls(count=count, mean=mean, sd=sd, min=data[0], max=data[-1], p50=p50, p99=p99, **more)


def percentile(ordered: list[float], percent: float) -> float:
    """The percentile of ascending samples, linear between neighbours; ``nan`` of none."""
    if not ordered:
        return math.nan
    position = (len(ordered) - 1) * percent / 100
    low = math.floor(position)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (position - low)
