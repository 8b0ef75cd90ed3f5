"""The machine's own clocks."""

from __future__ import annotations

import time


class SystemClock:
    """The monotonic and the wall clock of this machine."""

    def now(self) -> float:
        """Monotonic seconds; the same clock as asyncio's ``loop.time()``."""
        return time.monotonic()

    def wall_ns(self) -> int:
        """Wall clock, in nanoseconds since the epoch."""
        return time.time_ns()
