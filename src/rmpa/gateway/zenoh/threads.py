"""The way of messages between Zenoh's threads and the event loop, in both directions.

Arrivals: Zenoh calls back in threads of its own. Each subscriber has a queue there, and one wake-up of the loop is
enough for all that came until the loop runs. The queues take turns, so that a flood on one does not delay the others.

The loop and Zenoh's threads share the interpreter's lock. A loop that each message wakes would hand it over for each
one, which costs 20 µs. So above ``_BUSY_MESSAGES`` in a period the loop is not woken: it looks once a period.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import queue
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from rmpa.core.contract import Priority
from rmpa.gateway import limits
from rmpa.runtime.loop import Delay
from rmpa.runtime.stream import CollectedSends

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Sequence


_log = logging.getLogger(__name__)

# Messages of one publisher that are sent in one turn, while others of its priority wait.
_TURN_MESSAGES: Final = 64
# Bytes of one publisher in one turn: one batch of Zenoh. One message always fits.
_TURN_BYTES: Final = 65_536
# Messages that the event loop takes before it looks at its other work: at most a millisecond or so.
_DRAIN_MESSAGES: Final = 256
# Bytes that the event loop takes before it looks at its other work.
_DRAIN_BYTES: Final = 8 * 1024 * 1024
# Messages in ``BUSY_PERIOD`` from which on the loop is not woken for each: 8,000 a second.
_BUSY_MESSAGES: Final = 8

_T = TypeVar("_T")


class ZenohPriority(IntEnum):
    """Those of Zenoh's priorities that are used; a lower number goes first."""

    REAL_TIME = 1
    INTERACTIVE_HIGH = 2
    DATA = 5
    DATA_LOW = 6


# The priority of a topic's messages, by that of its contract.
PRIORITIES: Final = {
    Priority.HIGH: ZenohPriority.REAL_TIME,
    Priority.NORMAL: ZenohPriority.DATA,
    Priority.LOW: ZenohPriority.DATA_LOW,
}


@dataclass(frozen=True, slots=True)
class ZenohQos:
    """The QoS of one publisher, and the bounds of its queue in this process.

    Args:
        reliable: Zenoh's reliability ``RELIABLE``; else ``BEST_EFFORT``.
        block: Congestion control ``BLOCK`` (it waits in a thread of its own); else ``DROP``.
        priority: Zenoh's priority.
        messages: Messages that wait at most; above it the oldest is dropped, and counted.
        bytes: Bytes that wait at most; one message always fits.
        cache: Samples that a later subscriber gets (an advanced publisher); 0: an ordinary publisher.
    """

    reliable: bool = True
    block: bool = True
    priority: ZenohPriority = ZenohPriority.DATA
    messages: int = 1000
    bytes: int = 64 * 1024 * 1024
    cache: int = 0


@dataclass(frozen=True, slots=True)
class ZenohSample:
    """One message that was received, or one answer to ``get``.

    Args:
        payload: Its bytes; of an error its text in UTF-8.
        attachment: Its attachment; empty if it has none.
        ok: Whether it is no error.
    """

    payload: bytes
    attachment: bytes = b""
    ok: bool = True

    @property
    def text(self) -> str:
        """The text of an error."""
        return self.payload.decode(errors="replace")


def first_answer(replies: Sequence[ZenohSample]) -> ZenohSample | None:
    """The first answer, or the first error if there is none; ``None``: nothing answered."""
    return min(replies, key=lambda each: not each.ok, default=None)


def call_loop(loop: asyncio.AbstractEventLoop, function: Callable[[], None]) -> None:
    """Call a function in the event loop, from any thread, if the loop still runs."""
    with contextlib.suppress(RuntimeError):  # it was closed before the session
        loop.call_soon_threadsafe(function)


_threads = threading.local()


def keep_thread_state() -> None:
    """Keep the interpreter's state of this thread, which Zenoh's runtime has started, until the thread ends.

    Without it each callback makes and removes such a state, with pages of memory: 15 µs instead of 2.
    """
    if not getattr(_threads, "kept", False):
        _threads.kept = True
        ctypes.pythonapi.PyGILState_Ensure()


class BoundedQueue(Generic[_T]):
    """Items with their sizes in bytes; beyond its bounds the oldest go, but one always fits. Its user has the lock.

    Args:
        messages: Items that wait at most.
        size: Bytes that wait at most.

    Attributes:
        dropped: Items that found no room.
    """

    def __init__(self, messages: int, size: int) -> None:
        self._messages = messages
        self._limit = size
        self._items: deque[tuple[_T, int]] = deque()
        self._bytes = 0
        self.dropped = 0

    def push(self, item: _T, size: int, besides: int = 0) -> Sequence[_T]:
        """Queue an item; return those that were dropped. ``besides``: items that count, and wait elsewhere."""
        self._items.append((item, size))
        self._bytes += size
        if len(self._items) + besides <= self._messages and self._bytes <= self._limit:
            return ()
        dropped = []
        while len(self._items) > 1 and (len(self._items) + besides > self._messages or self._bytes > self._limit):
            old, size = self._items.popleft()
            self._bytes -= size
            dropped.append(old)
        self.dropped += len(dropped)
        return dropped

    def take_turn(self, messages: int = _TURN_MESSAGES) -> tuple[list[_T], int]:
        """Take the oldest items, as many as go in one turn, and their bytes."""
        turn: list[_T] = []
        size = 0
        while self._items and len(turn) < messages and size < _TURN_BYTES:
            item, each = self._items.popleft()
            turn.append(item)
            size += each
        self._bytes -= size
        return turn, size

    def clear(self) -> list[_T]:
        """Forget what waits, and return it."""
        items = [item for item, _ in self._items]
        self._items.clear()
        self._bytes = 0
        return items


class ArrivalQueue(BoundedQueue[_T]):
    """What arrived for one subscriber, and waits for the event loop.

    Args:
        arrivals: The loop's side.
        deliver: Called in the loop with each item.
        messages: Items that wait at most; above it the oldest is dropped.
        size: Bytes that wait at most; one item always fits.
        discard: Called with each item that was dropped, in the thread that dropped it.
    """

    def __init__(
        self,
        arrivals: Arrivals,
        deliver: Callable[[_T], object],
        messages: int,
        size: int,
        discard: Callable[[_T], None] | None = None,
    ) -> None:
        super().__init__(messages, size)
        self._arrivals = arrivals
        self._deliver = deliver
        self._discard = discard
        self._scheduled = False
        self._closed = False

    def add(self, item: _T, size: int = 0) -> None:
        """Queue one item of ``size`` bytes, from any thread."""
        with self._arrivals.lock:
            if self._closed:
                return
            if dropped := self.push(item, size):
                self._arrivals.refused["zenoh.arrival.dropped"] += len(dropped)
                self._give_back(dropped)
            if not self._scheduled:
                self.reschedule()

    def close(self) -> None:
        """Forget what waits; nothing is delivered afterwards."""
        with self._arrivals.lock:
            self._closed = True
            self._give_back(self.clear())
            self._arrivals.wake()

    def _give_back(self, items: Sequence[_T]) -> None:
        if self._discard is not None:
            for item in items:
                self._discard(item)

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
            _log.exception("! zenoh: what arrived could not be handled")


class Arrivals:
    """The loop's side of all queues of a session.

    Args:
        loop: The event loop that everything is delivered in.

    Attributes:
        refused: What was dropped or refused, by its reason; guarded by ``lock``.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop: Final = loop
        self.lock = threading.Lock()
        self.refused: Counter[str] = Counter()
        self._ready: deque[ArrivalQueue[object]] = deque()
        self._woken = False
        self._closed = False
        self._window_end = 0.0
        self._in_window = 0
        # What waits in memory for Zenoh to take it; guarded by ``lock``.
        self._answers = self._answer_bytes = 0

    def take_room(self, size: int) -> bool:
        """Reserve room for an answer of ``size`` bytes; one alone always has it.

        A client that does not read its answers holds them all up.
        """
        with self.lock:
            full = self._answers >= limits.ANSWERS_WAITING_MAX or self._answer_bytes + size > limits.ANSWER_BYTES_MAX
            if self._answers and full:
                self.refused["zenoh.answer.limit"] += 1
                return False
            self._answers += 1
            self._answer_bytes += size
        return True

    def free_room(self, size: int) -> None:
        """Give the room back, once Zenoh has the answer."""
        with self.lock:
            self._answers -= 1
            self._answer_bytes -= size

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
                self.loop.call_soon_threadsafe(self._drain)
            except RuntimeError:  # the loop was closed before the session
                self._closed = True

    def close(self) -> None:
        """Deliver nothing more."""
        with self.lock:
            self._closed = True
            self._ready.clear()

    def _drain(self) -> None:
        taken = self._deliver()
        now = self.loop.time()
        if now >= self._window_end:
            self._window_end = now + limits.BUSY_PERIOD
            self._in_window = 0
        self._in_window += taken
        with self.lock:
            if self._closed:
                return
            if self._ready and taken >= _DRAIN_MESSAGES:
                self.loop.call_soon(self._drain)
            elif self._in_window >= _BUSY_MESSAGES:
                self.loop.call_later(limits.BUSY_PERIOD, self._drain)
            elif self._ready:
                self.loop.call_soon(self._drain)
            else:
                self._woken = False

    def _deliver(self) -> int:
        """Deliver what waits, but not more than the loop can do without a delay; return the number of messages."""
        messages, size = _DRAIN_MESSAGES, _DRAIN_BYTES
        while messages > 0 and size > 0:
            with self.lock:
                if not self._ready:
                    break
                queue = self._ready.popleft()
                taken, taken_bytes = queue.take_turn(min(messages, _TURN_MESSAGES))
                queue.reschedule()
            with CollectedSends():  # one system call for what goes to one peer
                for item in taken:
                    queue.deliver(item)
            messages -= len(taken)
            size -= taken_bytes
        return _DRAIN_MESSAGES - messages


# What waits for Zenoh: a put of a reliable publisher waits while the transport's queue of its priority is full, and
# so do declarations, queries and replies. Zenoh has one such queue for each priority, so each priority in use has one
# thread here, and within it the publishers take turns. What waits for a full bulk lane holds no command up, and
# nothing holds the event loop up. Behind a full transport the oldest messages of each publisher are dropped, and
# counted.


class SerialWorker:
    """Runs functions one after the other in a daemon thread, in the order in which they were given.

    Args:
        name: The thread's name.
    """

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._discard = False
        self.thread = threading.Thread(target=self._run, name=name, daemon=True)
        self.thread.start()

    def submit(self, job: Callable[[], object]) -> None:
        """Run ``job`` after all that was given before; its errors are logged."""
        self._jobs.put(job)

    def stop(self, *, discard: bool = False) -> None:
        """End the thread once all that was given has run.

        Args:
            discard: What has not begun is not run.
        """
        self._discard = discard
        self._jobs.put(None)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                if not self._discard:
                    job()
            except Exception as error:  # noqa: BLE001 - one declaration that fails must not stop the others
                if not self._discard:
                    _log.warning("! zenoh: %s [zenoh-trouble]", error)
            del job


class SendingLane(SerialWorker):
    """The thread that puts the messages of one priority; its jobs are the turns of publishers.

    Args:
        loop: The event loop that the publishers belong to.
        name: The thread's name.
        failures: The exceptions of Zenoh's ``put``.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, name: str, failures: tuple[type[Exception], ...]) -> None:
        self.loop: Final = loop
        self._failures = failures
        self._failed = False
        self._window_end = 0.0
        self._in_window = 0
        super().__init__(name)

    def put(self, handle: Any, key: str, payload: bytes, attachment: bytes) -> bool:
        """Put one message; return whether Zenoh took it. Called from the lane's thread."""
        if self._discard:
            return False
        try:
            handle.put(payload, attachment=attachment or None)
        except self._failures as error:
            if not self._failed:
                self._failed = True
                _log.warning("! zenoh: a message by %s was not sent: %s [zenoh-trouble]", key, error)
            return False
        return True

    def rest(self, messages: int) -> None:
        """End a turn of so many messages. Called from the lane's thread.

        Above ``_BUSY_MESSAGES`` the loop need not wake this thread, nor wait for the interpreter's lock, for each.
        """
        now = time.monotonic()
        if now >= self._window_end:
            self._window_end, self._in_window = now + limits.BUSY_PERIOD, 0
        self._in_window += messages
        if self._in_window >= _BUSY_MESSAGES and self._jobs.empty():
            time.sleep(limits.BUSY_PERIOD / 2)


class QueuedPublisher(BoundedQueue[tuple[bytes, bytes]]):
    """A publisher that queues, with the bounds of its QoS; each message has its own attachment.

    Args:
        lane: The thread of its priority.
        key: Its key.
        qos: Its bounds.
        undeclare: Called in the event loop once nothing of it is sent any more.

    Attributes:
        handle: Zenoh's publisher; nothing is sent before it is declared.
    """

    def __init__(self, lane: SendingLane, key: str, qos: ZenohQos, undeclare: Callable[[], None]) -> None:
        super().__init__(qos.messages, qos.bytes)
        self._lane = lane
        self._lock = threading.Lock()
        self.key: Final = key
        self._undeclare = undeclare
        self.handle: Any = None
        self._taken = 0
        self._scheduled = False
        self._flushing = Delay()
        self._closed = False
        self.sent = 0

    @property
    def waiting(self) -> int:
        """Messages in the queue, with those whose turn it is."""
        return len(self._items) + self._taken

    def put_all(self, messages: Sequence[tuple[bytes, bytes]]) -> None:
        """Queue messages, each with its attachment, in order."""
        with self._lock:
            if self._closed:
                self.dropped += len(messages)
                return
            for message in messages:
                self.push(message, len(message[0]), self._taken)
            self._schedule()

    def declared(self, handle: Any) -> None:
        """Begin to send: Zenoh's publisher is there. Called from the thread that declares."""
        with self._lock:
            self.handle = handle
            self._schedule()

    def close(self) -> None:
        """Undeclare it, after the queue is empty or a second has passed."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            empty = not self.waiting
        if empty:
            self._undeclare()
        else:
            self._flushing.set(limits.FLUSH_MAX, self._give_up)

    def _schedule(self) -> None:
        """Take a turn soon, if something waits. The caller has the lock."""
        if self._items and not self._scheduled and self.handle is not None:
            self._scheduled = True
            self._lane.submit(self._turn)

    def _turn(self) -> None:
        """Put the messages of one turn, and count them. Called from the lane's thread."""
        with self._lock:
            turn, _ = self.take_turn()
            self._taken = len(turn)
        for payload, attachment in turn:
            sent = self._lane.put(self.handle, self.key, payload, attachment)
            self._taken -= 1
            if sent:
                self.sent += 1
            else:
                with self._lock:
                    self.dropped += 1
        with self._lock:
            self._scheduled = False
            self._schedule()
            ended = self._closed and not self._items
        if ended:
            call_loop(self._lane.loop, self._flushed)
        self._lane.rest(len(turn))

    def _flushed(self) -> None:
        if self._flushing:
            self._flushing.cancel()
            self._undeclare()

    def _give_up(self) -> None:
        with self._lock:
            self.dropped += len(self.clear())
        self._undeclare()
