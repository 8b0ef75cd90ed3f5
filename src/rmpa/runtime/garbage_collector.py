"""Runs Python's cyclic garbage collector between messages and in small portions, instead of the interpreter.

The interpreter collects when allocations exceed a threshold: in the middle of a burst of messages, and sometimes
over all objects. Here automatic collection is off once the agent has started, and the objects of the start are frozen
(``gc.freeze``). The data path makes no cycles, so in steady state nothing needs collecting. Control work makes some:
each closed asyncio connection is a cycle. A timer counts the surviving objects, and collects the young ones. At
0.3 µs an object a pause is some 0.1 ms. While few objects survive the timer is seldom due, so that an idle agent
sleeps; the yields of the event loop notice when there are more.

Two alternatives were measured and rejected. If collection waits until the loop is idle, 1000 XML-RPC calls a second
leave garbage for a pause of 6 ms. If only the timer collects, a thousand topics that register at once leave, within
20 ms, garbage for a pause of 10 ms; therefore the check also runs at the yields of long work.

Old objects that become garbage are only found by a full collection. It waits until no data flows, unless the heap has
grown too much. What survives it is frozen too, so that its time depends on what came since and not on the size of the
graph: to scan all objects of 1,000 peers takes 0.1 to 0.25 s. Garbage among frozen objects is rare, because what has
survived a full collection is mostly the graph, which makes no cycles. So all objects are scanned only when the heap
has doubled, and only at rest: while nothing flows and nothing joins. An agent that never rests scans them when its
heap is four times as large as after the last such scan.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import sys
import time
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from rmpa.runtime import limits
from rmpa.runtime.coarse_timer import call_at_tick
from rmpa.runtime.event_loop import AgentLoop

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.counters import Counters
    from rmpa.runtime.free_memory import FreeMemory

_log = logging.getLogger(__name__)

_THOROUGH_GROWTH: Final = 2
"""The heap grows by this factor until frozen objects are scanned too, at the next rest."""
_RESTLESS_GROWTH: Final = 4
"""The heap grows by this factor until frozen objects are scanned too without a rest."""


class Collection(Enum):
    """What to collect."""

    NOTHING = auto()
    YOUNG = auto()
    """The youngest generation."""
    FULL = auto()
    """All objects that are not frozen."""
    THOROUGH = auto()
    """All objects, the frozen ones included."""


def choose_collection(young: int, grown: int, *, quiet: bool, factor: float = 1.0, rests: bool = False) -> Collection:
    """Choose the collection that is due.

    Args:
        young: Objects made and not freed since the last collection, the smaller number of the last two checks. It is
            an upper bound of the garbage. One check alone would count messages in transit, which are soon freed.
        grown: Memory blocks by which the heap has grown since the last full collection.
        quiet: Whether the links carried almost no data since the last check.
        factor: Size of the heap, divided by its size after the last scan of all objects.
        rests: Whether for ``limits.COLLECT_REST`` the links carried almost no data and few objects were made.
    """
    if factor >= (_THOROUGH_GROWTH if rests else _RESTLESS_GROWTH):
        return Collection.THOROUGH
    if grown >= limits.COLLECT_GROWTH_MAX or (quiet and grown >= limits.COLLECT_GROWTH):
        return Collection.FULL
    return Collection.YOUNG if young >= limits.COLLECT_YOUNG else Collection.NOTHING


class GarbageCollector:
    """Replaces automatic garbage collection, from ``start`` to ``close``.

    Args:
        traffic: Returns the bytes that all present links have carried, in and out; so it shrinks when a link falls.
        counters: Gets ``collector.young``, ``collector.full`` and ``collector.trim``.
        free_memory: Returns free memory to the kernel at rest; ``None``: nothing does.
    """

    def __init__(self, traffic: Callable[[], int], counters: Counters, free_memory: FreeMemory | None = None) -> None:
        self._traffic = traffic
        self._counters = counters
        self._free_memory = free_memory
        self._timer: asyncio.TimerHandle | None = None
        self._enabled = False
        self._heap_blocks = 0
        self._scanned_blocks = 0
        """The size of the heap after the last scan of all objects."""
        self._busy_at = 0.0
        """When a check last found data or many young objects."""
        self._young = 0
        self._rests = False
        """Whether the next check is a rare one."""
        self._last_check = (0.0, 0)
        self.longest_pause = 0.0
        """Seconds of the longest collection so far."""

    def start(self) -> None:
        """Turn automatic collection off, freeze all objects, and check regularly from now on.

        Nothing is collected first: that would delay the start by 20 ms and find almost nothing.
        """
        self._enabled = gc.isenabled()
        gc.disable()
        gc.freeze()
        self._heap_blocks = self._scanned_blocks = sys.getallocatedblocks()
        self._last_check = self._now()
        self._busy_at = self._last_check[0]
        if self._free_memory is not None:
            self._free_memory.start()
        self._loop = asyncio.get_running_loop()
        if isinstance(self._loop, AgentLoop):
            self._loop.set_yield_hook(self._check_during_work)
        self._schedule(limits.COLLECT_LOOK)

    def close(self) -> None:
        """Turn automatic collection on again, if it was on before."""
        if self._timer is None:
            return
        self._timer.cancel()
        self._timer = None
        if isinstance(self._loop, AgentLoop):
            self._loop.set_yield_hook(None)
        gc.unfreeze()
        if self._enabled:
            gc.enable()

    def _schedule(self, delay: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._rests = False
        self._timer = self._loop.call_later(delay, self._check)

    def _schedule_next(self) -> None:
        """Check soon if there are many objects, and otherwise seldom: work that makes many calls the hook."""
        if self._young >= limits.COLLECT_YOUNG:
            self._schedule(limits.COLLECT_LOOK_AGAIN)
        elif isinstance(self._loop, AgentLoop):
            self._timer = call_at_tick(limits.COLLECT_LOOK_IDLE, self._check)
            self._rests = True
        else:
            self._schedule(limits.COLLECT_LOOK)

    def _now(self) -> tuple[float, int]:
        return time.monotonic(), self._traffic()

    def _check(self) -> None:
        # The loop handled all ready events before it called this timer, so the collection delays none of them.
        checked_at, traffic = self._last_check
        now, traffic_now = self._last_check = self._now()
        before, self._young = self._young, gc.get_count()[0]
        quiet = 0 <= traffic_now - traffic < limits.COLLECT_QUIET_BYTES * (now - checked_at)
        if not quiet or self._young >= limits.COLLECT_YOUNG:
            self._busy_at = now
        rests = now - self._busy_at >= limits.COLLECT_REST
        blocks = sys.getallocatedblocks()
        collection = choose_collection(
            min(before, self._young),
            blocks - self._heap_blocks,
            quiet=quiet,
            factor=blocks / self._scanned_blocks,
            rests=rests,
        )
        if collection is not Collection.NOTHING:
            self._collect(collection)
        elif rests and self._free_memory is not None:
            self._release(self._free_memory)
        self._schedule_next()

    def _release(self, memory: FreeMemory) -> None:
        begin = time.perf_counter()
        released = memory.release()
        if released is None:
            return
        self._counters.add("collector.trim")
        took = time.perf_counter() - begin
        _log.info("= returned %.1f MB of free memory to the kernel in %.1f ms", released / 1e6, took * 1e3)

    def _check_during_work(self) -> None:
        """Collect at a yield of long work, if the work has made many objects; check soon, if it has made some."""
        young = gc.get_count()[0]
        if young >= limits.COLLECT_BURST:
            self._collect(Collection.YOUNG)
        elif self._rests and young >= limits.COLLECT_YOUNG:
            self._schedule(limits.COLLECT_LOOK)

    def _collect(self, collection: Collection) -> None:
        begin = time.perf_counter()
        if collection is Collection.THOROUGH:
            gc.unfreeze()
        found = gc.collect(0 if collection is Collection.YOUNG else 2)
        if collection is not Collection.YOUNG:
            gc.freeze()
        pause = time.perf_counter() - begin
        self.longest_pause = max(self.longest_pause, pause)
        if collection is Collection.YOUNG:
            self._counters.add("collector.young")
            _log.debug("= collected %d young objects in %.3f ms", found, pause * 1e3)
            return
        self._counters.add("collector.full")
        before, self._heap_blocks = self._heap_blocks, sys.getallocatedblocks()
        if collection is Collection.THOROUGH:
            self._scanned_blocks = self._heap_blocks
        _log.info(
            "= collected %d %s in %.1f ms; the heap has %d blocks, %+d since the last time",
            found,
            "objects, the frozen ones included," if collection is Collection.THOROUGH else "objects of all ages",
            pause * 1e3,
            self._heap_blocks,
            self._heap_blocks - before,
        )
