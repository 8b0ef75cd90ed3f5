"""Periodic work that need not be exact, on one grid of wake-ups for the whole process.

A wake-up of an idle process costs more than most of the work that it does then: two switches of the processor, the
interpreter's cold caches, a round of the event loop. So periodic work with a period of seconds runs at common times
(*coalesced timers*, as the kernel's timer slack does it): at whole multiples of its period from one moment of the
process. Work of every second, of every 5 s and of every 10 s wakes the process once a second together.

The moment is random in each process: agents of one machine that all worked at the same time would delay its data.
"""

from __future__ import annotations

import asyncio
import random
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

_ORIGIN_SPAN: Final = 60.0
"""Seconds over which the processes of a machine spread; a multiple of the usual periods."""
_origin: Final = random.uniform(0.0, _ORIGIN_SPAN)  # noqa: S311 - spreads load, protects nothing


def next_tick(period: float, now: float, origin: float = _origin) -> float:
    """The time of the grid that is nearest to ``period`` seconds after ``now``, and at least half a period after it.

    All in monotonic seconds; ``origin`` is one time of all grids.
    """
    return origin + round((now - origin) / period + 1) * period


def call_at_tick(period: float, callback: Callable[[], object]) -> asyncio.TimerHandle:
    """Call ``callback`` once in the running loop, after some ``period`` seconds, with all others that are due then.

    Called again from the callback, it makes a period: the delay is half a period to one and a half only at first.
    """
    loop = asyncio.get_running_loop()
    return loop.call_at(next_tick(period, loop.time()), callback)


async def sleep_to_tick(period: float) -> None:
    """Like ``asyncio.sleep``, until the time that ``call_at_tick`` would call at."""
    loop = asyncio.get_running_loop()
    ticked = loop.create_future()
    handle = loop.call_at(next_tick(period, loop.time()), _resolve, ticked)
    try:
        await ticked
    finally:
        handle.cancel()


def _resolve(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)
