"""Pacing by absolute times: what a control loop needs and an event loop's own timers do not give.

``asyncio.sleep`` rounds to whole milliseconds and adds up its lateness. Here a thread sleeps until the next tick is
due (the kernel wakes it within some 0.1 ms) and ticks are due at start, start + 1/hz, start + 2/hz and so on,
however long the work between them takes.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Callable


class Rate:
    """``async for due in Rate(10): ...``: the body runs ten times a second, at absolute times.

    Args:
        hz: Ticks a second.
        now: The clock, in seconds.
        sleep: Sleeps that many seconds; called in a thread.

    Raises:
        ValueError: ``hz`` is not above 0.
    """

    def __init__(
        self, hz: float, now: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        if not hz > 0:
            raise ValueError(f"a rate is above 0 Hz, not {hz}")
        self.period = 1 / hz
        self.missed = 0
        """Ticks left out because the body (or the machine) took more than a whole period too long."""
        self._now = now
        self._sleep = sleep
        self._start = 0.0
        self._tick = -1

    def next_due(self, now: float) -> float:
        """Go on to the next tick; return when it is due. A tick that is a whole period late is left out."""
        if self._tick < 0:
            self._start = now
        self._tick += 1
        late = int((now - self._start) / self.period + 1e-9) - self._tick
        if late > 0:
            self._tick += late
            self.missed += late
        return self._start + self._tick * self.period

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> float:
        due = self.next_due(self._now())
        await asyncio.get_running_loop().run_in_executor(None, self._sleep_until, due)
        return due

    def _sleep_until(self, due: float) -> None:
        self._sleep(max(0.0, due - self._now()))
