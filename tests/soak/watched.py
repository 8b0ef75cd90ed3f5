"""``rmpa up`` as users run it, but on SIGUSR1 it writes what it holds to the file SOAK_HELD; started by ``stage``.

A thread watches how late its loop is, and how late the thread itself: where an answer does not come in time, this
tells whether the agent was busy or the machine was.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import threading
import time
from collections import Counter, deque
from pathlib import Path
from typing import Final

from rmpa.agent import process
from rmpa.cli.main import main
from rmpa.runtime.loop import AgentLoop

_EVERY: Final = 0.25
"""Seconds between two looks at the loop."""
_LATELY: Final = 20.0
"""Seconds of which the worst is told: twice what a client waits for an answer."""


def tell(*_: object) -> None:
    """Write the names of all tasks, with how many there are of each."""
    tasks = Counter(getattr(task.get_coro(), "__qualname__", "?") for task in asyncio.all_tasks())
    path = Path(os.environ["SOAK_HELD"])
    written = path.with_suffix(".new")
    written.write_text(json.dumps(tasks), encoding="utf-8")
    written.replace(path)


class Lateness:
    """Writes how late loop and thread were at the most lately to SOAK_HELD with the ending ``late``.

    Args:
        loop: The agent's.
        path: The file, JSON: ``{"loop": seconds, "thread": seconds}``.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, path: Path) -> None:
        self._loop = loop
        self._path = path
        self._seen: deque[tuple[float, float, float]] = deque()
        threading.Thread(target=self._watch, name="lateness", daemon=True).start()

    def _watch(self) -> None:
        while not self._loop.is_closed():
            began = time.monotonic()
            time.sleep(_EVERY)
            thread = time.monotonic() - began - _EVERY
            asked, answered = time.monotonic(), threading.Event()
            try:
                self._loop.call_soon_threadsafe(answered.set)
            except RuntimeError:
                return  # closed since
            while not answered.wait(_EVERY) and not self._loop.is_closed():
                self._write(time.monotonic() - asked, thread)
            self._write(time.monotonic() - asked, thread)

    def _write(self, loop: float, thread: float) -> None:
        now = time.monotonic()
        self._seen.append((now, loop, thread))
        while self._seen[0][0] < now - _LATELY:
            self._seen.popleft()
        worst = {"loop": max(seen[1] for seen in self._seen), "thread": max(seen[2] for seen in self._seen)}
        written = self._path.with_suffix(".new-late")
        written.write_text(json.dumps(worst), encoding="utf-8")
        written.replace(self._path)


class WatchedLoop(AgentLoop):
    """An agent's loop whose lateness is watched."""

    def __init__(self) -> None:
        super().__init__()
        Lateness(self, Path(os.environ["SOAK_HELD"]).with_suffix(".late"))


if __name__ == "__main__":
    signal.signal(signal.SIGUSR1, tell)
    process.AgentLoop = WatchedLoop  # type: ignore[attr-defined]  # in the way of rmpa.agent.process.run_process
    sys.exit(main())
