"""What is measured of a remote source: rate, period, jitter, latency by the peer's clock, and QoS events.

The offset of a peer's clock over the last minute; each latency is corrected with an estimate of its time.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from dataclasses import dataclass
from enum import StrEnum
from operator import sub
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from rmpa.bridge import limits
from rmpa.core.contract import Liveliness
from rmpa.core.counters import SampleSummary
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.core.contract import Contract


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """An estimate of the peer's clock at one moment.

    Args:
        now: The moment, monotonic seconds.
        offset: The peer's wall clock less the local one, seconds.
        error: The offset is true within ± this many seconds.
    """

    now: float
    offset: float
    error: float


class PeerClockHistory:
    """The estimates of one peer's clock over the last minute; ``add`` one about every second.

    An estimate that contradicts the one before shows that a clock was set: earlier estimates are void, and so are
    earlier latencies.
    """

    def __init__(self) -> None:
        self._estimates: deque[ClockEstimate] = deque(maxlen=limits.QUALITY_CLOCKS)
        self.trusted_from = -math.inf
        """Latencies of messages that came before this time (monotonic seconds) are unknown."""

    def __iter__(self) -> Iterator[ClockEstimate]:
        """Oldest first."""
        return iter(self._estimates)

    def add(self, offset: float, error: float, now: float) -> None:
        """Add the present estimate; see ``ClockEstimate``."""
        estimate = ClockEstimate(now, offset, error)
        if self._estimates:
            last = self._estimates[-1]
            bound = error + last.error + mesh_limits.CLOCK_DRIFT * (now - last.now)
            if abs(offset - last.offset) > bound:
                self._estimates.clear()
                self.trusted_from = now
            elif len(self._estimates) > 1 and now - self._estimates[-2].now < limits.QUALITY_CLOCK_STEP:
                # Added more often than needed: keep the better one, or the ring would not last for a minute.
                self._estimates.pop()
                estimate = min(last, estimate, key=lambda each: each.error)
        self._estimates.append(estimate)


# Watches whether the messages of one remote source keep their contract: deadline, lifespan, liveliness, loss.
#
# The data path only assigns the time of the last message to ``QosWatch.last``; all else happens when the timer is
# due.
# The timer is due one deadline after the last message that it has seen. A message that came since then was in
# time, so
# no gap is overlooked.


class QosEventKind(StrEnum):
    """The kinds of events of a contract, named after ROS 2's QoS events."""

    DEADLINE_MISSED = "deadline_missed"
    LIFESPAN_EXPIRED = "lifespan_expired"
    LIVELINESS_LOST = "liveliness_lost"
    LIVELINESS_RESTORED = "liveliness_restored"
    MESSAGES_LOST = "messages_lost"
    LOSS_UNKNOWN = "loss_unknown"


@dataclass(frozen=True, slots=True)
class QosEvent:
    """One event.

    Args:
        kind: What happened.
        count: How often it happened, or how many messages it concerns.
        text: The event, to show to a user.
        now: When it happened, or the last of several did; monotonic seconds.
    """

    kind: QosEventKind
    count: int
    text: str
    now: float


class QosWatch:
    """Watches one source. Each call costs the same, whatever happened before it.

    The deadline, and the lease of ``manual_by_topic``, count from the start: a source that never sends misses both.

    Args:
        contract: The contract of the route.
        now: Monotonic seconds, as in all calls.
    """

    __slots__ = (
        "_contract",
        "_down_since",
        "_due",
        "_look",
        "_lost_since",
        "_missed",
        "_seen",
        "_silent_at_loss",
        "counts",
        "last",
        "recent",
    )

    def __init__(self, contract: Contract, now: float) -> None:
        self._contract = contract
        self.last = now
        """When the last message came (before the first one: the start), monotonic seconds; set by the data path."""
        self.counts: Counter[QosEventKind] = Counter()
        """The sum of the counts of each kind of event since the start."""
        self.recent: deque[QosEvent] = deque(maxlen=limits.WATCH_RECENT)
        """The last events, oldest first; an event that repeats is kept once, with the sum of its counts."""
        self._seen = now  # the message from which the present deadline counts
        self._missed = 0  # deadlines since then
        self._due = now + (contract.deadline or 0)
        self._down_since: float | None = None
        self._lost_since: float | None = None
        self._silent_at_loss: float | None = None
        self._look = now

    @property
    def alive(self) -> bool:
        """Whether the source was alive at the last timer."""
        return self._lost_since is None

    def lost(self, count: int, now: float) -> QosEvent:
        """Record ``count`` messages (at least one) that never came, as a gap in the sequence or the peer shows."""
        return self._happened(QosEventKind.MESSAGES_LOST, count, lambda sum_: f"{_messages(sum_)} lost", now)

    def lost_unknown(self, why: str, now: float) -> QosEvent:
        """Record that an unknown number of messages may be lost; ``why`` is the reason."""
        return self._happened(
            QosEventKind.LOSS_UNKNOWN, 1, lambda _: f"messages may be lost, not counted: {why}", now
        )

    def expired(self, count: int, now: float) -> QosEvent:
        """Record ``count`` messages (at least one) that were dropped after their lifespan."""
        lifespan = self._contract.lifespan
        beyond = "beyond the lifespan" + ("" if lifespan is None else f" of {shown_seconds(lifespan)}")
        return self._happened(QosEventKind.LIFESPAN_EXPIRED, count, lambda sum_: f"{_messages(sum_)} {beyond}", now)

    def link_down(self, now: float) -> None:
        """The source's peer has no link; ``now`` is when, or when it was last heard. Changes ``next_timer``."""
        if self._down_since is None:
            self._down_since = now

    def link_up(self, now: float) -> None:
        """The source's peer has a link again; changes ``next_timer``."""
        self._down_since = None
        self._look = now

    def link_gone(self, now: float) -> list[QosEvent]:
        """End the watch of a source that leaves the graph: if its link is down, its liveliness is lost at once."""
        lease = self._contract.liveliness_lease
        if self._down_since is None or lease is None:
            return []
        occurred = self._judge_life(max(now, self._down_since + lease))
        return [] if occurred is None else [occurred]

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due; ``None``: the contract has nothing to watch.

        Messages only postpone it, so a timer that is armed after each ``handle_timer`` is never too late.
        """
        due = [time for time in (self._deadline_due(), self._liveliness_due()) if time is not None]
        return min(due) if due else None

    def handle_timer(self, now: float) -> list[QosEvent]:
        """Return what has happened: at most one event of a kind, with all deadlines missed since the last call."""
        found = [self._miss(now), self._judge_life(now)]
        return [event for event in found if event is not None]

    def _deadline_due(self) -> float | None:
        if self._contract.deadline is None:
            return None
        return self._due if self.last == self._seen else self.last + self._contract.deadline

    def _miss(self, now: float) -> QosEvent | None:
        deadline = self._contract.deadline
        if deadline is None:
            return None
        if self.last != self._seen:
            self._seen, self._missed, self._due = self.last, 0, self.last + deadline
        if now < self._due:
            return None
        goes_on = self._missed > 0
        count = max(1, math.floor((now - self._seen) / deadline) - self._missed)
        self._missed += count
        self._due = self._seen + (self._missed + 1) * deadline
        if self._due <= now:  # rounded down above: a timer in the past would be handled for ever
            self._due = math.nextafter(now, math.inf)
        text = f"no message for {shown_seconds(now - self._seen)}; deadline {shown_seconds(deadline)}"
        return self._happened(QosEventKind.DEADLINE_MISSED, count, lambda _: text, now, goes_on=goes_on)

    def _silent_since(self) -> float | None:
        """When the last sign of life came; ``None`` while the link itself is one."""
        return self.last if self._contract.liveliness is Liveliness.MANUAL_BY_TOPIC else self._down_since

    def _liveliness_due(self) -> float | None:
        lease, silent = self._contract.liveliness_lease, self._silent_since()
        if lease is None:
            return None
        if self._lost_since is None:
            return None if silent is None else silent + lease
        if self._contract.liveliness is Liveliness.AUTOMATIC and silent == self._silent_at_loss:
            return None  # only link_up can change that
        return self._look

    def _judge_life(self, now: float) -> QosEvent | None:
        lease, silent = self._contract.liveliness_lease, self._silent_since()
        if lease is None:
            return None
        self._look = now + limits.WATCH_LOOK
        silent_too_long = silent is not None and now >= silent + lease
        if self._lost_since is None:
            if silent is None or not silent_too_long:
                return None
            self._lost_since, self._silent_at_loss = now, silent
            sign = "message" if self._contract.liveliness is Liveliness.MANUAL_BY_TOPIC else "link"
            text = f"no {sign} for {shown_seconds(now - silent)}; lease {shown_seconds(lease)}"
            return self._happened(QosEventKind.LIVELINESS_LOST, 1, lambda _: text, now)
        if silent_too_long:
            self._silent_at_loss = silent
        if silent == self._silent_at_loss:
            return None
        text = f"alive again after {shown_seconds(now - self._lost_since)}"
        self._lost_since = None
        return self._happened(QosEventKind.LIVELINESS_RESTORED, 1, lambda _: text, now)

    def _happened(
        self, kind: QosEventKind, count: int, text: Callable[[int], str], now: float, *, goes_on: bool | None = None
    ) -> QosEvent:
        """Count an event and remember it, joined with the event before if it ``goes_on``.

        ``None`` joins events of one kind that are no more than ``limits.WATCH_RUN`` apart.
        """
        self.counts[kind] += count
        before = self.recent[-1] if self.recent else None
        whole = count
        if before is not None and before.kind is kind:
            if goes_on is None:
                goes_on = now - before.now <= limits.WATCH_RUN
            if goes_on:
                whole += before.count
                self.recent.pop()
        self.recent.append(QosEvent(kind, whole, text(whole), now))
        return QosEvent(kind, count, text(count), now)


def _messages(count: int) -> str:
    return "1 message" if count == 1 else f"{count} messages"


def shown_seconds(seconds: float) -> str:
    """A duration as text: ``200 ms``, ``12.5 s``."""
    if seconds < 1:
        return f"{round(seconds * 1e3, 1):g} ms"
    return f"{round(seconds, 2):.10g} s"


# Statistics of one remote source's arrivals: periods, one-way latencies and sizes, from rings of fixed size.
#
# The data path stores only three numbers for each message; everything else is computed on request. At thousands of
# messages a second, a ring holds only some milliseconds: the rate of one burst, not of the source. Therefore each
# turn
# of the ring leaves a mark (time, messages, bytes), and rate and bandwidth are counted from a mark a second ago.


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
