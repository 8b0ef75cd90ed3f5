"""Reads the clock, the rights and the limits of this machine."""

from __future__ import annotations

import asyncio
import ctypes
import os
import resource
import threading
import time
from pathlib import Path
from typing import Final

from rmpa.core.errors import RmpaError
from rmpa.observe import limits
from rmpa.observe.doctor.machine import KernelRights, WallClock
from rmpa.ros.http.rpc import call_api
from rmpa.runtime import limits as runtime_limits

_CALLER: Final = "/rmpa_doctor"

_UNSYNCHRONISED: Final = 0x40
"""STA_UNSYNC of adjtimex(2)."""


class _Timex(ctypes.Structure):
    """The beginning of ``struct timex`` (adjtimex(2)), with room for the rest of it."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 512),
    )


def read_clock() -> WallClock:
    """Watch the wall clock for ``limits.DOCTOR_CLOCK_LOOK``, and ask the kernel whether it is synchronised."""
    before = time.time() - time.monotonic()
    time.sleep(limits.DOCTOR_CLOCK_LOOK)
    after = time.time() - time.monotonic()
    told = _Timex()
    try:
        answered: bool = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(told)) >= 0
    except (OSError, AttributeError):
        answered = False
    return WallClock(
        stepped=after - before,
        synchronised=not told.status & _UNSYNCHRONISED if answered else None,
        error=told.maxerror * 1e-6,
        year=time.gmtime().tm_year,
    )


def read_sim_time(core_uri: str) -> list[str] | None:
    """The nodes that publish ``/clock`` at a core with ``/use_sim_time``; ``None`` without, or if it is silent."""
    try:
        return asyncio.run(_clocks(core_uri))
    except (RmpaError, TimeoutError):
        return None


async def _clocks(core_uri: str) -> list[str] | None:
    async with asyncio.timeout(limits.DOCTOR_NODES_TIMEOUT):
        used = await call_api(core_uri, "getParam", _CALLER, "/use_sim_time")
        if used.code != 1 or not used.value:
            return None
        match (await call_api(core_uri, "getSystemState", _CALLER)).value:
            case [list(publishers), *_]:
                found = [row[1] for row in publishers if isinstance(row, list) and row[:1] == ["/clock"]]
                return [str(node) for nodes in found if isinstance(nodes, list) for node in nodes]
    return []


def probe_rights(*, wanted: bool, agents: bool) -> KernelRights:
    """Try SCHED_FIFO in a thread of its own, and read the limits.

    Args:
        wanted: Whether the settings ask for real time.
        agents: Whether an agent runs: its snapshot has its own limit of open files.
    """
    refusal = ["it was not tried"]

    def attempt() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
            refusal[0] = ""
        except OSError as error:
            refusal[0] = error.strerror or str(error)

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    memlock = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    free = memlock == resource.RLIM_INFINITY or _may_lock()
    return KernelRights(
        fifo=refusal[0],
        memlock=None if free else memlock,
        wanted=wanted,
        files=None if agents else runtime_limits.OPEN_FILES if files == resource.RLIM_INFINITY else files,
    )


def _may_lock() -> bool:
    """Whether this process has CAP_IPC_LOCK, which the limit of locked memory does not bind."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> 14 & 1)
    return False
