"""The process: garbage collection, log, service manager with its watchdog, and real time.

Sets Python's cyclic garbage collector for an agent: what the start made is frozen, young garbage collected often.

The data path makes no cycles, so in steady state nothing needs collecting. Control work makes some: each closed
asyncio connection is a cycle. Among 64 modules, at 1 kHz and beside 200 calls a second, p99.9 of a message is that
of a collector that waits for pauses; with Python's own settings a full collection makes it 17 to 21 ms.
"""

from __future__ import annotations

import faulthandler
import gc
import logging
import os
import re
import resource
import socket
import threading
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.runtime import limits

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop
    from collections.abc import Mapping

_BEFORE = gc.get_threshold()


def take_over() -> None:
    """Freeze all objects, and collect often from now on; to be called once the agent has started.

    Nothing is collected first: that would delay the start by 20 ms and find almost nothing.
    """
    gc.freeze()
    gc.set_threshold(*limits.COLLECT_THRESHOLDS)
    gc.enable()


def give_back() -> None:
    """Set the collector as Python had it."""
    gc.set_threshold(*_BEFORE)
    gc.unfreeze()


# --- Writes an agent's log lines in a thread, so that a log that is not read does not block the agent ---------------


_log = logging.getLogger(__name__)


class LogWriter:
    """The text stream of a log handler.

    A pipe that is not read (a stopped pager, a hanging journal) blocks its writer. The queue of lines is bounded:
    when it is full, new lines are lost, and their number is logged once the pipe is read again.

    Args:
        fd: The file descriptor for the lines; not closed here.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._waiting: deque[str] = deque()
        self._wake = threading.Event()
        self._closed = False
        # The number of lost lines that is not logged yet.
        self.lost = 0
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    def write(self, text: str) -> int:
        """Queue one or more lines; never blocks."""
        if len(self._waiting) >= limits.LOG_WAITING:
            self.lost += 1
        else:
            self._waiting.append(text)
            self._wake.set()
        return len(text)

    def flush(self) -> None:
        """Do nothing: the thread writes as soon as it can."""

    def close(self) -> None:
        """Wait until all lines are written, but no longer than ``limits.DRAIN_TIMEOUT``."""
        self._closed = True
        self._wake.set()
        self._thread.join(limits.DRAIN_TIMEOUT)

    def _work(self) -> None:
        while not self._closed or self._waiting:
            self._wake.wait()
            if not self._closed:
                time.sleep(limits.LOG_GATHER)  # so that the lines of a burst are written in one call
            self._wake.clear()
            while self._waiting:
                self._write()
            if self.lost:
                lost, self.lost = self.lost, 0
                _log.warning(
                    "! %d log lines were lost: the program that reads the log had stopped [log-lines-lost]", lost
                )

    def _write(self) -> None:
        lines = [self._waiting.popleft() for _ in range(min(len(self._waiting), limits.LOG_BATCH))]
        rest = memoryview("".join(lines).encode(errors="backslashreplace"))
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                time.sleep(limits.LOG_GATHER)  # the pipe is full, and another process has made it non-blocking
            except OSError:
                return  # the pipe is closed


def in_journal(environ: Mapping[str, str], fd: int) -> bool:
    """Whether a descriptor leads to systemd's journal, by JOURNAL_STREAM (systemd.exec(5))."""
    try:
        status = os.fstat(fd)
    except OSError:
        return False
    return environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


# The line of proc(5)'s cgroup of a process that a unit of the system runs.
_OF_UNIT: Final = re.compile(r":/system\.slice/(rmpa[\w-]*)\.service", re.MULTILINE)


def unit_of(pid: int | str = "self") -> str:
    """The system's unit that an agent runs in, ``rmpa``; empty: it was started by hand."""
    try:
        found = _OF_UNIT.search(Path(f"/proc/{pid}/cgroup").read_text("utf-8", "replace"))
    except OSError:
        return ""
    return found[1] if found else ""


def restart_text(pid: int | str = "self", start: str = "rmpa up") -> str:
    """How an agent is restarted, behind "restart …: "; ``start`` starts one that no unit runs."""
    unit = unit_of(pid)
    return f"sudo systemctl restart {unit}" if unit else f"end it (Ctrl-C), then {start}"


# --- ``--realtime`` -------------------------------------------------------------------------------------------------
#
# SCHED_FIFO and locked memory. All else is the systemd unit's, or the shell's that starts the agent.
#
# The loop's thread gets SCHED_FIFO, and worker threads get it with one priority less. With default scheduling a
# busy process could keep a worker thread that holds the interpreter's lock from the CPU, and the loop would wait
# for that lock (measured with two busy processes: 4 ms late at p99; with a real-time priority 0.2 ms).
# SCHED_RESET_ON_FORK leaves all other threads and every child process at default scheduling.


REMEDY: Final = (
    "systemd: sudo rmpa service install --realtime, or LimitRTPRIO=50, LimitMEMLOCK=infinity in a unit of your own; "
    "else /etc/security/limits.d (docs/guides/running.md#real-time)"
)
_UNLIMITED: Final = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
# Of mlockall(2). Mappings that come later are locked page by page as they are used: otherwise the kernel would fill
# each new thread's stack and heap with zeros, 10 MB for each thread.
_MCL_CURRENT, _MCL_FUTURE_ON_FAULT = 1, 2 | 4


def apply(priority: int, *, lock_memory: bool) -> tuple[str, ...]:
    """Ask for SCHED_FIFO for the calling thread, the loop's, and for locked memory; log the outcomes; never raises.

    Returns:
        The outcomes, ready to read; those that were refused begin with ``no``.
    """
    asked = {f"SCHED_FIFO, priority {priority}": _schedule(priority)}
    if lock_memory:
        asked["memory lock"] = _lock_memory()
    for name, problem in asked.items():
        if problem:
            _log.warning("! realtime: no %s: %s; to get it: %s [realtime-denied]", name, problem, REMEDY)
        else:
            _log.info("= realtime: %s", name)
    return tuple(f"no {name}: {problem}" if problem else name for name, problem in asked.items())


def worker_pool() -> ThreadPoolExecutor:
    """Threads for blocking work, with one real-time priority less than the calling thread, if that has one."""
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
    import ctypes  # noqa: PLC0415 - 3 ms of the start that only --realtime has to pay

    libc, limits = ctypes.CDLL(None, use_errno=True), resource.getrlimit(resource.RLIMIT_MEMLOCK)
    try:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, _UNLIMITED)
    except (OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, limits[1]))
    if libc.mlockall(_MCL_CURRENT) or libc.mlockall(_MCL_FUTURE_ON_FAULT):
        problem = f"{os.strerror(ctypes.get_errno())} (ulimit -l)"
        libc.munlockall()
        resource.setrlimit(resource.RLIMIT_MEMLOCK, limits)
        return problem
    return ""


# --- Status notifications to systemd (sd_notify(3)) -----------------------------------------------------------------
#
# One datagram to NOTIFY_SOCKET, if it is set.

# What systemd sets for the process that it starts, and that means no child of it.
SERVICE_VARIABLES: Final = ("NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC")
# Seconds after which a sign of life that could not be sent is tried again.
_WATCHDOG_RETRY: Final = 1.0
_CANNOT_TELL: Final = "! the service manager at NOTIFY_SOCKET=%s cannot be told %s: %s [watchdog]"


def notify_service_manager(state: str) -> bool:
    """Send ``READY=1``, ``STOPPING=1`` or ``STATUS=…``; a failure is logged and never fatal.

    Returns:
        Whether it was sent.
    """
    address = _notify_address()
    if not address:
        return False
    try:
        with _notify_socket() as sock:
            sock.sendto(state.encode(), address)
    except OSError as error:
        _log.warning(_CANNOT_TELL, address, state, error)
        return False
    return True


def _notify_address() -> str:
    address = os.environ.get("NOTIFY_SOCKET", "")
    return "\0" + address[1:] if address.startswith("@") else address


def _notify_socket() -> socket.socket:
    return socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)


def watchdog_period(environ: Mapping[str, str]) -> float | None:
    """Half of the time in seconds in which systemd wants ``WATCHDOG=1``; ``None``: never (sd_watchdog_enabled(3))."""
    usec, pid = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
    if not usec.isdecimal() or int(usec) == 0 or pid not in ("", str(os.getpid())):
        return None
    return int(usec) / 2e6


def feed_watchdog(loop: AbstractEventLoop) -> None:
    """Send ``WATCHDOG=1`` from the event loop for as long as it runs, if systemd wants it.

    A loop that hangs sends none, and systemd ends the process by SIGABRT; where it hung is then in the log.
    """
    period, address = watchdog_period(os.environ), _notify_address()
    if period is None or not address:
        return
    faulthandler.enable()
    sock: socket.socket | None = None
    failed = False

    def feed() -> None:
        nonlocal sock, failed
        try:
            # One socket for all: later there may be no descriptor left.
            sock = sock or _notify_socket()
            # A service manager that does not read must not stop the loop.
            sock.sendto(b"WATCHDOG=1", socket.MSG_DONTWAIT, address)
        except OSError as error:
            if not failed:
                _log.warning(_CANNOT_TELL, address, "WATCHDOG=1", error)
            failed = True
        else:
            failed = False
        loop.call_later(min(period, _WATCHDOG_RETRY) if failed else period, feed)

    feed()
