"""Time as an argument: machines are told ``now`` and never ask.

``now`` is a float of seconds on a monotonic clock whose zero means nothing; stamps that cross the wire are
integers of nanoseconds on the sender's wall clock.
"""

from __future__ import annotations

from typing import Protocol


class Clock(Protocol):
    """What an ``aio`` part asks for the time; tests pass a simulated one."""

    def now(self) -> float:
        """Monotonic seconds."""
        ...

    def wall_ns(self) -> int:
        """Wall clock, in nanoseconds since the epoch."""
        ...


def earliest(*timers: float | None) -> float | None:
    """The first of several timers, where ``None`` is "never"."""
    return min((t for t in timers if t is not None), default=None)
