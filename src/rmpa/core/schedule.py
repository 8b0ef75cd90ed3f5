"""The due times of what happens at a rate."""

from __future__ import annotations

import math
from typing import Final

# Share of a period by which a time counts as reached: what rounding makes of it.
_EARLY: Final = 1e-9


def positive(value: float, what: str) -> float:
    """The value, if it is above 0 and finite; else ValueError."""
    if not 0 < value < math.inf:
        raise ValueError(f"{what} is above 0 and finite, not {value:g}")
    return value


class Schedule:
    """The due times of a periodic task: start, start + period, start + 2 periods and so on.

    The times are absolute, so that lateness does not add up. A due time that is a whole period past is skipped.

    Args:
        period: The period in seconds, above 0.
        start: The first due time, in monotonic seconds.
    """

    def __init__(self, period: float, start: float) -> None:
        self.period = period
        self._start = start
        self._tick = -1

    def next_due(self, now: float) -> tuple[float, int]:
        """Advance to the next due time; returns it in monotonic seconds like ``now``, and how many were skipped."""
        self._tick += 1
        late = max(0, math.floor((now - self._start) / self.period + _EARLY) - self._tick)
        self._tick += late
        return self._start + self._tick * self.period, late
