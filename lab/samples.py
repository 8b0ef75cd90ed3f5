"""Percentiles that do not claim more than the number of samples carries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

# Ten samples beyond a percentile at the least, else it is one sample's luck and is not given.
_NEEDED: Final = {50.0: 10, 95.0: 200, 99.0: 1000, 99.9: 10_000}


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


def percentile(samples: Sequence[float], percent: float) -> float:
    """The nearest-rank percentile: one of the samples, which may be in any order."""
    return float(np.percentile(samples, percent, method="inverted_cdf"))


def summary(samples: Sequence[float], lost: int = 0) -> Summary:
    """Summarise samples in any order."""
    count = len(samples)
    asked = [percent for percent, needed in _NEEDED.items() if count >= needed]
    values = list(np.percentile(samples, asked, method="inverted_cdf")) if asked else []
    found = dict(zip(asked, map(float, values), strict=True))
    p50, p95, p99, p999 = (found.get(percent) for percent in _NEEDED)
    return Summary(count, lost, p50, p95, p99, p999, float(max(samples)) if count else None)
