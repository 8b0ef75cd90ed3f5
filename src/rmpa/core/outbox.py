"""Bytes that wait for a slow socket: bounded, keep-last by key, drops counted.

Pure: no socket here. A driver pushes what it could not send at once, asks for ``head()`` when the socket is
writable again and tells how much of it was ``consumed()``.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Final

URGENT: Final = -1
"""The key of entries that are never dropped and go in front of the others."""


@dataclass(slots=True)
class _Entry:
    key: int
    data: bytes | bytearray | memoryview
    dropped: bool = False


class Outbox:
    """A bounded queue of byte strings, sent in order; beyond a bound the oldest of the same key is dropped.

    An entry that was sent in part is never dropped (half a message must not stay on the wire), and one
    message always fits, however large.

    Args:
        max_entries: Entries of one key that may wait.
        max_bytes: Bytes that may wait over all keys but ``URGENT``.
    """

    def __init__(self, max_entries: int, max_bytes: int) -> None:
        self._max_entries = max_entries
        self._max_bytes = max_bytes
        self._urgent: deque[_Entry] = deque()
        self._queue: deque[_Entry] = deque()
        self._by_key: dict[int, deque[_Entry]] = {}
        self._started: _Entry | None = None
        self._offset = 0
        self._urgent_bytes = 0
        self._data_bytes = 0
        self.dropped: Counter[int] = Counter()
        """Entries dropped so far, by key."""

    def __bool__(self) -> bool:
        return bool(self._started or self._urgent or self._by_key)

    def set_bounds(self, max_entries: int, max_bytes: int) -> None:
        """Change the bounds; they count from the next ``push()`` on."""
        self._max_entries = max_entries
        self._max_bytes = max_bytes

    @property
    def pending_bytes(self) -> int:
        """Bytes that still wait, urgent ones included."""
        return self._urgent_bytes + self._data_bytes

    def push_urgent(self, data: bytes) -> None:
        """Queue control bytes: in front of all data but behind a message half sent."""
        self._urgent.append(_Entry(URGENT, data))
        self._urgent_bytes += len(data)

    def push_rest(self, data: bytes, key: int) -> None:
        """Queue the rest of an entry whose first part the driver has sent: it goes first, and stays.

        Only valid while the outbox is empty.
        """
        self._started = _Entry(key, data)
        self._offset = 0
        if key == URGENT:
            self._urgent_bytes += len(data)
        else:
            self._data_bytes += len(data)

    def push(self, data: bytes, key: int) -> int:
        """Queue one whole entry; return how many older ones of the key were dropped for it."""
        entry = _Entry(key, data)
        mine = self._by_key.setdefault(key, deque())
        dropped = 0
        while mine and (len(mine) >= self._max_entries or self._data_bytes + len(data) > self._max_bytes):
            self._drop(mine)
            dropped += 1
        if self._data_bytes and self._data_bytes + len(data) > self._max_bytes:
            dropped += self._drop_any(len(data))
        mine.append(entry)
        self._by_key[key] = mine
        self._queue.append(entry)
        self._data_bytes += len(data)
        return dropped

    def discard(self, key: int) -> int:
        """Drop all that waits of one key (its route closed); return how many entries that were."""
        mine = self._by_key.get(key)
        dropped = 0
        while mine:
            self._drop(mine, count=False)
            dropped += 1
        self._by_key.pop(key, None)
        return dropped

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
        """Take out the first ``count`` bytes of what ``head()`` gave."""
        while count > 0:
            entry = self._started or self._take()
            self._started = entry
            rest = len(entry.data) - self._offset
            taken = min(rest, count)
            count -= taken
            if entry.key == URGENT:
                self._urgent_bytes -= taken
            else:
                self._data_bytes -= taken
            self._offset += taken
            if taken == rest:
                self._started = None
                self._offset = 0

    def _take(self) -> _Entry:
        if self._urgent:
            return self._urgent.popleft()
        while True:
            entry = self._queue.popleft()
            if not entry.dropped:
                break
        mine = self._by_key[entry.key]
        mine.popleft()
        if not mine:
            del self._by_key[entry.key]
        return entry

    def _drop(self, mine: deque[_Entry], *, count: bool = True) -> None:
        entry = mine.popleft()
        entry.dropped = True
        self._data_bytes -= len(entry.data)
        if count:
            self.dropped[entry.key] += 1
        entry.data = b""
        if len(self._queue) > 2 * self._waiting() + 64:
            self._queue = deque(e for e in self._queue if not e.dropped)

    def _waiting(self) -> int:
        return sum(map(len, self._by_key.values()))

    def _drop_any(self, needed: int) -> int:
        """Make room in the shared bytes: the oldest of whichever key holds the most."""
        dropped = 0
        while self._by_key and self._data_bytes + needed > self._max_bytes:
            key, mine = max(self._by_key.items(), key=lambda item: sum(len(e.data) for e in item[1]))
            if not mine:
                break
            self._drop(mine)
            dropped += 1
            if not mine:
                del self._by_key[key]
        return dropped
