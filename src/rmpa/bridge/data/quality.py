"""Statistics of one remote source's arrivals: periods, one-way latencies and sizes, from rings of fixed size.

The data path stores only three numbers for each message; everything else is computed on request. At thousands of
messages a second, a ring holds only some milliseconds: the rate of one burst, not of the source. Therefore each turn
of the ring leaves a mark (time, messages, bytes), and rate and bandwidth are counted from a mark a second ago.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass
from operator import sub
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from rmpa.bridge import limits
from rmpa.core.counters import SampleSummary
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from rmpa.bridge.data.peer_clock import PeerClockHistory

_NS: Final = 1e-9
_MARKS: Final = 16
"""Marks in ``limits.QUALITY_RATE_SPAN``."""
_Number = TypeVar("_Number", int, float)


class _Mark(NamedTuple):
    """When a message came, and how many messages and bytes had come up to it."""

    time: float
    messages: int
    bytes: int


@dataclass(frozen=True, slots=True)
class QualitySummary:
    """The recent arrivals of one source; seconds, messages and bytes.

    Args:
        latency: From the arrival of a message at the publisher's agent to its delivery here; ``None`` where the
            peer's clock is unknown, or nothing came.
        latency_last: The latency of the last message.
        latency_error: The true latencies lie within ± this.
        period: Between messages.
        jitter: The period's 99th percentile less its median; ``nan`` before the third message.
        rate: Messages a second, over what the ring holds and at least over the last second; a silence longer than
            every period counts, so the rate of a dead source falls.
        bandwidth: Bytes a second, over the same time.
        age: Since the last message; ``None`` if none came.
        messages: Since the route was opened.
        bytes: Since the route was opened.
    """

    latency: SampleSummary | None
    latency_last: float | None
    latency_error: float | None
    period: SampleSummary
    jitter: float
    rate: float
    bandwidth: float
    age: float | None
    messages: int
    bytes: int


class Quality:
    """The last arrivals of one route; storing one takes the same time however many there were.

    Args:
        window: How many messages the rings hold: a power of two.

    Raises:
        ValueError: ``window`` is not one.
    """

    __slots__ = ("_before", "_delays", "_marks", "_sizes", "_slot", "_times", "bytes")

    def __init__(self, window: int = limits.QUALITY_WINDOW) -> None:
        if window < 2 or window & (window - 1):
            raise ValueError(f"the window must be a power of two from 2 on, not {window}")
        self._slot = 0
        self._before = 0  # messages of all turns of the ring before this one
        # The ends of turns, oldest first, at most one in each of the ``_MARKS`` parts of the span.
        self._marks: deque[_Mark] = deque(maxlen=_MARKS + 2)
        self._times = array("d", bytes(8 * window))
        self._delays = array("d", bytes(8 * window))
        self._sizes = array("I", bytes(4 * window))
        self.bytes = 0
        """Bytes of all messages that arrived."""

    @property
    def messages(self) -> int:
        """Messages that arrived."""
        return self._before + self._slot

    def arrived(self, now: float, wall_ns: int, stamp_ns: int, size: int) -> None:
        """Store the arrival of one message.

        Args:
            now: Monotonic seconds.
            wall_ns: The local wall clock.
            stamp_ns: The wall clock of the publisher's agent when the message came from its publisher.
            size: Bytes, below 4 GiB.
        """
        slot = self._slot
        try:
            self._times[slot] = now
        except IndexError:  # once a turn; a comparison would cost time for each message
            slot = self._turn(now)
        self._delays[slot] = wall_ns - stamp_ns
        self._sizes[slot] = size
        self._slot = slot + 1
        self.bytes += size

    def _turn(self, now: float) -> int:
        """Mark where the counts stand, and begin at the first slot of the rings again."""
        window = len(self._times)
        if not self._marks:
            self._marks.append(_Mark(self._times[0], 1, self._sizes[0]))  # the very first message
        self._before += window
        if now - self._marks[-1].time >= limits.QUALITY_RATE_SPAN / _MARKS:
            # The last message of the turn; its size is already in ``bytes``.
            self._marks.append(_Mark(self._times[-1], self._before, self.bytes))
        self._times[0] = now
        self._slot = 0
        return 0

    @property
    def last(self) -> float | None:
        """When the last message came, in monotonic seconds; ``None`` if none did."""
        return self._times[self._slot - 1] if self.messages else None

    def summary(self, clock: PeerClockHistory | None, now: float, *, latching: bool = False) -> QualitySummary:
        """Summarize the messages of the last ``limits.QUALITY_SPAN``, as far as the rings hold them.

        Args:
            clock: The peer's clock, if it is known.
            now: Monotonic seconds.
            latching: Whether the route's first message was a kept one, whose age is no latency.
        """
        times = self._recent(now)
        periods = list(map(sub, times[1:], times))
        period = SampleSummary.of(periods)
        silence = now - times[-1] if times else 0.0
        count, size, elapsed = self._counted(times, now)
        if periods and silence > max(period.maximum, limits.QUALITY_SILENCE):
            elapsed += silence
        latencies, error = self._latencies(times, clock, latching=latching) if clock is not None else ([], 0.0)
        return QualitySummary(
            latency=SampleSummary.of(latencies) if latencies else None,
            latency_last=latencies[-1] if latencies else None,
            latency_error=error if latencies else None,
            period=period,
            jitter=period.p99 - period.p50 if period.count > 1 else math.nan,
            rate=count / elapsed if elapsed > 0 else math.nan,
            bandwidth=size / elapsed if elapsed > 0 else math.nan,
            age=silence if times else None,
            messages=self.messages,
            bytes=self.bytes,
        )

    def _counted(self, times: array[float], now: float) -> tuple[int, int, float]:
        """Messages, bytes and seconds for rate and bandwidth; the time begins with a message that is not counted."""
        if len(times) < 2:
            return 0, 0, 0.0
        last, span = times[-1], limits.QUALITY_RATE_SPAN
        if last - times[0] < span and now - last < span:
            near = [mark for mark in self._marks if last - 2 * span <= mark.time < times[0]]
            mark = next((mark for mark in reversed(near) if mark.time <= last - span), near[0] if near else None)
            if mark is not None:
                return self.messages - mark.messages, self.bytes - mark.bytes, last - mark.time
        return len(times) - 1, sum(self._latest(self._sizes, len(times) - 1)), last - times[0]

    def _recent(self, now: float) -> array[float]:
        """Arrival times of the messages of the span, oldest first; the last one is always included."""
        times = self._latest(self._times, self.messages)
        since = now - limits.QUALITY_SPAN
        if times and times[0] < since:
            first = next((at for at, time in enumerate(times) if time >= since), len(times) - 1)
            return times[first:]
        return times

    def _latencies(
        self, times: array[float], clock: PeerClockHistory, *, latching: bool
    ) -> tuple[list[float], float]:
        """The known latencies, oldest first, and the bound of their errors.

        Each is corrected by the first estimate of the peer's clock after its arrival; the newest ones by the last.
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
            worst = max(worst, estimate.error + mesh_limits.CLOCK_DRIFT * apart)
            begin = end
        return found, worst

    def _latest(self, ring: array[_Number], count: int) -> array[_Number]:
        """The last ``count`` samples of a ring, oldest first."""
        count = min(count, self.messages, len(ring))
        end = self._slot
        if count <= end:
            return ring[end - count : end]
        return ring[end - count :] + ring[:end]
