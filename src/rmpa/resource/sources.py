"""What the running resource answers to functions in expressions: ``cpu``, ``memory``, ``temperature`` and others.

Figures of processes and of the machine are read in a thread, once in each window, and only those that an expression
uses. An answer that is not known is ``None``.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import os
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from rmpa.resource import limits
from rmpa.resource.runtime import RuntimePart
from rmpa.ros.types.definitions import ARRAY_TYPE
from rmpa.ros.types.messages import MessageType
from rmpa.runtime.accept import in_thread
from rmpa.runtime.tasks import OwnedTasks, keep_task

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.expression import Scalar
    from rmpa.resource.processes import Processes
    from rmpa.resource.runtime import Runtime
    from rmpa.resource.values import ExpressionValues
    from rmpa.ros.node.endpoints import Received

_log = logging.getLogger(__name__)
_ZONES: Final = Path("/sys/class/thermal")
_NUMBER: Final = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)")
_FIGURES: Final = frozenset({"cpu", "memory", "temperature"})


class ProcessUse(NamedTuple):
    """What a process has used: seconds of processor time, and bytes that it holds in memory."""

    cpu: float
    memory: int


def read_process(pid: int) -> ProcessUse | None:
    """Read ``/proc/PID/stat`` (proc(5)); ``None`` if there is no such process."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace").rpartition(")")[2].split()
        ticks, pages = int(fields[11]) + int(fields[12]), int(fields[21])
    except (OSError, ValueError, IndexError):
        return None
    return ProcessUse(ticks / os.sysconf("SC_CLK_TCK"), pages * os.sysconf("SC_PAGE_SIZE"))


def read_zones(folder: Path = _ZONES) -> dict[str, float]:
    """The temperature of each type of thermal zone in °C, of several of one type the hottest."""
    found: dict[str, float] = {}
    for zone in folder.glob("thermal_zone*"):
        try:
            kind, value = (zone / "type").read_text().strip(), int((zone / "temp").read_text()) / 1000
        except (OSError, ValueError):
            continue  # a sensor that is switched off
        found[kind] = max(value, found.get(kind, value))
    return found


class Sources(RuntimePart):
    """Answers the functions of one resource's expressions; must be started after ``processes``.

    Args:
        runtime: The runtime of the resource.
        values: Asks.
        processes: Knows the processes of nodes.
    """

    def __init__(self, runtime: Runtime, values: ExpressionValues, processes: Processes) -> None:
        self._runtime = runtime
        self._processes = processes
        self._used = {source.function for source in values.sources.values()}
        self._statuses = {one.arguments[0] for one in values.sources.values() if one.function == "diagnostics"}
        # By name of the status: when it has come, its level, and its values.
        self._diagnostics: dict[str, tuple[float, int, dict[str, str]]] = {}
        # By node: its process, and what that had used at a moment.
        self._before: dict[str, tuple[int, float, ProcessUse]] = {}
        self._cpu: dict[str, float] = {}
        self._memory: dict[str, float] = {}
        self._zones: Mapping[str, float] = {}
        self._work = OwnedTasks()
        values.providers |= {
            "cpu": lambda node="": self._cpu.get(node or self._only),
            "memory": lambda node="": self._memory.get(node or self._only),
            "temperature": lambda zone="": self._zones.get(zone) if zone else max(self._zones.values(), default=None),
            "diagnostics": self._diagnosed,
            "running": lambda node: self._processes.pid(node) is not None,
        }

    async def start(self) -> None:
        """Begin to read what is used."""
        if self._used & _FIGURES:
            self._work.add(keep_task(self._read, f"figures for {self._runtime.resource.name}"))
        if self._statuses:
            await self._runtime.node.subscribe("/diagnostics", MessageType(ARRAY_TYPE), self._received)

    async def close(self) -> None:
        """Read no more."""
        await self._work.close()

    @property
    def _only(self) -> str:
        return next(iter(self._runtime.resource.nodes), "")

    async def _read(self) -> None:
        while True:
            pids = {key: pid for key in self._runtime.resource.nodes if (pid := self._processes.pid(key)) is not None}
            zones, processes = await in_thread(functools.partial(self._figures, pids), "figures of processes")
            self._zones, now = zones, time.monotonic()
            self._memory = {key: float(use.memory) for key, use in processes.items()}
            self._cpu = {
                key: (use.cpu - before[2].cpu) / (now - before[1])
                for key, use in processes.items()
                if (before := self._before.get(key)) is not None and before[0] == pids[key] and now > before[1]
            }
            self._before = {key: (pids[key], now, use) for key, use in processes.items()}
            await asyncio.sleep(max(self._runtime.resource.settings.window, limits.FIGURES_PAUSE))

    def _figures(self, pids: Mapping[str, int]) -> tuple[dict[str, float], dict[str, ProcessUse]]:
        zones = read_zones() if "temperature" in self._used else {}
        return zones, {key: use for key, pid in pids.items() if (use := read_process(pid)) is not None}

    def _received(self, message: Received) -> None:
        for status in message.message.status:
            if (name := str(status.name)) in self._statuses:
                values = {str(pair.key): str(pair.value) for pair in status.values}
                self._diagnostics[name] = time.monotonic(), int(status.level), values

    def _diagnosed(self, name: str, key: str = "") -> Scalar | None:
        """The number at the beginning of a value, or its text where there is none; without a key the level."""
        at, level, values = self._diagnostics.get(name, (0.0, 0, {}))
        if name not in self._diagnostics or time.monotonic() - at > limits.DIAGNOSTICS_LIFESPAN:
            return None
        if not key:
            return level
        if (text := values.get(key)) is None:
            return None
        number = _NUMBER.match(text)
        return float(number[1]) if number else text
