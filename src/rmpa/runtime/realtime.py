"""``--realtime``, and Python's cyclic garbage collector: what keeps the loop from being late.

SCHED_FIFO and locked memory are asked for here; all else is the systemd unit's, or the shell's that starts the agent.

The loop's thread gets SCHED_FIFO, and worker threads get it with one priority less. With default scheduling a
busy process could keep a worker thread that holds the interpreter's lock from the CPU, and the loop would wait
for that lock (measured with two busy processes: 4 ms late at p99; with a real-time priority 0.2 ms).
SCHED_RESET_ON_FORK leaves all other threads and every child process at default scheduling.

What the start made is frozen, young garbage collected often. The data path makes no cycles, so in steady state
nothing needs collecting. Control work makes some: each closed asyncio connection is a cycle. Among 64 modules, at
1 kHz and beside 200 calls a second, p99.9 of a message is that of a collector that waits for pauses; with Python's
own settings a full collection makes it 17 to 21 ms.
"""

from __future__ import annotations

import gc
import logging
import os
import resource
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Final

from rmpa.runtime import limits

_log = logging.getLogger(__name__)

REMEDY: Final = (
    "systemd: sudo rmpa service install --realtime, or LimitRTPRIO=50, LimitMEMLOCK=infinity in a unit of your own; "
    "else /etc/security/limits.d (docs/guides/running.md#real-time)"
)
_UNLIMITED: Final = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
# Of mlockall(2). Mappings that come later are locked page by page as they are used: otherwise the kernel would fill
# each new thread's stack and heap with zeros, 10 MB for each thread.
_MCL_CURRENT, _MCL_FUTURE_ON_FAULT = 1, 2 | 4
_BEFORE = gc.get_threshold()


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
