"""When cyclic garbage is collected: between messages and in small portions, never by the interpreter's own clock.

The interpreter collects where an allocation tips its balance: in the middle of a burst of messages, and once in a
while over everything that lives. Here it is off from the end of the start on. What lives then is frozen. The data
path makes no cycles, so in steady state nothing is ever collected. Control work does (each closed connection of
asyncio is one), so a timer looks how many objects came to stay, and collects the young ones of them. Garbage of
closed connections takes 0.3 µs an object, so that the pause is one of a tenth of a millisecond. To wait for a loop
that rests was worse: what 1000 XML-RPC calls a second had gathered until then held it for 6 ms. Nor may much work
wait for the timer: what a thousand topics that register at once leave in 20 ms took 10 ms, so work that breathes is
looked at in its midst too.

What grew old before it became garbage is found by full collections only, which look at all that was made since the
start. They wait until no data flows, for as long as the heap's growth allows.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import sys
import time
from enum import Enum, auto
from typing import TYPE_CHECKING

from rmpa.runtime import limits
from rmpa.runtime.event_loop import AgentLoop

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.counters import Counters

_log = logging.getLogger(__name__)


class Due(Enum):
    """What a look at the heap asks for."""

    NOTHING = auto()
    YOUNG = auto()
    FULL = auto()


def what_is_due(young: int, grown: int, *, quiet: bool) -> Due:
    """Decide.

    Args:
        young: Objects made since the last collection, less those that are gone: no more of them can be garbage. The
            least of the last two looks: messages on their way are objects too, but soon gone.
        grown: Memory blocks by which the heap has grown since the last full collection.
        quiet: Whether the links carried next to nothing since the last look.
    """
    if grown >= limits.COLLECT_GROWTH_MAX or (quiet and grown >= limits.COLLECT_GROWTH):
        return Due.FULL
    return Due.YOUNG if young >= limits.COLLECT_YOUNG else Due.NOTHING


class GarbageCollector:
    """Takes the interpreter's collector over, from ``start`` to ``close``.

    Args:
        carried: Bytes that the links have carried so far, in and out; less than before if one of them fell.
        counters: Gets ``collector.young`` and ``collector.full``.
    """

    def __init__(self, carried: Callable[[], int], counters: Counters) -> None:
        self._carried = carried
        self._counters = counters
        self._timer: asyncio.TimerHandle | None = None
        self._enabled = False
        self._heap = 0
        self._young = 0
        self._seen = (0.0, 0)
        self.longest_pause = 0.0
        """Seconds of the longest collection so far."""

    def start(self) -> None:
        """Freeze what lives, and look from now on.

        Nothing is collected first: that would cost 20 ms of the start and find next to nothing.
        """
        self._enabled = gc.isenabled()
        gc.disable()
        gc.freeze()
        self._heap = sys.getallocatedblocks()
        self._seen = self._now()
        self._loop = asyncio.get_running_loop()
        if isinstance(self._loop, AgentLoop):
            self._loop.between(self._glance)
        self._next(limits.COLLECT_LOOK)

    def close(self) -> None:
        """Leave it to the interpreter again, if it was before."""
        if self._timer is None:
            return
        self._timer.cancel()
        self._timer = None
        if isinstance(self._loop, AgentLoop):
            self._loop.between(None)
        gc.unfreeze()
        if self._enabled:
            gc.enable()

    def _next(self, delay: float) -> None:
        self._timer = self._loop.call_later(delay, self._look)

    def _now(self) -> tuple[float, int]:
        return time.monotonic(), self._carried()

    def _look(self) -> None:
        # The loop has served all that was ready before it called us, so nothing waits for what follows.
        then, carried = self._seen
        now, carries = self._seen = self._now()
        before, self._young = self._young, gc.get_count()[0]
        due = what_is_due(
            min(before, self._young),
            sys.getallocatedblocks() - self._heap,
            quiet=0 <= carries - carried < limits.COLLECT_QUIET_BYTES * (now - then),
        )
        if due is not Due.NOTHING:
            self._collect(due)
        self._next(limits.COLLECT_LOOK if self._young < limits.COLLECT_YOUNG else limits.COLLECT_LOOK_AGAIN)

    def _glance(self) -> None:
        """In the middle of work."""
        if gc.get_count()[0] >= limits.COLLECT_BURST:
            self._collect(Due.YOUNG)

    def _collect(self, due: Due) -> None:
        begin = time.perf_counter()
        found = gc.collect(0 if due is Due.YOUNG else 2)
        pause = time.perf_counter() - begin
        self.longest_pause = max(self.longest_pause, pause)
        if due is Due.YOUNG:
            self._counters.add("collector.young")
            _log.debug("= collected %d young objects in %.3f ms", found, pause * 1e3)
            return
        self._counters.add("collector.full")
        before, self._heap = self._heap, sys.getallocatedblocks()
        _log.info(
            "= collected %d objects of all ages in %.1f ms; the heap has %d blocks, %+d since the last time",
            found,
            pause * 1e3,
            self._heap,
            self._heap - before,
        )
