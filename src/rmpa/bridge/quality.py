"""How well one remote source arrives: periods, one-way latency and sizes, from rings of fixed size.

The data path only notes three numbers a message; everything else is worked out when somebody asks.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from operator import sub
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.core import limits
from rmpa.core.stats import Summary

if TYPE_CHECKING:
    from rmpa.bridge.peer_clock import PeerClock

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

    __slots__ = ("_delays", "_mask", "_sizes", "_times", "bytes", "messages")

    def __init__(self, window: int = limits.QUALITY_WINDOW) -> None:
        if window < 2 or window & (window - 1):
            raise ValueError(f"the window must be a power of two from 2 on, not {window}")
        self._mask = window - 1  # a bit mask is the cheapest way round a ring
        self._times = array("d", bytes(8 * window))
        self._delays = array("d", bytes(8 * window))
        self._sizes = array("I", bytes(4 * window))
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

    def summary(self, clock: PeerClock | None, now: float, *, latching: bool = False) -> QualitySummary:
        """What the messages of the last ``limits.QUALITY_SPAN`` say, as far as the ring remembers them.

        Args:
            clock: What is known of the other side's clock, if anything.
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
        latencies, error = self._latencies(times, clock, latching=latching) if clock is not None else ([], 0.0)
        return QualitySummary(
            latency=Summary.of(latencies) if latencies else None,
            latency_last=latencies[-1] if latencies else None,
            latency_error=error if latencies else None,
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

    def _latencies(self, times: array[float], clock: PeerClock, *, latching: bool) -> tuple[list[float], float]:
        """The latencies that can be told, oldest first, and the bound of their errors.

        Each by the first estimate of the other clock from its arrival on; the newest ones by the last.
        """
        delays = self._latest(self._delays, len(times))
        begin = bisect_left(times, clock.trusted_from)
        if latching and len(times) == self.messages:
            begin = max(begin, 1)
        estimates = list(clock)
        found: list[float] = []
        worst = 0.0
        for estimate in estimates:
            last = estimate is estimates[-1]
            end = len(times) if last else bisect_right(times, estimate.now)
            if begin >= end:
                continue
            found += [delay * _NS + estimate.offset for delay in delays[begin:end]]
            apart = max(abs(estimate.now - times[begin]), abs(estimate.now - times[end - 1]))
            worst = max(worst, estimate.error + limits.CLOCK_DRIFT * apart)
            begin = end
        return found, worst

    def _latest(self, ring: array[_Number], count: int) -> array[_Number]:
        """The last ``count`` samples of a ring, oldest first."""
        count = min(count, self.messages, len(ring))
        end = self.messages & self._mask
        if count <= end:
            return ring[end - count : end]
        return ring[end - count :] + ring[:end]
