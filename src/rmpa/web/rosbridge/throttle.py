"""Holds back the messages of one topic for one client: ``throttle_rate`` and ``queue_length``.

Without a queue, messages within the interval are dropped. With one they wait, the oldest is dropped when it is full,
and one is sent in each interval.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from rmpa.web.rosbridge import limits

if TYPE_CHECKING:
    from rmpa.web.hub.requests import ReceivedMessage


class QueuedBytes:
    """Bytes queued for all topics of a client together."""

    def __init__(self) -> None:
        self.used = 0


class Throttle:
    """The machine of one topic.

    Args:
        total: Bytes queued for all topics of the client.
    """

    def __init__(self, total: QueuedBytes) -> None:
        self.interval = 0.0
        self.length = 0
        self._total = total
        self._queue: deque[ReceivedMessage] = deque()
        self._bytes = 0
        self._free_at = float("-inf")

    def configure(self, interval: float, length: int) -> None:
        """Set the interval in seconds and the queue's length in messages; what is queued stays, as far as it fits."""
        self._free_at += interval - self.interval
        self.interval = interval
        self.length = min(length, limits.QUEUE_MESSAGES_MAX)
        while len(self._queue) > self.length:
            self._drop_oldest()

    def offer(self, message: ReceivedMessage, now: float) -> list[ReceivedMessage]:
        """Take a message; returns those to be sent now."""
        if not self._queue and now >= self._free_at:
            self._free_at = now + self.interval
            return [message]
        if not self.length:
            return []
        size = len(message.payload)
        while self._queue and (len(self._queue) >= self.length or self._bytes + size > limits.QUEUE_BYTES_MAX):
            self._drop_oldest()
        if not self._total.used or self._total.used + size <= limits.QUEUES_BYTES_MAX:
            self._queue.append(message)
            self._count(size)
        return self.due(now)

    def due(self, now: float) -> list[ReceivedMessage]:
        """The messages whose time has come: all where there is no interval any more."""
        sent: list[ReceivedMessage] = []
        while self._queue and now >= self._free_at:
            message = self._queue.popleft()
            self._count(-len(message.payload))
            sent.append(message)
            self._free_at = now + self.interval
        return sent

    def next_timer(self) -> float | None:
        """When `due` has something; None for never."""
        return self._free_at if self._queue else None

    def clear(self) -> None:
        """Drop all that is queued; the client no longer wants it."""
        self._count(-self._bytes)
        self._queue.clear()

    def _drop_oldest(self) -> None:
        self._count(-len(self._queue.popleft().payload))

    def _count(self, size: int) -> None:
        self._bytes += size
        self._total.used += size
