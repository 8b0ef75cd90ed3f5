"""How well one remote source arrives: periods, one-way latency and sizes, from rings of fixed size.

The data path only notes three numbers a message; everything else is worked out when somebody asks.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass
from operator import sub
from typing import Final, TypeVar

from rmpa.core import limits
from rmpa.core.stats import Summary

_NS: Final = 1e-9
_Number = TypeVar("_Number", int, float)


@dataclass(frozen=True, slots=True)
class QualitySummary:
    """What arrived of one source lately; seconds, messages and bytes.

    Args:
        latency: From the publisher's agent taking a message to it being handed on here; ``None`` where the other
            side's clock is unknown, or nothing came.
        latency_last: The last message's.
        latency_error: The true latencies lie within ± this.
        period: Between messages.
        jitter: The period's 99th percentile less its median; ``nan`` before the third message.
        rate: Messages a second; a silence longer than every period counts, so the rate of a dead source falls.
        bandwidth: Bytes a second, over the same time.
        age: Since the last message; ``None`` if none came.
        messages: Ever.
        bytes: Ever.
    """

    latency: Summary | None
    latency_last: float | None
    latency_error: float | None
    period: Summary
    jitter: float
    rate: float
    bandwidth: float
    age: float | None
    messages: int
    bytes: int


class Quality:
    """The last arrivals of one route; noting one costs the same however many there were.

    Args:
        window: How many messages are remembered: a power of two.

    Raises:
        ValueError: ``window`` is not one.
    """

    __slots__ = ("_clock", "_delays", "_mask", "_sizes", "_times", "_trusted_from", "bytes", "messages")

    def __init__(self, window: int = limits.QUALITY_WINDOW) -> None:
        if window < 2 or window & (window - 1):
            raise ValueError(f"the window must be a power of two from 2 on, not {window}")
        self._mask = window - 1  # a bit mask is the cheapest way round a ring
        self._times = array("d", bytes(8 * window))
        self._delays = array("d", bytes(8 * window))
        self._sizes = array("I", bytes(4 * window))
        self._trusted_from = -math.inf
        self._clock: tuple[float, float, float] | None = None
        self.messages = 0
        """Ever arrived."""
        self.bytes = 0
        """In all of them."""

    def arrived(self, now: float, wall_ns: int, stamp_ns: int, size: int) -> None:
        """Note one message.

        Args:
            now: Monotonic seconds.
            wall_ns: Our wall clock.
            stamp_ns: The other agent's wall clock when the message came from its publisher.
            size: Bytes, below 4 GiB.
        """
        number = self.messages
        slot = number & self._mask
        self._times[slot] = now
        self._delays[slot] = wall_ns - stamp_ns
        self._sizes[slot] = size
        self.messages = number + 1
        self.bytes += size

    @property
    def last(self) -> float | None:
        """When the last message came, in monotonic seconds; ``None`` if none did."""
        return self._times[self.messages - 1 & self._mask] if self.messages else None

    def clock(self, offset: float, error: float, now: float) -> None:
        """Hear what the other side's clock is now: if that contradicts what it was, a clock was set.

        Latencies from before are then forgotten: they would be wrong by as much as the clock was set. To be told
        every second or so, that this is noticed soon.

        Args:
            offset: The other side's wall clock less ours, seconds.
            error: Its bound, ± seconds.
            now: Monotonic seconds.
        """
        if self._clock is not None:
            old, old_error, then = self._clock
            if abs(offset - old) > error + old_error + limits.CLOCK_DRIFT * (now - then):
                self._trusted_from = now
        self._clock = (offset, error, now)

    def summary(
        self, offset: float | None, error: float | None, now: float, *, latching: bool = False
    ) -> QualitySummary:
        """What the messages of the last ``limits.QUALITY_SPAN`` say, as far as the ring remembers them.

        Args:
            offset: The other side's wall clock less ours in seconds, or ``None`` while it is unknown.
            error: Its bound, ± seconds.
            now: Monotonic seconds.
            latching: Whether the route's first message was a stored one, whose age is no latency.
        """
        times = self._recent(now)
        periods = list(map(sub, times[1:], times))
        period = Summary.of(periods)
        silence = now - times[-1] if times else 0.0
        elapsed = times[-1] - times[0] if len(times) > 1 else 0.0
        if periods and silence > period.maximum:
            elapsed += silence
        sizes = self._latest(self._sizes, len(periods))
        latencies, latency_error = self._latencies(times, offset, error, now, latching=latching)
        return QualitySummary(
            latency=Summary.of(latencies) if latencies else None,
            latency_last=latencies[-1] if latencies else None,
            latency_error=latency_error,
            period=period,
            jitter=period.p99 - period.p50 if period.count > 1 else math.nan,
            rate=len(periods) / elapsed if elapsed > 0 else math.nan,
            bandwidth=sum(sizes) / elapsed if elapsed > 0 else math.nan,
            age=silence if times else None,
            messages=self.messages,
            bytes=self.bytes,
        )

    def _recent(self, now: float) -> array[float]:
        """When the messages of the span came, oldest first; the last one in any case."""
        times = self._latest(self._times, self.messages)
        since = now - limits.QUALITY_SPAN
        if times and times[0] < since:
            first = next((at for at, time in enumerate(times) if time >= since), len(times) - 1)
            return times[first:]
        return times

    def _latencies(
        self, times: array[float], offset: float | None, error: float | None, now: float, *, latching: bool
    ) -> tuple[list[float], float | None]:
        """The latencies that can be told, oldest first, and their bound."""
        if offset is None or error is None:
            return [], None
        self.clock(offset, error, now)
        count = sum(time >= self._trusted_from for time in times)
        if latching and count == self.messages:
            count -= 1
        if count <= 0:
            return [], None
        delays = self._latest(self._delays, count)
        # Since the oldest of them came, the clocks may have drifted apart by so much.
        return [delay * _NS + offset for delay in delays], error + limits.CLOCK_DRIFT * (now - times[-count])

    def _latest(self, ring: array[_Number], count: int) -> array[_Number]:
        """The last ``count`` samples of a ring, oldest first."""
        count = min(count, self.messages, len(ring))
        end = self.messages & self._mask
        if count <= end:
            return ring[end - count : end]
        return ring[end - count :] + ring[:end]
