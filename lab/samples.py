"""Percentiles that do not claim more than the number of samples carries."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

_NEEDED: Final = {50.0: 10, 95.0: 200, 99.0: 1000, 99.9: 10_000}
"""Ten samples beyond a percentile at the least, else it is one sample's luck and is not given."""


@dataclass(frozen=True, slots=True)
class Summary:
    """One contender at one size, in the unit of its samples.

    Args:
        count: Samples.
        lost: Attempts without an answer; they are in no percentile.
        p50: Median, and so on; ``None`` where the samples are too few.
        largest: The maximum, always given.
    """

    count: int
    lost: int
    p50: float | None
    p95: float | None
    p99: float | None
    p999: float | None
    largest: float | None


def percentile(ordered: Sequence[float], percent: float) -> float:
    """The nearest-rank percentile of samples in ascending order."""
    return ordered[max(0, math.ceil(len(ordered) * percent / 100) - 1)]


def summary(samples: Sequence[float], lost: int = 0) -> Summary:
    """Summarise samples in any order."""
    ordered = sorted(samples)

    def at(percent: float) -> float | None:
        return percentile(ordered, percent) if len(ordered) >= _NEEDED[percent] else None

    return Summary(len(ordered), lost, at(50.0), at(95.0), at(99.0), at(99.9), ordered[-1] if ordered else None)
