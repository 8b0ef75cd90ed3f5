"""What is measured of a remote source: rate, period, jitter, latency by the peer's clock, and QoS events.

Each latency is corrected with the estimate of the peer's clock at its time.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from dataclasses import dataclass
from enum import StrEnum
from operator import sub
from typing import Final, NamedTuple, TypeVar

from rmpa.bridge import limits
from rmpa.core.contract import Contract, Liveliness
from rmpa.core.facts import LatencyInfo
from rmpa.core.statistics import SampleSpread
from rmpa.mesh import limits as mesh_limits
from rmpa.ros.wire.tcpros import LENGTH


class PeerClockHistory:
    """The estimates of one peer's clock over the last minute; ``add`` one about every second.

    An estimate that contradicts the one before shows that a clock was set: earlier estimates are void, and so are
    earlier latencies.

    Attributes:
        estimates: Oldest first: when it was made (monotonic seconds), the peer's wall clock less the local one, and
            its error (± seconds).
        trusted_from: Latencies of messages that came before this time (monotonic seconds) are unknown.
    """

    def __init__(self) -> None:
        self.estimates: deque[tuple[float, float, float]] = deque(maxlen=limits.QUALITY_CLOCKS)
        self.trusted_from = -math.inf

    def add(self, offset: float, error: float, now: float) -> None:
        """Add the present estimate; see ``estimates``."""
        estimate = (now, offset, error)
        if self.estimates:
            last = self.estimates[-1]
            if abs(offset - last[1]) > error + last[2] + mesh_limits.CLOCK_DRIFT * (now - last[0]):
                self.estimates.clear()
                self.trusted_from = now
            elif len(self.estimates) > 1 and now - self.estimates[-2][0] < limits.QUALITY_CLOCK_STEP:
                # Added more often than needed: keep the better one, or the ring would not last for a minute.
                self.estimates.pop()
                estimate = min(last, estimate, key=lambda each: each[2])
        self.estimates.append(estimate)


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
    """Watches whether one remote source keeps its contract: deadline, lifespan, liveliness, loss.

    The data path only assigns the time of the last message to ``last``; all else happens when the timer is due. That
    is one deadline after the last message that it has seen. A message that came since then was in time, so no gap is
    overlooked. Each call costs the same, whatever happened before it.

    The deadline, and the lease of ``manual_by_topic``, count from the start: a source that never sends misses both.

    Args:
        contract: The contract of the route.
        now: Monotonic seconds, as in all calls.
        past: The watch of the source's route before this one, whose events count on.

    Attributes:
        last: When the last message came (before the first one: the start), monotonic seconds; set by the data path.
        counts: The sum of the counts of each kind of event since the start.
        recent: The last events, oldest first; an event that repeats is kept once, with the sum of its counts.
    """

    def __init__(self, contract: Contract, now: float, past: QosWatch | None = None) -> None:
        self._contract = contract
        self.last = now
        self.counts: Counter[QosEventKind] = Counter(past.counts if past is not None else ())
        self.recent: deque[QosEvent] = deque(past.recent if past is not None else (), maxlen=limits.WATCH_RECENT)
        self._seen = now  # the message from which the present deadline counts
        self._missed = 0  # deadlines since then
        self._due = now + (contract.deadline or 0)
        self._down_since: float | None = None
        self._lost_since: float | None = None
        self._look = now  # when to look whether a lost source sends again

    def lost(self, count: int, now: float) -> QosEvent:
        """Record ``count`` messages (at least one) that never came, as a gap in the sequence or the peer shows."""
        return self._happened(QosEventKind.MESSAGES_LOST, count, "{} lost", now)

    def lost_unknown(self, why: str, now: float) -> QosEvent:
        """Record that an unknown number of messages may be lost; ``why`` is the reason."""
        return self._happened(QosEventKind.LOSS_UNKNOWN, 1, f"messages may be lost, not counted: {why}", now)

    def expired(self, count: int, now: float) -> QosEvent:
        """Record ``count`` messages (at least one) that were dropped after their lifespan."""
        lifespan = self._contract.lifespan
        text = "{} beyond the lifespan" + ("" if lifespan is None else f" of {shown_seconds(lifespan)}")
        return self._happened(QosEventKind.LIFESPAN_EXPIRED, count, text, now)

    def link_down(self, now: float) -> None:
        """The source's peer has no link; ``now`` is when, or when it was last heard. Changes ``next_timer``."""
        if self._down_since is None:
            self._down_since = now

    def link_up(self, now: float) -> list[QosEvent]:
        """The source's peer has a link again; return what has changed by that. Changes ``next_timer``."""
        self._down_since = None
        return self._judge_life(now)

    def link_gone(self, now: float) -> list[QosEvent]:
        """End the watch of a source that leaves the graph: if its link is down, its liveliness is lost at once."""
        lease = self._contract.liveliness_lease
        if self._down_since is None or lease is None:
            return []
        return self._judge_life(max(now, self._down_since + lease))

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due; ``None``: the contract has nothing to watch.

        Messages only postpone it, so a timer that is armed after each ``handle_timer`` is never too late.
        """
        deadline, lease, silent = self._contract.deadline, self._contract.liveliness_lease, self._silent_since()
        due = []
        if deadline is not None:
            due.append(self._due if self.last == self._seen else self.last + deadline)
        if lease is not None and silent is not None:
            if self._lost_since is None:
                due.append(silent + lease)
            elif self._contract.liveliness is Liveliness.MANUAL_BY_TOPIC:  # else only link_up brings it back
                due.append(self._look)
        return min(due, default=None)

    def handle_timer(self, now: float) -> list[QosEvent]:
        """Return what has happened: at most one event of a kind, with all deadlines missed since the last call."""
        return [*self._miss(now), *self._judge_life(now)]

    def _miss(self, now: float) -> list[QosEvent]:
        deadline = self._contract.deadline
        if deadline is None:
            return []
        if self.last != self._seen:
            self._seen, self._missed, self._due = self.last, 0, self.last + deadline
        if now < self._due:
            return []
        goes_on = self._missed > 0
        count = max(1, math.floor((now - self._seen) / deadline) - self._missed)
        self._missed += count
        self._due = self._seen + (self._missed + 1) * deadline
        if self._due <= now:  # rounded down above: a timer in the past would be handled for ever
            self._due = math.nextafter(now, math.inf)
        text = f"no message for {shown_seconds(now - self._seen)}; deadline {shown_seconds(deadline)}"
        return [self._happened(QosEventKind.DEADLINE_MISSED, count, text, now, goes_on=goes_on)]

    def _silent_since(self) -> float | None:
        """When the last sign of life came; ``None`` while the link itself is one."""
        return self.last if self._contract.liveliness is Liveliness.MANUAL_BY_TOPIC else self._down_since

    def _judge_life(self, now: float) -> list[QosEvent]:
        lease, silent = self._contract.liveliness_lease, self._silent_since()
        self._look = now + limits.WATCH_LOOK
        if lease is not None and silent is not None and now >= silent + lease:
            if self._lost_since is not None:
                return []
            self._lost_since = now
            sign = "message" if self._contract.liveliness is Liveliness.MANUAL_BY_TOPIC else "link"
            text = f"no {sign} for {shown_seconds(now - silent)}; lease {shown_seconds(lease)}"
            return [self._happened(QosEventKind.LIVELINESS_LOST, 1, text, now)]
        if self._lost_since is None:
            return []
        text, self._lost_since = f"alive again after {shown_seconds(now - self._lost_since)}", None
        return [self._happened(QosEventKind.LIVELINESS_RESTORED, 1, text, now)]

    def _happened(
        self, kind: QosEventKind, count: int, text: str, now: float, *, goes_on: bool | None = None
    ) -> QosEvent:
        """Count an event and remember it, joined with the event before if it ``goes_on``.

        ``None`` joins events of one kind that are no more than ``limits.WATCH_RUN`` apart. Braces in the text stand
        for the number of messages.
        """
        self.counts[kind] += count
        before = self.recent[-1] if self.recent else None
        whole = count
        if before is not None and before.kind is kind:
            joins = now - before.now <= limits.WATCH_RUN if goes_on is None else goes_on
            whole += self.recent.pop().count if joins else 0
        self.recent.append(QosEvent(kind, whole, text.format(_messages(whole)), now))
        return QosEvent(kind, count, text.format(_messages(count)), now)


def _messages(count: int) -> str:
    return "1 message" if count == 1 else f"{count} messages"


def shown_seconds(seconds: float) -> str:
    """A duration as text: ``200 ms``, ``12.5 s``."""
    if seconds < 1:
        return f"{round(seconds * 1e3, 1):g} ms"
    return f"{round(seconds, 2):.10g} s"


# Marks in ``limits.QUALITY_RATE_SPAN``.
_MARKS: Final = 16
_Number = TypeVar("_Number", int, float)


class QualitySummary(NamedTuple):
    """The recent arrivals of one source; seconds, messages and bytes without TCPROS's length fields.

    Args:
        latency: From the arrival of a message at the publisher's agent to its delivery here; ``None`` where the
            peer's clock is unknown, or nothing came.
        period: Between messages; ``None`` before the second one.
        jitter: The period's 99th percentile less its median; ``None`` before the third message.
        rate: Messages a second, over what the ring holds and at least over the last second; a silence longer than
            every period counts, so the rate of a dead source falls.
        bandwidth: Bytes a second, over the same time.
        age: Since the last message; ``None`` if none came.
        messages: Since the route was opened.
        bytes: Since the route was opened.
    """

    latency: LatencyInfo | None
    period: SampleSpread | None
    jitter: float | None
    rate: float | None
    bandwidth: float | None
    age: float | None
    messages: int
    bytes: int


class Quality:
    """The last arrivals of one route: periods, one-way latencies and sizes, in rings of fixed size.

    The data path stores only three numbers for each message; everything else is computed on request. At thousands of
    messages a second, a ring holds only some milliseconds: the rate of one burst, not of the source. Therefore each
    turn of the ring leaves a mark, and rate and bandwidth are counted from a mark a second ago.

    Args:
        window: How many messages the rings hold, at least 2.

    Attributes:
        bytes: Bytes of all messages that arrived.
    """

    __slots__ = ("_before", "_delays", "_marks", "_sizes", "_slot", "_times", "bytes")

    def __init__(self, window: int = limits.QUALITY_WINDOW) -> None:
        self._slot = 0
        self._before = 0  # messages of all turns of the ring before this one
        # Time, and messages and bytes up to it, of the ends of turns: oldest first, at most one in each of the
        # ``_MARKS`` parts of the span.
        self._marks: deque[tuple[float, int, int]] = deque(maxlen=_MARKS + 2)
        self._times = array("d", bytes(8 * window))
        self._delays = array("d", bytes(8 * window))
        self._sizes = array("I", bytes(4 * window))
        self.bytes = 0

    @property
    def messages(self) -> int:
        """Messages that arrived."""
        return self._before + self._slot

    @property
    def last_size(self) -> int:
        """Bytes of the last message; 0 if none arrived."""
        return self._sizes[self._slot - 1]

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
        if not self._marks:
            self._marks.append((self._times[0], 1, self._sizes[0]))  # the very first message
        self._before += len(self._times)
        if now - self._marks[-1][0] >= limits.QUALITY_RATE_SPAN / _MARKS:
            # The last message of the turn; its size is already in ``bytes``.
            self._marks.append((self._times[-1], self._before, self.bytes))
        self._times[0] = now
        self._slot = 0
        return 0

    def summary(self, clock: PeerClockHistory | None, now: float, *, latching: bool = False) -> QualitySummary:
        """Summarize the messages of the last ``limits.QUALITY_SPAN``, as far as the rings hold them.

        Args:
            clock: The peer's clock, if it is known.
            now: Monotonic seconds.
            latching: Whether the route's first message was a kept one, whose age is no latency.
        """
        times = self._latest(self._times, self.messages)
        times = times[bisect_left(times, now - limits.QUALITY_SPAN, 0, max(len(times) - 1, 0)) :]  # at least the last
        periods = list(map(sub, times[1:], times))
        period = SampleSpread.of(periods)
        silence = now - times[-1] if times else 0.0
        count, size, elapsed = self._counted(times, now)
        if periods and silence > max(period.max, limits.QUALITY_SILENCE):
            elapsed += silence
        latencies, error = self._latencies(times, clock, latching=latching) if clock is not None else ([], 0.0)
        return QualitySummary(
            latency=LatencyInfo.of(latencies, last=latencies[-1], error=error) if latencies else None,
            period=period if period.count else None,
            jitter=period.p99 - period.p50 if period.count > 1 else None,
            rate=count / elapsed if elapsed > 0 else None,
            bandwidth=(size - LENGTH.size * count) / elapsed if elapsed > 0 else None,
            age=silence if times else None,
            messages=self.messages,
            bytes=self.bytes - LENGTH.size * self.messages,
        )

    def _counted(self, times: array[float], now: float) -> tuple[int, int, float]:
        """Messages, bytes and seconds for rate and bandwidth; the time begins with a message that is not counted."""
        if len(times) < 2:
            return 0, 0, 0.0
        last, span = times[-1], limits.QUALITY_RATE_SPAN
        if last - times[0] < span and now - last < span:
            near = [mark for mark in self._marks if last - 2 * span <= mark[0] < times[0]]
            if near:
                time, messages, size = next((mark for mark in reversed(near) if mark[0] <= last - span), near[0])
                return self.messages - messages, self.bytes - size, last - time
        return len(times) - 1, sum(self._latest(self._sizes, len(times) - 1)), last - times[0]

    def _latencies(
        self, times: array[float], clock: PeerClockHistory, *, latching: bool
    ) -> tuple[list[float], float]:
        """The known latencies, oldest first, and the bound of their errors.

        Each is corrected by the first estimate of the peer's clock after its arrival; the newest ones by the last.
        """
        delays = self._latest(self._delays, len(times))
        begin = max(bisect_left(times, clock.trusted_from), int(latching and len(times) == self.messages))
        found: list[float] = []
        worst = 0.0
        for number, (made, offset, error) in enumerate(clock.estimates, 1):
            end = len(times) if number == len(clock.estimates) else bisect_right(times, made)
            if begin < end:
                found += [delay * 1e-9 + offset for delay in delays[begin:end]]
                apart = max(abs(made - times[begin]), abs(made - times[end - 1]))
                worst = max(worst, error + mesh_limits.CLOCK_DRIFT * apart)
                begin = end
        return found, worst

    def _latest(self, ring: array[_Number], count: int) -> array[_Number]:
        """The last ``count`` samples of a ring, oldest first."""
        count = min(count, self.messages, len(ring))
        end = self._slot
        return ring[end - count : end] if count <= end else ring[end - count :] + ring[:end]
