"""Watches whether the messages of one remote source keep their contract: deadline, lifespan, liveliness, loss.

The data path only assigns the time of the last message to ``QosWatch.last``; all else happens when the timer is due.
The timer is due one deadline after the last message that it has seen. A message that came since then was in time, so
no gap is overlooked.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.core.contract import Liveliness

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.contract import Contract


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
