"""What is counted and measured: named counters, and statistics of periods and latencies.

Plain Python: numpy would cost the agent 15 MB.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

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


@dataclass(frozen=True, slots=True)
class SampleSummary:
    """The statistics of a set of samples, in the samples' unit; ``nan`` where there are too few samples."""

    count: int
    mean: float
    sd: float
    minimum: float
    maximum: float
    p50: float
    p99: float

    @classmethod
    def of(cls, samples: Iterable[float]) -> SampleSummary:
        """The summary of some samples; the standard deviation is the population's, as in ``rostopic hz``."""
        data = sorted(samples)
        if not data:
            return cls(0, *[math.nan] * 6)
        mean = math.fsum(data) / len(data)
        # Computed as the distance between two points: ``math.dist`` sums in C, ten times as fast as a loop.
        sd = math.dist(data, [mean] * len(data)) / math.sqrt(len(data))
        return cls(len(data), mean, sd, data[0], data[-1], *(percentile(data, percent) for percent in (50, 99)))


def percentile(ordered: list[float], percent: float) -> float:
    """The percentile of ascending samples, linear between neighbours; ``nan`` of none."""
    if not ordered:
        return math.nan
    position = (len(ordered) - 1) * percent / 100
    low = math.floor(position)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (position - low)
