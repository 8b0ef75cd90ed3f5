"""What another machine's clock was, second by second: latencies are corrected by what was known at their time."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from collections.abc import Iterator


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """What was known of the other clock at one moment.

    Args:
        now: When, in monotonic seconds.
        offset: The other side's wall clock less ours, seconds.
        error: Its bound, ± seconds.
    """

    now: float
    offset: float
    error: float


class PeerClock:
    """The estimates of one link's clock over the last minute, to be told every second or so.

    An estimate that contradicts the one before shows that a clock was set: what was known before is void, and so is
    every latency from before.
    """

    def __init__(self) -> None:
        self._estimates: deque[ClockEstimate] = deque(maxlen=limits.QUALITY_CLOCKS)
        self.trusted_from = -math.inf
        """Stamps from before this time (monotonic seconds) tell nothing."""

    def __iter__(self) -> Iterator[ClockEstimate]:
        """Oldest first."""
        return iter(self._estimates)

    def told(self, offset: float, error: float, now: float) -> None:
        """Remember what the other side's clock is now; see ``ClockEstimate``."""
        estimate = ClockEstimate(now, offset, error)
        if self._estimates:
            last = self._estimates[-1]
            bound = error + last.error + mesh_limits.CLOCK_DRIFT * (now - last.now)
            if abs(offset - last.offset) > bound:
                self._estimates.clear()
                self.trusted_from = now
            elif len(self._estimates) > 1 and now - self._estimates[-2].now < limits.QUALITY_CLOCK_STEP:
                # Told more often: the better one is kept, or a minute would not fit.
                self._estimates.pop()
                estimate = min(last, estimate, key=lambda each: each.error)
        self._estimates.append(estimate)
