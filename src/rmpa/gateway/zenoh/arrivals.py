"""The way of what Zenoh delivers from its threads into the event loop.

Zenoh calls back in threads of its own. Each subscriber has a queue there, and one wake-up of the loop is enough for
all that came until the loop runs. The queues take turns, so that a flood on one does not delay the others.

The loop and Zenoh's threads share the interpreter's lock. A loop that each message wakes would hand it over for each
one, which costs 20 µs. So above ``limits.BUSY_MESSAGES`` in a period the loop is not woken: it looks once a period.
"""

from __future__ import annotations

import ctypes
import logging
import threading
from collections import Counter, deque
from typing import TYPE_CHECKING, Generic, TypeVar

from rmpa.gateway.zenoh import limits
from rmpa.runtime.tls import CollectedSends

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

_T = TypeVar("_T")
_log = logging.getLogger(__name__)


_threads = threading.local()


def keep_thread_state() -> None:
    """Keep the interpreter's state of this thread, which Zenoh's runtime has started, until the thread ends.

    Without it each callback makes and removes such a state, with pages of memory: 15 µs instead of 2.
    """
    if not getattr(_threads, "kept", False):
        _threads.kept = True
        ctypes.pythonapi.PyGILState_Ensure()


class ArrivalQueue(Generic[_T]):
    """What arrived for one subscriber, and waits for the event loop.

    Args:
        arrivals: The loop's side.
        deliver: Called in the loop with each item.
        messages: Items that wait at most; above it the oldest is dropped.
        size: Bytes that wait at most; one item always fits.
        discard: Called in the loop with each item that was dropped.
    """

    def __init__(
        self,
        arrivals: Arrivals,
        deliver: Callable[[_T], None],
        messages: int,
        size: int,
        discard: Callable[[_T], None] | None = None,
    ) -> None:
        self._arrivals = arrivals
        self._deliver = deliver
        self._messages = messages
        self._bytes = size
        self._discard = discard
        self._items: deque[tuple[_T, int]] = deque()
        """Each with its size."""
        self._waiting_bytes = 0
        self._scheduled = False
        self._closed = False
        self.dropped = 0
        """Items that found no room."""

    def add(self, item: _T, size: int = 0) -> None:
        """Queue one item of ``size`` bytes, from any thread."""
        with self._arrivals.lock:
            if self._closed:
                return
            self._items.append((item, size))
            self._waiting_bytes += size
            while len(self._items) > self._messages or (self._waiting_bytes > self._bytes and len(self._items) > 1):
                old, old_size = self._items.popleft()
                self._waiting_bytes -= old_size
                self.dropped += 1
                self._arrivals.refused["zenoh.arrival.dropped"] += 1
                if self._discard is not None:
                    self._arrivals.discarded.append((self._discard, old))
            if not self._scheduled:
                self._scheduled = True
                self._arrivals.schedule(self)

    def close(self) -> None:
        """Forget what waits; nothing is delivered afterwards."""
        with self._arrivals.lock:
            self._closed = True
            if self._discard is not None:
                self._arrivals.discarded.extend((self._discard, item) for item, _ in self._items)
                self._arrivals.wake()
            self._items.clear()
            self._waiting_bytes = 0

    def take(self) -> tuple[_T, int] | None:
        """Take the oldest item, and its size; ``None`` if none waits. The caller has the lock."""
        if not self._items:
            return None
        item = self._items.popleft()
        self._waiting_bytes -= item[1]
        return item

    def reschedule(self) -> None:
        """Queue up for another turn if something waits. The caller has the lock."""
        self._scheduled = bool(self._items)
        if self._scheduled:
            self._arrivals.schedule(self)

    def deliver(self, item: _T) -> None:
        """Hand one item to the subscriber; an error of the subscriber is logged."""
        if self._closed:
            if self._discard is not None:
                self._discard(item)
            return
        try:
            self._deliver(item)
        except Exception:  # noqa: BLE001 - the last frame of the loop: others must get theirs
            _log.exception("zenoh: what arrived could not be handled")


class Arrivals:
    """The loop's side of all queues of a session.

    Args:
        loop: The event loop that everything is delivered in.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self.lock = threading.Lock()
        self.refused: Counter[str] = Counter()
        """What was dropped or refused, by its reason; guarded by ``lock``."""
        self.discarded: deque[tuple[Callable[..., None], object]] = deque()
        """What was dropped, with the function that is told; guarded by ``lock``."""
        self._ready: deque[ArrivalQueue[object]] = deque()
        self._woken = False
        self._closed = False
        self._window_end = 0.0
        self._in_window = 0

    def refuse(self, reason: str) -> None:
        """Count something that was refused, from any thread."""
        with self.lock:
            self.refused[reason] += 1

    def schedule(self, queue: ArrivalQueue[_T]) -> None:
        """Give a queue its turn. The caller has the lock."""
        self._ready.append(queue)  # type: ignore[arg-type] # what it takes is what it delivers
        self.wake()

    def wake(self) -> None:
        """Let the loop look at the queues. The caller has the lock."""
        if not self._woken and not self._closed:
            self._woken = True
            try:
                self._loop.call_soon_threadsafe(self._drain)
            except RuntimeError:  # the loop was closed before the session
                self._closed = True

    def close(self) -> None:
        """Deliver nothing more."""
        with self.lock:
            self._closed = True
            self._ready.clear()

    def _drain(self) -> None:
        taken = self._deliver()
        now = self._loop.time()
        if now >= self._window_end:
            self._window_end = now + limits.BUSY_PERIOD
            self._in_window = 0
        self._in_window += taken
        with self.lock:
            if self._closed:
                return
            if self._ready and taken >= limits.DRAIN_MESSAGES:
                self._loop.call_soon(self._drain)
            elif self._in_window >= limits.BUSY_MESSAGES:
                self._loop.call_later(limits.BUSY_PERIOD, self._drain)
            elif self._ready or self.discarded:
                self._loop.call_soon(self._drain)
            else:
                self._woken = False

    def _deliver(self) -> int:
        """Deliver what waits, but not more than the loop can do without a delay; return the number of messages."""
        messages, size = limits.DRAIN_MESSAGES, limits.DRAIN_BYTES
        with self.lock:
            discarded = tuple(self.discarded)
            self.discarded.clear()
        for discard, item in discarded:
            discard(item)
        while messages > 0 and size > 0:
            with self.lock:
                if not self._ready:
                    break
                queue = self._ready.popleft()
                taken, taken_bytes = self._take_turn(queue, min(messages, limits.TURN_MESSAGES))
                queue.reschedule()
            with CollectedSends():  # one system call for what goes to one peer
                for item in taken:
                    queue.deliver(item)
            messages -= len(taken)
            size -= taken_bytes
        return limits.DRAIN_MESSAGES - messages

    @staticmethod
    def _take_turn(queue: ArrivalQueue[object], messages: int) -> tuple[list[object], int]:
        taken: list[object] = []
        taken_bytes = 0
        while len(taken) < messages and taken_bytes < limits.TURN_BYTES:
            entry = queue.take()
            if entry is None:
                break
            taken.append(entry[0])
            taken_bytes += entry[1]
        return taken, taken_bytes
