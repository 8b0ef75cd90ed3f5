"""Measures the quality of an output, an input, or a declared attribute, window by window.

Only sums are kept, so each message costs the same. Values that a window cannot determine (the standard deviation of a
single period, a latency without a stamp) are left out and not judged.
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Final

from rmpa.core.identity import SERIAL_HALF, SERIAL_MASK

if TYPE_CHECKING:
    from rmpa.resource.declare.attributes import Attribute, Value

_HEADER: Final = struct.Struct("<III")
_SECOND: Final = 1_000_000_000
_SOURCES: Final = 64
"""Number of publishers of one topic whose sequence numbers are tracked; one more, and the tracking starts afresh."""


class TopicQuality:
    """Measures one output or input.

    Args:
        now: Beginning of the first window, in monotonic seconds.
        stamped: Whether the messages begin with a ``std_msgs/Header``.
        numbered: Whether that header's ``seq`` counts the messages of each source, as client libraries set it.
        deadline: The contract's deadline: longest time between two messages in seconds; ``None``: no deadline.
    """

    def __init__(
        self, now: float, *, stamped: bool = False, numbered: bool = False, deadline: float | None = None
    ) -> None:
        self._stamped = stamped
        self._numbered = stamped and numbered
        self._deadline = deadline
        self._began = now
        self._last: float | None = None
        self._last_age = math.nan
        self._sequences: dict[str, int] = {}
        self._clear()

    def _clear(self) -> None:
        self._count = 0
        self._periods = 0
        self._sum = 0.0
        self._squares = 0.0
        self._missed = 0
        self._latency = 0.0
        self._stamps = 0
        self._bytes = 0
        self._lost = 0

    def message(self, raw: bytes | memoryview, now: float, now_ns: int, source: str = "") -> None:
        """Measure one message.

        Args:
            raw: The serialized message, without the length prefix.
            now: When it was sent or received, in monotonic seconds.
            now_ns: The same moment by the wall clock (Unix nanoseconds), to which the message's stamp refers.
            source: Name of the publisher; each has its own sequence numbers.
        """
        last, self._last = self._last, now
        if last is not None:
            period = now - last
            self._periods += 1
            self._sum += period
            self._squares += period * period
            if self._deadline is not None and period > self._deadline:
                self._missed += 1
        self._count += 1
        self._bytes += len(raw)
        if self._stamped and len(raw) >= _HEADER.size:
            sequence, seconds, nanoseconds = _HEADER.unpack_from(raw)
            if seconds or nanoseconds:
                self._last_age = (now_ns - seconds * _SECOND - nanoseconds) / _SECOND
                self._latency += self._last_age
                self._stamps += 1
            if self._numbered:
                self._count_lost(sequence, source)

    def _count_lost(self, sequence: int, source: str) -> None:
        before = self._sequences.get(source)
        if before is None and len(self._sequences) >= _SOURCES:
            self._sequences.clear()
        self._sequences[source] = sequence
        if before is not None:
            gap = sequence - before - 1 & SERIAL_MASK
            if gap < SERIAL_HALF:
                self._lost += gap

    def restart(self, now: float) -> None:
        """Discard the measurements so far and begin a new window, because another profile runs."""
        self._began = now
        if self._last is not None:
            self._last = now  # the time from one profile to the other is no period
        self._clear()

    def window(self, now: float) -> dict[str, Value]:
        """End the window and return its values by attribute (``attributes.MEASURED``)."""
        span = max(now - self._began, 1e-9)
        silent = now - (self._last if self._last is not None else self._began)
        found: dict[str, Value] = {"bandwidth": self._bytes / span}
        # The present period is at least as long as the silence so far, so the rate falls as soon as a source stops.
        mean = self._sum / self._periods if self._periods else math.inf
        if self._last is None:
            found["rate"] = 0.0
        elif mean < math.inf or silent > 0:
            found["rate"] = 1 / max(mean, silent) if mean < math.inf else 1 / silent
        if self._periods > 1:
            found["period_sd"] = math.sqrt(max(0.0, self._squares / self._periods - mean * mean))
        if self._stamps:
            found["latency"] = max(0.0, self._latency / self._stamps)
        if self._last is not None:
            age = self._last_age if not math.isnan(self._last_age) else 0.0
            found["age"] = max(0.0, age + silent)
        if self._deadline is not None and self._last is not None:
            overdue = silent > self._deadline
            judged = self._periods + overdue
            if judged:
                found["deadline_misses"] = (self._missed + overdue) / judged
        if self._numbered and self._count:
            found["loss"] = self._lost / (self._lost + self._count)
        self._began = now
        self._clear()
        return found


class ObservedQuality:
    """Measures a declared attribute: the mean of a window's observations, or the last observed word.

    Without a new observation the value of the last window stays valid: a battery's charge remains known between two
    readings. After a change of profile the attribute is unknown until it is observed again.
    """

    def __init__(self, attribute: Attribute) -> None:
        self._attribute = attribute
        self.restart()

    def restart(self) -> None:
        """Discard the value, because another profile runs."""
        self._sum = 0.0
        self._count = 0
        self._value: Value | None = None

    def observe(self, value: Value) -> None:
        """Record one observation, which must be a valid value of the attribute."""
        if isinstance(value, str):
            self._value = value
        else:
            self._sum += value
            self._count += 1

    def window(self) -> Value | None:
        """End the window and return its value; ``None`` without any observation under the present profile."""
        if self._count:
            self._value = self._sum / self._count
            self._sum, self._count = 0.0, 0
        return self._value
