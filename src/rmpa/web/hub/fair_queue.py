"""The messages that wait for one client: a queue for each subscription, bounded in bytes, served in turn. No I/O.

Higher priorities go first; the subscriptions of one priority take turns, a message each, so that a map does not hold
up commands. Beyond a bound the oldest message of the subscription with the most bytes is dropped, of the lowest
priority first. Handle 0 is for all that is no message of a subscription: it goes before all else and is never
dropped; a client that lets it grow beyond the bound does not read at all, and is to be disconnected (``overflow``).
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Generic, TypeVar

from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Mapping

_T = TypeVar("_T")


@dataclass(slots=True)
class _Queue(Generic[_T]):
    handle: int
    priority: int
    entries: deque[tuple[_T, int]] = field(default_factory=deque)
    size: int = 0


class FairQueue(Generic[_T]):
    """The queues of one client.

    Args:
        total_bytes: Bytes of all entries together. One message always fits where no other waits.
        subscription_bytes: Bytes of one subscription; its newest message always fits.
    """

    def __init__(
        self,
        total_bytes: int = limits.CLIENT_QUEUE_BYTES,
        subscription_bytes: int = limits.SUBSCRIPTION_QUEUE_BYTES,
    ) -> None:
        self._total = total_bytes
        self._each = subscription_bytes
        self._urgent: deque[tuple[_T, int]] = deque()
        self._urgent_bytes = 0
        self._data_bytes = 0
        self._queues: dict[int, _Queue[_T]] = {}
        self._turns: dict[int, deque[_Queue[_T]]] = {}
        """The subscriptions that have entries, by priority, in the order of their turns."""
        self.dropped: Counter[int] = Counter()
        """Messages dropped so far, by handle, of the present subscriptions."""
        self.dropped_total = 0
        """Messages dropped so far, those of ended subscriptions included."""

    def __bool__(self) -> bool:
        """Whether there is anything to send."""
        return bool(self._urgent or self._turns)

    @property
    def bytes(self) -> int:
        """Bytes that wait."""
        return self._urgent_bytes + self._data_bytes

    @property
    def overflow(self) -> bool:
        """Whether the entries of handle 0 alone exceed the bound."""
        return self._urgent_bytes > self._total

    @property
    def waiting(self) -> Mapping[int, int]:
        """Messages that wait, by handle."""
        return {queue.handle: len(queue.entries) for queue in self._queues.values() if queue.entries}

    def push(self, handle: int, entry: _T, size: int, priority: int = 0) -> int:
        """Add an entry; returns the number of older ones that were dropped for it.

        Args:
            handle: The subscription; 0 for an entry that is never dropped.
            entry: What is to be sent.
            size: Its bytes.
            priority: Of the subscription; a higher one is served first.
        """
        if handle == 0:
            self._urgent.append((entry, size))
            self._urgent_bytes += size
            return self._make_room(None)
        queue = self._queues.get(handle)
        if queue is None:
            queue = self._queues[handle] = _Queue(handle, priority)
        if not queue.entries:
            queue.priority = priority
            self._turns.setdefault(priority, deque()).append(queue)
        queue.entries.append((entry, size))
        queue.size += size
        self._data_bytes += size
        dropped = 0
        while queue.size > self._each and len(queue.entries) > 1:
            self._drop_oldest(queue)
            dropped += 1
        return dropped + self._make_room(queue)

    def pop(self) -> _T | None:
        """The next entry; ``None`` where there is none."""
        if self._urgent:
            entry, size = self._urgent.popleft()
            self._urgent_bytes -= size
            return entry
        if not self._turns:
            return None
        priority = max(self._turns)
        turns = self._turns[priority]
        queue = turns.popleft()
        entry, size = queue.entries.popleft()
        queue.size -= size
        self._data_bytes -= size
        if queue.entries:
            turns.append(queue)
        elif not turns:
            del self._turns[priority]
        return entry

    def end(self, handle: int) -> None:
        """Forget a subscription, and what waits for it."""
        self.dropped.pop(handle, None)
        queue = self._queues.pop(handle, None)
        if queue is not None and queue.entries:
            self._data_bytes -= queue.size
            self._forget_turn(queue)

    def clear(self) -> None:
        """Forget everything that waits."""
        self._urgent.clear()
        self._turns.clear()
        self._queues.clear()
        self._urgent_bytes = self._data_bytes = 0

    # --- inside -----------------------------------------------------------------------------------------------

    def _make_room(self, newest: _Queue[_T] | None) -> int:
        """Drop until all together fit; the newest message stays where it is the only one."""
        dropped = 0
        while self.bytes > self._total and self._turns:
            turns = self._turns[min(self._turns)]
            fullest = max(turns, key=lambda queue: queue.size)
            if fullest is newest and len(fullest.entries) == 1:
                if len(self._turns) == 1 and len(turns) == 1 and not self._urgent:
                    break
                # Others of the same or a higher priority wait: the newest gives way if it alone has this priority.
                others = [queue for queue in turns if queue is not newest]
                fullest = max(others, key=lambda queue: queue.size) if others else fullest
            self._drop_oldest(fullest)
            dropped += 1
        return dropped

    def _drop_oldest(self, queue: _Queue[_T]) -> None:
        _, size = queue.entries.popleft()
        queue.size -= size
        self._data_bytes -= size
        self.dropped[queue.handle] += 1
        self.dropped_total += 1
        if not queue.entries:
            self._forget_turn(queue)

    def _forget_turn(self, queue: _Queue[_T]) -> None:
        turns = self._turns[queue.priority]
        turns.remove(queue)
        if not turns:
            del self._turns[queue.priority]
