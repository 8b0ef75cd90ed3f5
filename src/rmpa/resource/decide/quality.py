"""Quality as it was measured: of an output, an input, or an attribute of the user's own, a window at a time.

A message costs the same however many there were: sums, no samples. What a window cannot say (a period's deviation of
one message, a latency without a stamp) is left out of it, and then judged by nobody.
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Final

from rmpa.core.serial_number import SERIAL_HALF, SERIAL_MASK

if TYPE_CHECKING:
    from rmpa.resource.declare.attributes import Attribute, Value

_HEADER: Final = struct.Struct("<III")
_SECOND: Final = 1_000_000_000
_SOURCES: Final = 64
"""Publishers of one topic whose numbers are followed; with more of them all begin anew."""


class TopicQuality:
    """What is measured of one output or input.

    Args:
        now: Monotonic seconds.
        stamped: Whether its messages begin with a ``std_msgs/Header``.
        numbered: Whether that header's ``seq`` counts the messages of each source, as the client libraries let it.
        deadline: Seconds from one message to the next at the most, or ``None``.
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
        """Take one message.

        Args:
            raw: Its bytes, without the length.
            now: Monotonic seconds at which it left, or came.
            now_ns: The same by the wall clock, which its stamp is of.
            source: Who sent it: each publisher has its own numbers.
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
                self._follow(sequence, source)

    def _follow(self, sequence: int, source: str) -> None:
        before = self._sequences.get(source)
        if before is None and len(self._sequences) >= _SOURCES:
            self._sequences.clear()
        self._sequences[source] = sequence
        if before is not None:
            gap = sequence - before - 1 & SERIAL_MASK
            if gap < SERIAL_HALF:
                self._lost += gap

    def restart(self, now: float) -> None:
        """Another profile runs: a new window begins, without what was measured before."""
        self._began = now
        if self._last is not None:
            self._last = now  # the pause between the two is nobody's period
        self._clear()

    def window(self, now: float) -> dict[str, Value]:
        """What was measured since the last window, by the names of ``attributes.MEASURED``; a new window begins."""
        span = max(now - self._began, 1e-9)
        silent = now - (self._last if self._last is not None else self._began)
        found: dict[str, Value] = {"bandwidth": self._bytes / span}
        # Until the next message comes the period is at least the silence so far: a source that stops is slow at once.
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
    """An attribute of the user's own: the mean of a window's observations, or its last word.

    Without a new observation the last window's value stands: a battery's charge is not unknown because nobody looked.
    But under another profile nothing is known before it is observed anew.
    """

    def __init__(self, attribute: Attribute) -> None:
        self._attribute = attribute
        self.restart()

    def restart(self) -> None:
        """Another profile runs: what was observed before says nothing of it."""
        self._sum = 0.0
        self._count = 0
        self._value: Value | None = None

    def observe(self, value: Value) -> None:
        """Take one observation, checked already."""
        if isinstance(value, str):
            self._value = value
        else:
            self._sum += value
            self._count += 1

    def window(self) -> Value | None:
        """The window's value, or ``None`` if nothing was ever observed; a new window begins."""
        if self._count:
            self._value = self._sum / self._count
            self._sum, self._count = 0.0, 0
        return self._value
