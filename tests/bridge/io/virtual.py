"""An event loop whose time is made up: whoever sleeps wakes at once, and hours pass in milliseconds."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine

WALL = 1_700_000_000_000_000_000
"""The wall clock, in ns, when the loop's says 0."""


class _Instant(selectors.SelectSelector):
    """Looks at the sockets and lets time go on instead of waiting."""

    now = 1000.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """What is ready now."""
        ready = super().select(0)
        if not ready:
            assert timeout is not None, "nothing will ever happen any more"
            self.now += max(timeout, 0.0)
        return ready


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop of made-up time."""

    def __init__(self) -> None:
        self._instant = _Instant()
        super().__init__(self._instant)

    def time(self) -> float:
        """Seconds."""
        return self._instant.now

    def time_ns(self) -> int:
        """The wall clock."""
        return WALL + round(self._instant.now * 1e9)


def run(main: Coroutine[object, object, None], loop: VirtualLoop) -> None:
    """Run to its end, which is also the end of every other task, and of nothing else."""
    try:
        loop.run_until_complete(main)
        left = asyncio.all_tasks(loop)
        assert not left, f"tasks are left: {left}"
    finally:
        loop.close()
