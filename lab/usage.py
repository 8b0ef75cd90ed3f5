"""CPU and memory of the processes on a path."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class Usage:
    """One process over one span.

    Args:
        cpu: Seconds of processor time, user and system.
        wall: Seconds that the span lasted.
        rss: Resident bytes at its end.
    """

    cpu: float
    wall: float
    rss: int

    @property
    def percent(self) -> float:
        """Of one core."""
        return 100 * self.cpu / self.wall if self.wall else 0.0


class Meter:
    """Measures processes from its making to ``read()``.

    Args:
        pids: Process ids by the name that the report gives them.
    """

    def __init__(self, pids: Mapping[str, int]) -> None:
        self._processes = {name: psutil.Process(pid) for name, pid in pids.items()}
        self._before = {name: _cpu(process) for name, process in self._processes.items()}
        self._start = time.perf_counter()

    def read(self) -> dict[str, Usage]:
        """Usage since the start, by name."""
        wall = time.perf_counter() - self._start
        return {
            name: Usage(_cpu(process) - self._before[name], wall, process.memory_info().rss)
            for name, process in self._processes.items()
        }


def add(first: Mapping[str, Usage], second: Mapping[str, Usage]) -> dict[str, Usage]:
    """Join two spans of the same processes: times add up, memory is the larger."""
    joined = dict(first)
    for name, usage in second.items():
        before = joined.get(name, Usage(0.0, 0.0, 0))
        joined[name] = Usage(before.cpu + usage.cpu, before.wall + usage.wall, max(before.rss, usage.rss))
    return joined


def _cpu(process: psutil.Process) -> float:
    """Seconds on a processor, over all threads: the scheduler's own count, where the kernel gives it.

    The usual one counts whole ticks of 10 ms.
    """
    total = 0
    try:
        for task in Path(f"/proc/{process.pid}/task").iterdir():
            total += int((task / "schedstat").read_text(encoding="ascii").split()[0])
    except (FileNotFoundError, ProcessLookupError):
        times = process.cpu_times()
        return times.user + times.system
    return total / 1e9


def wakeups(pid: int) -> int:
    """How often the threads of a process have waited and were woken since each began (voluntary context switches)."""
    total = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        lines = (task / "status").read_text(encoding="ascii").splitlines()
        total += next(int(line.split()[1]) for line in lines if line.startswith("voluntary_ctxt_switches"))
    return total
