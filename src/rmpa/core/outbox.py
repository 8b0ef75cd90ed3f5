"""Bytes that wait for a slow socket: bounded, keep-last by key, drops counted.

Pure: no socket here. A driver pushes what it could not send at once, asks for ``head()`` when the socket is
writable again and tells how much of it was ``consumed()``.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Final

from rmpa.core.errors import LocalProtocolError

URGENT: Final = -1
"""The key of entries that are never dropped and go in front of the others."""

_DEAD_KEPT: Final = 64
"""Shells of dropped entries that may stay in the middle of the queue before it is swept."""


@dataclass(slots=True)
class _Entry:
    key: int
    data: bytes
    dropped: bool = False


@dataclass(slots=True)
class _Flow:
    entries: deque[_Entry]
    size: int = 0


class Outbox:
    """A bounded queue of byte strings, sent in order; beyond a bound the oldest is dropped.

    Too many entries of one key: the oldest of that key. Too many bytes: the oldest of whichever key holds the
    most, so that a flood of images does not push commands out. An entry that was sent in part is never dropped
    (half a message must not stay on the wire) and not counted against the bound, and one message always fits,
    however large: at most ``max(max_bytes, the newest entry)`` plus the entry half sent is held.

    Args:
        max_entries: Entries of one key that may wait, at least 1.
        max_bytes: Bytes that may wait over all keys but ``URGENT``.
    """

    def __init__(self, max_entries: int, max_bytes: int) -> None:
        self._max_entries = max_entries
        self._max_bytes = max_bytes
        self._urgent: deque[_Entry] = deque()
        self._queue: deque[_Entry] = deque()
        self._flows: dict[int, _Flow] = {}
        self._dead = 0
        self._started: _Entry | None = None
        self._offset = 0
        self._urgent_bytes = 0
        self._data_bytes = 0
        self.dropped: Counter[int] = Counter()
        """Entries dropped so far, by key."""

    def __bool__(self) -> bool:
        return bool(self._started or self._urgent or self._flows)

    def set_bounds(self, max_entries: int, max_bytes: int) -> None:
        """Change the bounds; they count from the next ``push()`` on. A subscriber's are known with its topic only."""
        self._max_entries = max_entries
        self._max_bytes = max_bytes

    @property
    def urgent_bytes(self) -> int:
        """Bytes of whole urgent entries that wait; they have no bound here, the owner watches this."""
        return self._urgent_bytes

    @property
    def pending_bytes(self) -> int:
        """Bytes that still wait, urgent ones and those of the entry half sent included."""
        started = len(self._started.data) - self._offset if self._started is not None else 0
        return started + self._urgent_bytes + self._data_bytes

    @property
    def pending_entries(self) -> int:
        """Entries that wait, urgent ones and the one half sent included."""
        return (self._started is not None) + len(self._urgent) + len(self._queue) - self._dead

    def push_urgent(self, data: bytes) -> None:
        """Queue control bytes: in front of all data but behind a message half sent."""
        if data:
            self._urgent.append(_Entry(URGENT, data))
            self._urgent_bytes += len(data)

    def push_rest(self, data: bytes, key: int) -> None:
        """Queue the rest of an entry whose first part the driver has sent: it goes first, and stays.

        Raises:
            LocalProtocolError: Something waits already; the driver sent out of turn.
        """
        if self:
            raise LocalProtocolError("a message was begun while others wait")
        if data:
            self._started = _Entry(key, data)
            self._offset = 0

    def push(self, data: bytes, key: int) -> int:
        """Queue one whole entry; return how many older ones, of any key, were dropped for it.

        An empty entry is nothing to send and not queued.
        """
        if not data:
            return 0
        dropped = 0
        size = len(data)
        flow = self._flows.get(key)
        if flow is None:
            flow = self._flows[key] = _Flow(deque())
        while len(flow.entries) >= self._max_entries:
            self._drop(flow)
            dropped += 1
        entry = _Entry(key, data)
        flow.entries.append(entry)
        flow.size += size
        self._queue.append(entry)
        self._data_bytes += size
        while self._data_bytes > self._max_bytes and len(self._queue) - self._dead > 1:
            dropped += self._drop_largest(entry)
        return dropped

    def discard(self, key: int) -> int:
        """Drop all that waits of one key (its route closed); return how many entries that were, uncounted."""
        flow = self._flows.pop(key, None)
        if flow is None:
            return 0
        count = len(flow.entries)
        while flow.entries:
            self._drop(flow, count=False)
        return count

    def clear(self) -> None:
        """Let go of everything that waits; the counts stay."""
        self._urgent.clear()
        self._queue.clear()
        self._flows.clear()
        self._started = None
        self._dead = self._offset = self._urgent_bytes = self._data_bytes = 0

    def head(self, max_parts: int = 64) -> list[memoryview]:
        """The next bytes to send, in order, as parts for ``sendmsg``; nothing is taken out."""
        parts: list[memoryview] = []
        if self._started is not None:
            parts.append(memoryview(self._started.data)[self._offset :])
        for queue in (self._urgent, self._queue):
            for entry in queue:
                if len(parts) >= max_parts:
                    return parts
                if not entry.dropped:
                    parts.append(memoryview(entry.data))
        return parts

    def consumed(self, count: int) -> None:
        """Take out the first ``count`` bytes of what ``head()`` gave.

        Raises:
            LocalProtocolError: More than waits.
        """
        while count > 0:
            if self._started is None:
                self._started = self._take()
            rest = len(self._started.data) - self._offset
            if count < rest:
                self._offset += count
                return
            count -= rest
            self._started = None
            self._offset = 0

    def _take(self) -> _Entry:
        if self._urgent:
            entry = self._urgent.popleft()
            self._urgent_bytes -= len(entry.data)
            return entry
        self._trim()
        if not self._queue:
            raise LocalProtocolError("more was consumed than waited")
        entry = self._queue.popleft()
        flow = self._flows[entry.key]
        flow.entries.popleft()
        flow.size -= len(entry.data)
        self._data_bytes -= len(entry.data)
        if not flow.entries:
            del self._flows[entry.key]
        return entry

    def _drop(self, flow: _Flow, *, count: bool = True) -> None:
        """Drop a flow's oldest entry: its bytes are freed now, its shell leaves the queue when it can."""
        entry = flow.entries.popleft()
        entry.dropped = True
        flow.size -= len(entry.data)
        self._data_bytes -= len(entry.data)
        entry.data = b""
        self._dead += 1
        if count:
            self.dropped[entry.key] += 1
        self._trim()
        if self._dead > _DEAD_KEPT and self._dead * 2 > len(self._queue):
            self._queue = deque(e for e in self._queue if not e.dropped)
            self._dead = 0

    def _trim(self) -> None:
        while self._queue and self._queue[0].dropped:
            self._queue.popleft()
            self._dead -= 1

    def _drop_largest(self, newest: _Entry) -> int:
        """Drop the oldest of the key that holds the most bytes, but never the entry just pushed.

        Half of what the key holds may go at once, so that room for one large entry is not searched for by
        looking at all keys before each of a thousand small drops.
        """
        sizes = ((f.size - len(newest.data) * (f.entries[-1] is newest), k) for k, f in self._flows.items())
        largest, key = max(sizes)
        flow = self._flows[key]
        target = flow.size - largest // 2
        dropped = 0
        while self._data_bytes > self._max_bytes and flow.entries and flow.entries[0] is not newest:
            self._drop(flow)
            dropped += 1
            if flow.size < target:
                break
        if not flow.entries:
            del self._flows[key]
        return dropped
