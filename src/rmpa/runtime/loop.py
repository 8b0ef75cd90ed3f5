"""The event loop, in which data goes first, the timers on it, and what keeps it from being late.

Periodic work that need not be exact, on one grid of wake-ups for the whole process.

A wake-up of an idle process costs more than most of the work that it does then: two switches of the processor, the
interpreter's cold caches, a round of the event loop. So periodic work with a period of seconds runs at common times
(*coalesced timers*, as the kernel's timer slack does it): at whole multiples of its period from one moment of the
process. Work of every second, of every 5 s and of every 10 s wakes the process once a second together.

The moment is random in each process: agents of one machine that all worked at the same time would delay its data.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import functools
import gc
import heapq
import logging
import math
import os
import random
import resource
import select
import selectors
import struct
import time
from collections import deque
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar, TypeVarTuple

from rmpa.runtime import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from concurrent.futures import ThreadPoolExecutor

    from _typeshed import FileDescriptorLike

_log = logging.getLogger(__name__)

# Seconds over which the processes of a machine spread; a multiple of the usual periods.
_ORIGIN_SPAN: Final = 60.0
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
    now = asyncio.get_running_loop().time()
    await asyncio.sleep(next_tick(period, now) - now)


class SystemClock:
    """The monotonic and the wall clock of this machine."""

    def now(self) -> float:
        """Monotonic seconds; the same clock as asyncio's ``loop.time()``."""
        return time.monotonic()

    def wall_ns(self) -> int:
        """Wall clock, in nanoseconds since the epoch."""
        return time.time_ns()


# Runs the timer of a protocol machine in the event loop. A machine has no clock: its ``next_timer()`` returns when it
# must be called next, and the call passes the time.


class MachineTimer:
    """One pending timer for one machine, moved whenever the machine's ``next_timer()`` has changed.

    Args:
        next_timer: Returns when the machine must be called, by the loop's ``time()``; ``None``: not at all.
        on_due: Called with the time, which is never before the requested time, although the event loop may call early
            by its clock's resolution. Afterwards the timer is armed again.
    """

    def __init__(self, next_timer: Callable[[], float | None], on_due: Callable[[float], object]) -> None:
        self._next_timer = next_timer
        self._on_due = on_due
        self._handle: asyncio.TimerHandle | None = None
        self._due: float | None = None
        self._closed = False

    def arm(self) -> None:
        """Read ``next_timer()``, and move the pending timer to that time."""
        due = None if self._closed else self._next_timer()
        if due == self._due:
            return
        self._cancel()
        if due is not None:
            self._due = due
            self._handle = asyncio.get_running_loop().call_at(due, self._fire)

    def close(self) -> None:
        """Cancel the timer, and drop the references to the machine, whose owner may hold this timer (a cycle)."""
        self._cancel()
        if not self._closed:
            self._closed = True
            del self._next_timer, self._on_due

    def _cancel(self) -> None:
        self._due = None
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def _fire(self) -> None:
        due, self._due, self._handle = self._due, None, None
        now = asyncio.get_running_loop().time()
        self._on_due(now if due is None else max(due, now))
        self.arm()


class Delay:
    """One call that is due later, unless it is cancelled or another one is set; true while it is due."""

    def __init__(self) -> None:
        self._handle: asyncio.TimerHandle | None = None

    def __bool__(self) -> bool:
        return self._handle is not None

    def set(self, seconds: float, callback: Callable[[], object]) -> None:
        """Call back after so many seconds, in place of what was set before."""

        def call() -> None:
            self._handle = None
            callback()

        self.cancel()
        self._handle = asyncio.get_running_loop().call_later(seconds, call)

    def cancel(self) -> None:
        """Do not call back."""
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None


# A timer as a file descriptor (timerfd_create(2)). Due at an absolute time, to the microsecond.
#
# The event loop's own timers are rounded to milliseconds, and a sleeping thread wakes up late by the timer slack of
# 50 µs. A timerfd has neither fault. Python supports it since 3.13 only, so the C library is called.


_CLOCK_MONOTONIC: Final = 1
_CLOEXEC: Final = 0o2000000
_NONBLOCK: Final = 0o4000
_ABSTIME: Final = 1
_ITIMERSPEC: Final = struct.Struct("@qqqq")
_NANO: Final = 1_000_000_000


class TimerFd:
    """One timer.

    Args:
        blocking: Whether ``wait`` sleeps until the timer is due, for a thread; else ``fileno`` is for a loop.

    Raises:
        OSError: No file descriptor is left.
    """

    def __init__(self, *, blocking: bool) -> None:
        self._fd = _check(_libc().timerfd_create(_CLOCK_MONOTONIC, _CLOEXEC | (0 if blocking else _NONBLOCK)))

    def fileno(self) -> int:
        """The descriptor, which is readable from the due time until ``wait`` or ``set``; -1 once closed."""
        return self._fd

    def set(self, due: float) -> None:
        """Set the due time, in seconds of the monotonic clock; a time in the past is due at once.

        Raises:
            OSError: The timer is closed.
        """
        spec = _ITIMERSPEC.pack(0, 0, *divmod(max(1, round(due * _NANO)), _NANO))
        _check(_libc().timerfd_settime(self._fd, _ABSTIME, spec, None))

    def wait(self) -> bool:
        """Reset a timer that is due; a blocking timer first sleeps until its due time.

        Returns:
            Whether the timer was due; always true for a blocking one.
        """
        try:
            os.read(self._fd, 8)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Close the descriptor; may be called twice. No thread may be in ``wait`` at that time."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _check(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


# The event loop of an agent. Asyncio's, with direct callbacks for the sockets of the data path.
#
# asyncio takes an event from the selector, finds its handle, queues it, checks its timers, and runs the handle in
# its context. For a message that is forwarded at once this is a fifth of the interpreter's work. Here the selector
# itself calls the readers and writers of the data path as soon as ``epoll`` reports them (*direct* readers and
# writers), and returns all other events to asyncio as usual.
#
# Data also interrupts control work: the loop polls the data path's sockets before each ordinary callback, and long
# work calls ``yield_to_data()`` between its slices. A poll costs a quarter of a microsecond. Therefore a direct
# reader, and the code that it calls, may run in the middle of any code that yields, whose data must be consistent
# at each yield. docs/design/isolation.md has the measurements.


_EPOLL_RESOLUTION: Final = 1e-3
_MAX_EVENTS: Final = 64
# Seconds of long work between two looks at the data, whatever the processor's speed; a look costs half a microsecond.
_LOOK_PERIOD: Final = 250e-6
# Seconds of long work in one turn of the loop; then the other ready callbacks run.
_TURN: Final = 1e-3
# Items that are sorted without a yield; it takes some 50 microseconds.
_SORTED_RUN: Final = 256
_T = TypeVar("_T")
_Ts = TypeVarTuple("_Ts")
_NOT_WRITABLE: Final = ~select.EPOLLOUT
_NOT_READABLE: Final = ~select.EPOLLIN


class DirectSelector(selectors.EpollSelector):
    """An epoll selector that calls some readers and writers itself: those of the data path."""

    # The base class has them in every supported Python.
    _selector: select.epoll
    _fd_to_key: dict[int, selectors.SelectorKey]

    def __init__(self) -> None:
        super().__init__()
        # A second epoll for the direct descriptors alone: the cost of polling them does not depend on all others.
        self._data = select.epoll()
        self._poll_direct = self._data.poll
        self._readers: dict[int, Callable[[], None]] = {}
        self._writers: dict[int, Callable[[], None]] = {}
        # Whether a direct reader or writer is running.
        self.in_direct_call = False
        self.polled_at = self.previous_poll_at = time.monotonic()

    def call_directly(self, fd: int, reader: Callable[[], None]) -> None:
        """Call ``reader`` when ``fd`` (registered for reading) is readable, until it is registered no more."""
        if fd not in self._readers:
            self._data.register(fd, _epoll_events(self._fd_to_key[fd].events))
        self._readers[fd] = reader

    def write_directly(self, fd: int, writer: Callable[[], None] | None) -> None:
        """Call ``writer`` when ``fd`` is writable, as long as it has a direct reader too; ``None``: no more."""
        if writer is not None and fd in self._readers:
            self._writers[fd] = writer
        else:
            self._writers.pop(fd, None)

    def poll_data(self) -> None:
        """Call the direct readers and writers that are ready now; without effect when called from one of them."""
        if not self.in_direct_call and (events := self._poll_direct(0, _MAX_EVENTS)):
            self._call(events)

    def unregister(self, fileobj: FileDescriptorLike) -> selectors.SelectorKey:
        """Stop watching a file object; as in ``selectors``."""
        key = super().unregister(fileobj)
        self._remove_direct(key.fd)
        return key

    def modify(self, fileobj: FileDescriptorLike, events: int, data: Any = None) -> selectors.SelectorKey:
        """Watch a file object for other events; as in ``selectors``."""
        key = super().modify(fileobj, events, data)
        if not events & selectors.EVENT_READ:
            self._remove_direct(key.fd)
        elif key.fd in self._readers:
            self._data.modify(key.fd, _epoll_events(events))
        return key

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait up to ``timeout`` seconds; call the ready direct readers and writers, and return the other events."""
        if timeout is None:
            wait = -1.0
        elif timeout <= 0:
            wait = 0.0
        else:
            # Rounded up, as in the base class: else the loop would wake too early for a timer, and spin.
            wait = math.ceil(timeout / _EPOLL_RESOLUTION) * _EPOLL_RESOLUTION
        happened = self._selector.poll(wait, max(len(self._fd_to_key), 1))
        self.previous_poll_at, self.polled_at = self.polled_at, time.monotonic()
        ready = []
        for fd, event in self._call(happened):
            key = self._fd_to_key.get(fd)
            if key is not None:
                events = (selectors.EVENT_WRITE if event & _NOT_READABLE else 0) | (
                    selectors.EVENT_READ if event & _NOT_WRITABLE else 0
                )
                ready.append((key, events & key.events))
        return ready

    def _call(self, events: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Call the direct readers and writers; return the events that are left for asyncio."""
        rest = []
        self.in_direct_call = True
        try:
            for fd, event in events:
                if (reader := self._readers.get(fd)) is not None and event & _NOT_WRITABLE:
                    reader()
                    event &= select.EPOLLOUT  # noqa: PLW2901 - the rest of it
                    if not event:
                        continue
                if (writer := self._writers.get(fd)) is not None and event & select.EPOLLOUT:
                    writer()
                    continue
                rest.append((fd, event))
        finally:
            self.in_direct_call = False
        return rest

    def _remove_direct(self, fd: int) -> None:
        self._writers.pop(fd, None)
        if self._readers.pop(fd, None) is not None:
            with contextlib.suppress(OSError):  # the descriptor is closed already
                self._data.unregister(fd)

    def close(self) -> None:
        """Stop watching everything."""
        super().close()
        self._data.close()
        self._readers.clear()
        self._writers.clear()


class AgentLoop(asyncio.SelectorEventLoop):
    """asyncio's selector loop with ``add_direct_reader``; pending data is handled before every ordinary callback."""

    def __init__(self) -> None:
        self._direct_selector = DirectSelector()
        super().__init__(self._direct_selector)
        # Handles the data that has arrived. Code without a reference to the loop calls ``yield_to_data()``.
        self.yield_to_data = self._direct_selector.poll_data
        # asyncio takes each ready callback from this queue, and only from it.
        self._ready: deque[asyncio.Handle] = _ReadyQueue(self.yield_to_data)

    @property
    def previous_poll_at(self) -> float:
        """Monotonic seconds of the poll before the one that reported the present events.

        The data of the present events arrived after that time, so it has waited in this process no longer.
        """
        return self._direct_selector.previous_poll_at

    def add_direct_reader(self, fd: int, callback: Callable[[], None]) -> None:
        """Like ``add_reader``, but called by the selector itself; ``remove_reader`` ends it.

        ``callback`` must be quick. It may run in the middle of any code that yields: see the module's docstring. Its
        exceptions go to the loop's exception handler. A writer added afterwards for ``fd`` is called directly too.
        """
        self.add_reader(fd, callback)
        self._direct_selector.call_directly(fd, self._guarded(fd, "reader", callback))

    def add_writer(self, fd: FileDescriptorLike, callback: Callable[[*_Ts], Any], *args: *_Ts) -> None:
        """Like asyncio's, but the selector itself calls the writer where ``fd`` has a direct reader."""
        super().add_writer(fd, callback, *args)
        number = _fd(fd)
        self._direct_selector.write_directly(number, self._guarded(number, "writer", lambda: callback(*args)))

    def remove_writer(self, fd: FileDescriptorLike) -> bool:
        """Stop watching for writing, as in asyncio."""
        self._direct_selector.write_directly(_fd(fd), None)
        return super().remove_writer(fd)

    def _guarded(self, fd: int, what: str, callback: Callable[[], None]) -> Callable[[], None]:
        def call() -> None:
            try:
                callback()
            except Exception as error:  # noqa: BLE001 - the top of the call: the loop must go on
                self.call_exception_handler({"message": f"{what} of FD {fd} failed", "exception": error})

        return call


def yield_to_data() -> None:
    """Handle the data that has arrived: for the event loop's thread, between two slices of long work.

    Without effect without a running loop, or on another loop than ``AgentLoop``.
    """
    loop = asyncio._get_running_loop()  # noqa: SLF001 - the public one raises where there is none
    if isinstance(loop, AgentLoop):
        loop.yield_to_data()


def yielding_to_data(items: Iterable[_T], /) -> Iterator[_T]:
    """Yield the items unchanged; handle data before the first, then each 250 µs (a ``core.timers.Yielder``)."""
    due = 0.0
    for item in items:
        if (now := time.monotonic()) >= due:
            yield_to_data()
            due = now + _LOOK_PERIOD
        yield item


def turn_end() -> float:
    """When work that begins now should leave the rest for another turn of the loop, in monotonic seconds."""
    return time.monotonic() + _TURN


def until(end: float, items: Iterable[_T], /) -> Iterator[_T]:
    """Yield items up to the time ``end``, at least one if there is any, and handle data before each."""
    for item in items:
        yield_to_data()
        yield item
        if time.monotonic() >= end:
            return


def sorted_yielding(items: Iterable[str]) -> Iterator[str]:
    """The items in the order of ``sorted``; data is handled in between, as thousands of items take milliseconds."""
    rest = iter(items)
    runs = []
    while run := sorted(islice(rest, _SORTED_RUN)):
        runs.append(run)
        yield_to_data()
    return heapq.merge(*runs)


class _ReadyQueue(deque[asyncio.Handle]):
    """asyncio's ready callbacks; data is handled before each of them."""

    def __init__(self, yield_to_data: Callable[[], None]) -> None:
        super().__init__()
        self._yield_to_data = yield_to_data

    def popleft(self) -> asyncio.Handle:
        """The next callback to run."""
        self._yield_to_data()
        return super().popleft()


def _fd(fileobj: FileDescriptorLike) -> int:
    return fileobj if isinstance(fileobj, int) else fileobj.fileno()


def _epoll_events(events: int) -> int:
    return (select.EPOLLIN if events & selectors.EVENT_READ else 0) | (
        select.EPOLLOUT if events & selectors.EVENT_WRITE else 0
    )


# What keeps the loop from being late: ``--realtime``, and how Python's cyclic garbage collector works.
#
# SCHED_FIFO and locked memory are asked for here; all else is the systemd unit's, or the shell's that starts the
# agent.
#
# The loop's thread gets SCHED_FIFO, and worker threads get it with one priority less. With default scheduling a busy
# process could keep a worker thread that holds the interpreter's lock from the CPU, and the loop would wait for that
# lock (measured with two busy processes: 4 ms late at p99; with a real-time priority 0.2 ms).
# SCHED_RESET_ON_FORK leaves all other threads and every child process at default scheduling.
#
# What the start made is frozen, young garbage collected often. The data path makes no cycles, so in steady state
# nothing needs collecting. Control work makes some: each closed asyncio connection is a cycle. Among 64 modules, at
# 1 kHz and beside 200 calls a second, p99.9 of a message is that of a collector that waits for pauses; with Python's
# own settings a full collection makes it 17 to 21 ms.


REALTIME_REMEDY: Final = (
    "systemd: sudo rmpa service install --realtime, or LimitRTPRIO=50, LimitMEMLOCK=infinity in a unit of your own; "
    "else /etc/security/limits.d (docs/guides/running.md#real-time)"
)
_UNLIMITED: Final = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
# Of mlockall(2). Mappings that come later are locked page by page as they are used: otherwise the kernel would fill
# each new thread's stack and heap with zeros, 10 MB for each thread.
_MCL_CURRENT, _MCL_FUTURE_ON_FAULT = 1, 2 | 4
_BEFORE = gc.get_threshold()


def make_realtime(priority: int, *, lock_memory: bool) -> tuple[str, ...]:
    """Ask for SCHED_FIFO for the calling thread, the loop's, and for locked memory; log the outcomes; never raises.

    Returns:
        The outcomes, ready to read; those that were refused begin with ``no``.
    """
    asked = {f"SCHED_FIFO, priority {priority}": _schedule(priority)}
    if lock_memory:
        asked["memory lock"] = _lock_memory()
    for name, problem in asked.items():
        if problem:
            _log.warning("! realtime: no %s: %s; to get it: %s [realtime-denied]", name, problem, REALTIME_REMEDY)
        else:
            _log.info("= realtime: %s", name)
    return tuple(f"no {name}: {problem}" if problem else name for name, problem in asked.items())


def worker_pool() -> ThreadPoolExecutor:
    """Threads for blocking work, with one real-time priority less than the calling thread, if that has one."""
    from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415 - for an agent alone

    fifo = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    lower = partial(_schedule, max(1, os.sched_getparam(0).sched_priority - 1))
    return ThreadPoolExecutor(thread_name_prefix="worker", initializer=lower if fifo else None)


def _schedule(priority: int) -> str:
    """Give this thread SCHED_FIFO; return why not, or an empty text."""
    try:
        resource.setrlimit(resource.RLIMIT_RTTIME, _UNLIMITED)  # else a thread is killed that works without a rest
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (OSError, ValueError) as error:
        return error.strerror or "" if isinstance(error, OSError) else "LimitRTTIME= is set"
    return ""


def _lock_memory() -> str:
    """Lock present and future mappings; return why not, or an empty text.

    It takes an unlimited RLIMIT_MEMLOCK, or CAP_IPC_LOCK, which a limit of 0 shows: an agent that reaches a limit is
    refused memory, or killed when its stack grows.
    """
    libc, before = _libc(), resource.getrlimit(resource.RLIMIT_MEMLOCK)
    try:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, _UNLIMITED)
    except (OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, before[1]))
    if libc.mlockall(_MCL_CURRENT) or libc.mlockall(_MCL_FUTURE_ON_FAULT):
        problem = f"{os.strerror(ctypes.get_errno())} (ulimit -l)"
        libc.munlockall()
        resource.setrlimit(resource.RLIMIT_MEMLOCK, before)
        return problem
    return ""


def freeze_heap() -> None:
    """Freeze all objects, and collect often from now on; to be called once the agent has started.

    Nothing is collected first: that would delay the start by 20 ms and find almost nothing.
    """
    gc.freeze()
    gc.set_threshold(*limits.COLLECT_THRESHOLDS)
    gc.enable()


def thaw_heap() -> None:
    """Set the collector as Python had it."""
    gc.set_threshold(*_BEFORE)
    gc.unfreeze()
