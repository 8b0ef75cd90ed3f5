"""Runs the timer of a protocol machine in the event loop.

A machine has no clock: its ``next_timer()`` returns when it must be called next, and the call passes the time.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class MachineTimer:
    """One pending timer for one machine, moved whenever the machine's ``next_timer()`` has changed.

    Args:
        next_timer: Returns when the machine must be called, in seconds of ``now``; ``None``: not at all.
        on_due: Called with the time, which is never before the requested time, although the event loop may call early
            by its clock's resolution. Afterwards the timer is armed again.
        now: The clock of the machine; by default the event loop's ``time()``.
    """

    def __init__(
        self,
        next_timer: Callable[[], float | None],
        on_due: Callable[[float], object],
        *,
        now: Callable[[], float] | None = None,
    ) -> None:
        self._next_timer = next_timer
        self._on_due = on_due
        self._now = now
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
            loop = asyncio.get_running_loop()
            self._due = due
            if self._now is None:
                self._handle = loop.call_at(due, self._fire)
            else:
                self._handle = loop.call_later(max(0.0, due - self._now()), self._fire)

    def close(self) -> None:
        """Cancel the timer, and drop the references to the machine, whose owner may hold this timer (a cycle)."""
        self._closed = True
        self._cancel()
        self._next_timer, self._on_due = _never, _nothing

    def _cancel(self) -> None:
        self._due = None
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def _fire(self) -> None:
        due, self._due, self._handle = self._due, None, None
        now = asyncio.get_running_loop().time() if self._now is None else self._now()
        self._on_due(now if due is None else max(due, now))
        self.arm()


def _never() -> float | None:
    """The ``next_timer()`` of a timer that is closed."""
    return None


def _nothing(_now: float) -> None:
    """The ``on_due`` of a timer that is closed."""
