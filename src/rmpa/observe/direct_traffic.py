"""Rate, bandwidth and counts of a direct connection, from readings of a node's ``getBusStats``. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.sizes import INT32_MAX, UINT32_MAX
from rmpa.observe import limits
from rmpa.observe.snapshot import DirectFigures

if TYPE_CHECKING:
    from rmpa.ros.wire.bus import BusLink, BusTraffic

_MODULUS: Final = UINT32_MAX + 1


@dataclass(frozen=True, slots=True)
class _Reading:
    """The counts at one moment, monotonic seconds; they go on growing where the node's own wrap at 2**32."""

    now: float
    bytes: int
    messages: int | None


class TrafficMeter:
    """The readings of one connection over the last ``limits.DIRECT_SAMPLES`` looks.

    A node's counts begin anew with each connection, and wrap at 2**32. A count that has fallen by less than half of
    that, or another connection, is a new beginning; what fell further has wrapped.
    """

    def __init__(self) -> None:
        self._readings: deque[_Reading] = deque(maxlen=limits.DIRECT_SAMPLES)
        self._last: BusTraffic | None = None
        self._connection: tuple[int, int | None] | None = None

    @property
    def measured(self) -> bool:
        """Whether there are two readings, which a rate needs."""
        return len(self._readings) > 1

    def take(self, link: BusLink, traffic: BusTraffic, now: float) -> None:
        """Take a reading.

        Args:
            link: The connection.
            traffic: Its counts.
            now: When they were read, monotonic seconds.
        """
        connection = (link.number, link.local_port)
        last, self._last = self._last, traffic
        more = _grown(last.bytes, traffic.bytes) if last is not None and connection == self._connection else None
        count = None
        if last is not None and last.messages is not None and traffic.messages is not None:
            count = _grown(last.messages, traffic.messages)
            more = more if count is not None else None
        if more is None or not self._readings:
            self._connection = connection
            self._readings.clear()
            self._readings.append(_Reading(now, traffic.bytes, traffic.messages))
            return
        before = self._readings[-1]
        messages = before.messages + count if before.messages is not None and count is not None else None
        self._readings.append(_Reading(now, before.bytes + more, messages))

    def figures(self) -> DirectFigures | None:
        """The figures; ``None`` without a reading."""
        if not self._readings or self._last is None:
            return None
        first, last = self._readings[0], self._readings[-1]
        window = last.now - first.now
        counted = first.messages is not None and last.messages is not None
        return DirectFigures(
            messages=last.messages,
            bytes=last.bytes,
            dropped=self._last.dropped,
            rate=(last.messages - first.messages) / window if counted and window > 0 else None,  # type: ignore[operator]
            bandwidth=(last.bytes - first.bytes) / window if window > 0 else None,
            window=window,
        )


def _grown(before: int, after: int) -> int | None:
    """How far a count of 32 bits has grown; ``None`` if it has fallen, and so begun anew."""
    more = (after - before) % _MODULUS
    return more if more <= INT32_MAX else None
