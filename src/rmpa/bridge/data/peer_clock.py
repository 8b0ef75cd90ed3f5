"""The offset of a peer's clock over the last minute; each latency is corrected with an estimate of its time."""

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
    """An estimate of the peer's clock at one moment.

    Args:
        now: The moment, monotonic seconds.
        offset: The peer's wall clock less the local one, seconds.
        error: The offset is true within ± this many seconds.
    """

    now: float
    offset: float
    error: float


class PeerClockHistory:
    """The estimates of one peer's clock over the last minute; ``add`` one about every second.

    An estimate that contradicts the one before shows that a clock was set: earlier estimates are void, and so are
    earlier latencies.
    """

    def __init__(self) -> None:
        self._estimates: deque[ClockEstimate] = deque(maxlen=limits.QUALITY_CLOCKS)
        self.trusted_from = -math.inf
        """Latencies of messages that came before this time (monotonic seconds) are unknown."""

    def __iter__(self) -> Iterator[ClockEstimate]:
        """Oldest first."""
        return iter(self._estimates)

    def add(self, offset: float, error: float, now: float) -> None:
        """Add the present estimate; see ``ClockEstimate``."""
        estimate = ClockEstimate(now, offset, error)
        if self._estimates:
            last = self._estimates[-1]
            bound = error + last.error + mesh_limits.CLOCK_DRIFT * (now - last.now)
            if abs(offset - last.offset) > bound:
                self._estimates.clear()
                self.trusted_from = now
            elif len(self._estimates) > 1 and now - self._estimates[-2].now < limits.QUALITY_CLOCK_STEP:
                # Added more often than needed: keep the better one, or the ring would not last for a minute.
                self._estimates.pop()
                estimate = min(last, estimate, key=lambda each: each.error)
        self._estimates.append(estimate)
