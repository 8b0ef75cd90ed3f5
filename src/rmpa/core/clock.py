"""Time is an argument: protocol machines get ``now`` and never read a clock.

``now`` is seconds (float) of a monotonic clock with an arbitrary zero; stamps on the wire are nanoseconds (int) of
the sender's wall clock.
"""

from __future__ import annotations

from typing import Protocol


class Clock(Protocol):
    """A source of time for the I/O parts; tests pass a simulated one."""

    def now(self) -> float:
        """Monotonic seconds."""
        ...

    def wall_ns(self) -> int:
        """Wall clock, in nanoseconds since the epoch."""
        ...


def earliest(*timers: float | None) -> float | None:
    """The first of several timers; ``None`` means never."""
    first = None
    for timer in timers:
        if timer is not None and (first is None or timer < first):
            first = timer
    return first
