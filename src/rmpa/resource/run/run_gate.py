"""A gate that separates the runs of tasks from changes of the profile, the context or several parameters."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

ENTER_SLICE: Final = 0.1
"""The longest time in seconds that a waiting thread takes to notice that it has to end."""
_POLL: Final = 0.002
"""Seconds between a waiting coroutine's checks of the gate; polling will do, because changes are rare and short."""


class RunGate:
    """Lets runs begin while it is open; after closing it, a closer can wait until no run is inside.

    Thereby a profile is applied between two runs, and no message is computed partly under each of two profiles.
    """

    def __init__(self) -> None:
        self._change = threading.Condition()
        self._closers: set[str] = set()
        self._inside: set[object] = set()

    def enter(self, run: object, ended: Callable[[], bool]) -> bool:
        """Wait in a thread until the gate is open; returns false if ``ended`` returns true while it is closed."""
        # An open gate is entered without the lock: a closer examines the runs inside only after it has closed.
        self._inside.add(run)
        if not self._closers:
            return True
        with self._change:
            self._inside.discard(run)
            self._change.notify_all()
            while self._closers:
                if ended():
                    return False
                self._change.wait(ENTER_SLICE)
            self._inside.add(run)
            return True

    async def enter_async(self, run: object) -> None:
        """Wait in the event loop until the gate is open."""
        while True:
            with self._change:
                if not self._closers:
                    self._inside.add(run)
                    return
            await asyncio.sleep(_POLL)

    def leave(self, run: object) -> None:
        """Remove a run that has ended, or a stuck one that closers shall not wait for."""
        self._inside.discard(run)
        if self._closers:
            with self._change:
                self._change.notify_all()

    def close(self, closer: str) -> None:
        """Let no further run begin until ``closer`` opens the gate again."""
        with self._change:
            self._closers.add(closer)

    def wait_empty(self, timeout: float) -> bool:
        """Wait in a thread until no run is inside; false after ``timeout`` seconds."""
        with self._change:
            return self._change.wait_for(lambda: not self._inside, timeout)

    def open(self, closer: str) -> None:
        """Let runs begin again, unless another closer keeps the gate closed."""
        with self._change:
            self._closers.discard(closer)
            self._change.notify_all()
