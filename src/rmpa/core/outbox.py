"""Send queues for a slow socket: bounded, round robin between keys, with drops counted by reason. Sans-I/O.

A driver pushes the bytes that the socket did not take at once. When the socket is writable again, the driver takes
``head()``, sends it, and reports with ``consumed()`` how many bytes the socket took.

There are two kinds of entries. A *pushed* entry is complete and is sent in one piece. An *opened* entry is a
``QueuedMessage``: its first bytes may be sent before its last bytes are there (cut-through). If the outbox has a
framer, an opened entry is sent in fragments, each with a header of its own, and the fragments of several keys take
turns.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from rmpa.core import limits
from rmpa.core.errors import LocalProtocolError

# The key of entries that are never dropped and go in front of all others.
URGENT: Final = -1

# Flag of a fragment: the first of its message.
FIRST: Final = 1
# Flag of a fragment: the last of its message.
LAST: Final = 2
# Flag of a fragment: the rest of its message will never come.
ABORT: Final = 4


@dataclass(slots=True, eq=False)
class QueuedMessage:
    """One waiting message; an opened message may not have all its bytes yet.

    Args:
        key: The queue that it belongs to.
        size: Its total length in bytes.
        sequence: Its sequence number, for the framer.
        stamp_ns: Its time stamp in nanoseconds, for the framer.
        born: When it was pushed, monotonic seconds.
        framed: Whether it is sent in fragments with headers.
        pinned: Whether it is a mark, which is never dropped.
        chunks: Its waiting bytes.
        held: The number of bytes in ``chunks``.
        sent: Bytes that the socket took or that are committed. A message with any such byte is never dropped.
        dropped: Whether the rest of it will not be sent.
    """

    key: int
    size: int
    sequence: int = 0
    stamp_ns: int = 0
    born: float = 0.0
    framed: bool = True
    pinned: bool = False
    chunks: deque[memoryview] = field(default_factory=deque)
    held: int = 0
    sent: int = 0
    dropped: bool = False


# Maps ``(message, length, flags)`` to the header of a fragment; ``length`` is the fragment's payload in bytes.
Framer = Callable[[QueuedMessage, int, int], bytes]


@dataclass(slots=True)
class _KeyBounds:
    """The bounds of one key's queue; see ``Outbox.set_terms``."""

    entries: int
    max_age: float | None = None
    strict: bool = False
    above: int = 0
    spared: bool = False


@dataclass(slots=True)
class _KeyQueue:
    bounds: _KeyBounds
    messages: deque[QueuedMessage] = field(default_factory=deque)
    size: int = 0
    marks: int = 0
    scheduled: bool = False


class Outbox:
    """Bounded queues of byte strings, one for each key, that take turns; beyond a bound the oldest entry is dropped.

    If one key has too many entries, its oldest entry is dropped. If all keys together hold too many bytes, the oldest
    entry of the key with the most bytes is dropped, so that a flood of images does not push commands out. An entry
    that was sent in part is never dropped (half a message must not stay on the wire) and does not count against the
    bounds. The newest entry always fits, however large: the outbox holds at most ``max(max_bytes, newest entry)``
    bytes, plus the entries that were sent in part.

    Args:
        max_entries: Entries of one key that may wait, at least 1.
        max_bytes: Bytes that may wait, over all keys except ``URGENT``.
        frame: Makes the headers of fragments; without it an opened message is sent without headers.
        fragment: Bytes of one opened message that are sent in one turn.

    Attributes:
        urgent_bytes: Bytes of the uncommitted urgent entries. The outbox does not bound them; its owner must.
        dropped: Entries dropped so far because a bound was reached, by key.
        expired: Entries dropped so far because they were too old, by key.
    """

    def __init__(
        self,
        max_entries: int,
        max_bytes: int,
        *,
        frame: Framer | None = None,
        fragment: int = limits.FRAGMENT_BYTES,
    ) -> None:
        self._bounds = _KeyBounds(max_entries)
        self._own_bounds: dict[int, _KeyBounds] = {}
        self._max_bytes = max_bytes
        self._frame = frame
        self._fragment = fragment
        self._urgent: deque[bytes] = deque()
        self._queues: dict[int, _KeyQueue] = {}
        self._round_robin: deque[int] = deque()
        self._committed: deque[memoryview] = deque()
        self._committed_bytes = 0
        self.urgent_bytes = 0
        self._data_bytes = 0
        self._begun_bytes = 0
        self._moved = self._standstill_end = 0.0
        self.dropped: Counter[int] = Counter()
        self.expired: Counter[int] = Counter()

    def __bool__(self) -> bool:
        """Whether there is something to send now."""
        return bool(self._committed or self._urgent or self._round_robin)

    def set_bounds(self, max_entries: int, max_bytes: int) -> None:
        """Change the bounds from the next ``push()`` on, for an owner that learns them after construction."""
        self._bounds.entries = max_entries
        self._max_bytes = max_bytes

    def set_terms(
        self,
        key: int,
        max_entries: int,
        max_age: float | None = None,
        *,
        strict: bool = False,
        above: int = 0,
        spared: bool = False,
    ) -> None:
        """Give one key bounds of its own.

        Args:
            key: The key.
            max_entries: Entries that may wait.
            max_age: Seconds that an entry may wait; ``None``: no bound.
            strict: Whether the newest entry is dropped too when it is too old (a lifespan). Otherwise the newest
                entry is always sent, and age counts from the end of the socket's last standstill: what a cut has
                delayed is not what a slow socket delays.
            above: Bytes of this key's entries up to which none is dropped for its age.
            spared: Whether ``max_bytes`` never drops an entry of this key, because its owner bounds the bytes.
        """
        bounds = self._own_bounds[key] = _KeyBounds(max_entries, max_age, strict, above, spared)
        if key in self._queues:
            self._queues[key].bounds = bounds

    @property
    def pending_bytes(self) -> int:
        """All waiting bytes, including urgent entries and the rest of entries that were sent in part."""
        return self._committed_bytes + self.urgent_bytes + self._data_bytes + self._begun_bytes

    @property
    def waiting_entries(self) -> int:
        """The number of waiting entries of all keys, without urgent entries, marks and committed parts."""
        return sum(len(queue.messages) - queue.marks for queue in self._queues.values())

    def waiting(self, key: int) -> int:
        """The number of waiting entries of one key, marks included."""
        queue = self._queues.get(key)
        return len(queue.messages) if queue is not None else 0

    def push_urgent(self, data: bytes) -> None:
        """Queue control bytes: before all data, but after the bytes that are already committed."""
        if data:
            self._urgent.append(data)
            self.urgent_bytes += len(data)

    def push_rest(self, data: bytes) -> None:
        """Queue the rest of an entry whose first bytes the driver has sent; it goes first and is never dropped.

        Raises:
            LocalProtocolError: The outbox was not empty, so the driver sent an entry out of turn.
        """
        if self:
            raise LocalProtocolError("a message was begun while others wait")
        self.commit(data)

    def commit(self, data: bytes) -> None:
        """Commit a part of a message whose earlier parts are sent or committed; it is never dropped."""
        if data:
            self._commit_bytes(memoryview(data))

    def prepend(self, data: bytes) -> None:
        """Queue bytes before everything else: those that the connection had not sent when it got this outbox."""
        if data:
            self._committed.appendleft(memoryview(data))
            self._committed_bytes += len(data)

    def push(self, data: bytes | bytearray | memoryview, key: int, now: float = 0.0, *, pinned: bool = False) -> int:
        """Queue one whole entry; return how many older entries, of any key, were dropped to make room.

        An empty entry is not queued. A pinned entry (a mark between messages) is never dropped and does not count
        against the bounds.
        """
        if not data:
            return 0
        return self._enqueue(QueuedMessage(key, len(data), 0, 0, now, False, pinned), memoryview(data))

    def extend(self, message: QueuedMessage, data: bytes) -> int:
        """Queue the first or further bytes of an opened message; return the number of dropped entries, as ``push``.

        Bytes of a message that was dropped are ignored.

        Raises:
            LocalProtocolError: The message would exceed its ``size``.
        """
        if message.dropped or not data:
            return 0
        if message.sent + message.held + len(data) > message.size:
            raise LocalProtocolError(f"more than the {message.size} bytes that a message was said to have")
        queue = self._queues.get(message.key)
        # The bytes of a message all arrive before its key's next message begins: a waiting message is the last one.
        if queue is None or not queue.messages or queue.messages[-1] is not message:
            return self._enqueue(message, memoryview(data))
        return self._hold(queue, message, memoryview(data))

    def abandon(self, message: QueuedMessage) -> bool:
        """Drop an opened message whose rest will never come.

        If a part of it was sent, an abort fragment tells the remote side to discard that part.

        Returns:
            Whether the remote side keeps an incomplete message, because without a framer there is no abort fragment.
        """
        if message.dropped:
            return False
        queue = self._queues.get(message.key)
        if queue is not None and message in queue.messages:
            queue.messages.remove(message)
            self._release(queue, message)
            if not queue.messages:
                self._remove_queue(message.key, queue)
        return self._abort(message)

    def discard(self, key: int) -> int:
        """Drop all entries of one key, and its own bounds; return the number of entries.

        The drops are not added to ``dropped``. A message that was sent in part is aborted.
        """
        queue = self._queues.pop(key, None)
        self._own_bounds.pop(key, None)
        if queue is None:
            return 0
        for message in queue.messages:
            self._release(queue, message)
            self._abort(message)
        if queue.scheduled:
            self._round_robin.remove(key)
        return len(queue.messages)

    def reset(self) -> int:
        """Prepare for the next connection, because the present one is gone.

        Committed bytes, and messages that were sent in part, are dropped; the other messages stay. Urgent entries are
        dropped too, because they belong to the old connection (a bye must not open the next one).

        Returns:
            How many messages that were sent in part were dropped.
        """
        torn = 0
        self._committed.clear()
        self._urgent.clear()
        self._committed_bytes = self.urgent_bytes = 0
        for key, queue in list(self._queues.items()):
            message = queue.messages[0] if queue.messages else None
            if message is not None and message.sent:
                message.dropped = True
                queue.messages.popleft()
                self._release(queue, message)
                torn += 1
            if not queue.messages:
                self._remove_queue(key, queue)
            elif queue.messages[0].chunks:
                self._schedule(queue, key)
        return torn

    def clear(self) -> None:
        """Drop all waiting entries; the counters stay."""
        for queue in self._queues.values():
            for message in queue.messages:
                message.dropped = True
        self._urgent.clear()
        self._queues.clear()
        self._round_robin.clear()
        self._committed.clear()
        self._committed_bytes = self.urgent_bytes = self._data_bytes = self._begun_bytes = 0

    def head(self, max_parts: int = 64, now: float = 0.0) -> list[memoryview]:
        """The next bytes to send, in order, as parts for ``sendmsg``; they stay queued until ``consumed``.

        The returned bytes are committed: an entry with any committed byte is no longer dropped.

        Args:
            max_parts: The most parts to return.
            now: Monotonic seconds, against which ages are judged; 0: no entry is dropped for its age.
        """
        if now:
            if now - self._moved > limits.STANDSTILL:
                self._standstill_end = now
            self._moved = now
        while len(self._committed) < max_parts and self._committed_bytes < limits.COMMIT_BYTES:
            if not self._commit(now):
                break
        committed = self._committed
        if len(committed) <= max_parts:
            return list(committed)
        return [committed[i] for i in range(max_parts)]

    def consumed(self, count: int) -> None:
        """Remove the first ``count`` bytes that ``head()`` returned.

        Raises:
            LocalProtocolError: ``count`` is greater than the number of waiting bytes.
        """
        while count > 0:
            if not self._committed and not self._commit(0.0):
                raise LocalProtocolError("more was consumed than waited")
            part = self._committed[0]
            if count < len(part):
                self._committed[0] = part[count:]
                self._committed_bytes -= count
                return
            count -= len(part)
            self._committed_bytes -= len(part)
            self._committed.popleft()

    def _commit_bytes(self, data: memoryview) -> None:
        self._committed.append(data)
        self._committed_bytes += len(data)

    def _commit(self, now: float) -> bool:
        """Commit the next entry or fragment in turn; return ``False`` if there is none."""
        if self._urgent:
            data = self._urgent.popleft()
            self.urgent_bytes -= len(data)
            self._commit_bytes(memoryview(data))
            return True
        while self._round_robin:
            key = self._round_robin.popleft()
            queue = self._queues[key]
            queue.scheduled = False
            if now:
                self._expire(queue, key, now)
            if not queue.messages:
                self._remove_queue(key, queue)
                continue
            message = queue.messages[0]
            if not message.chunks:
                continue  # ``extend`` schedules the queue again with the next bytes
            self._commit_fragment(queue, message)
            if message.sent == message.size:
                queue.messages.popleft()
                queue.marks -= message.pinned
            if not queue.messages:
                self._remove_queue(key, queue)
            elif queue.messages[0].chunks:
                self._schedule(queue, key)
            return True
        return False

    def _commit_fragment(self, queue: _KeyQueue, message: QueuedMessage) -> None:
        """Commit one fragment of a message that has at least one waiting byte."""
        flags = 0 if message.sent else FIRST
        if not message.sent and not message.pinned:  # from now on its bytes do not count against the bounds
            queue.size -= message.held
            self._data_bytes -= message.held
            self._begun_bytes += message.held
        limit = self._fragment if message.framed else message.held
        parts: list[memoryview] = []
        length = 0
        while message.chunks and length < limit:
            chunk = message.chunks.popleft()
            if length + len(chunk) > limit:
                message.chunks.appendleft(chunk[limit - length :])
                chunk = chunk[: limit - length]
            parts.append(chunk)
            length += len(chunk)
        message.held -= length
        message.sent += length
        self._begun_bytes -= length
        if message.framed and self._frame is not None:
            self._commit_bytes(
                memoryview(self._frame(message, length, flags | LAST * (message.sent == message.size)))
            )
        for part in parts:
            self._commit_bytes(part)

    def _enqueue(self, message: QueuedMessage, data: memoryview) -> int:
        """Append a message, with its first bytes, to its key's queue; return how many entries were dropped."""
        queue = self._queues.get(message.key)
        if queue is None:
            queue = self._queues[message.key] = _KeyQueue(self._own_bounds.get(message.key, self._bounds))
        dropped = 0
        if message.pinned:
            queue.marks += 1
        else:
            while len(queue.messages) - queue.marks >= queue.bounds.entries and self._drop_oldest(queue, message):
                dropped += 1
        queue.messages.append(message)
        return dropped + self._hold(queue, message, data)

    def _hold(self, queue: _KeyQueue, message: QueuedMessage, data: memoryview) -> int:
        """Keep bytes of a message, which is in its queue; return how many entries were dropped."""
        message.chunks.append(data)
        message.held += len(data)
        if message.sent or message.pinned:  # these count against no bound
            self._begun_bytes += len(data)
        else:
            queue.size += len(data)
            self._data_bytes += len(data)
        self._schedule(queue, message.key)
        dropped = 0
        while self._data_bytes > self._max_bytes and (count := self._drop_largest(message)):
            dropped += count
        return dropped

    def _abort(self, message: QueuedMessage) -> bool:
        """Drop a message, and say so if a part of it was sent; return whether that cannot be said."""
        message.dropped = True
        if message.sent and self._frame is not None:
            self._commit_bytes(memoryview(self._frame(message, 0, LAST | ABORT)))
        return message.sent > 0 and self._frame is None

    def _schedule(self, queue: _KeyQueue, key: int) -> None:
        if not queue.scheduled and queue.messages and queue.messages[0].chunks:
            queue.scheduled = True
            self._round_robin.append(key)

    def _release(self, queue: _KeyQueue, message: QueuedMessage) -> None:
        """Drop a message's waiting bytes, and subtract them from the sums."""
        if message.sent or message.pinned:
            self._begun_bytes -= message.held
        else:
            queue.size -= message.held
            self._data_bytes -= message.held
        message.held = 0
        message.chunks.clear()

    def _remove_queue(self, key: int, queue: _KeyQueue) -> None:
        del self._queues[key]
        if queue.scheduled:
            self._round_robin.remove(key)

    def _drop_oldest(self, queue: _KeyQueue, newest: QueuedMessage) -> bool:
        """Drop a queue's oldest message that is unsent, not pinned and not ``newest``; return whether one was."""
        index = 0
        while index < len(queue.messages) and (queue.messages[index].sent or queue.messages[index].pinned):
            index += 1
        if index == len(queue.messages) or queue.messages[index] is newest:
            return False
        message = queue.messages[index]
        del queue.messages[index]
        self._release(queue, message)
        message.dropped = True
        self.dropped[message.key] += 1
        return True

    def _drop_largest(self, newest: QueuedMessage) -> int:
        """Drop the oldest entries of the key that holds the most bytes, but never ``newest``; return their number.

        One call drops up to half of the key's bytes. With one entry a call, room for one large entry could take a
        search over all keys for each of a thousand small entries.
        """
        own = 0 if newest.sent else newest.held
        sizes = [
            (queue.size - own * (queue.messages[-1] is newest), key)
            for key, queue in self._queues.items()
            if not queue.bounds.spared
        ]
        if not sizes:
            return 0
        largest, key = max(sizes)
        queue = self._queues[key]
        target = queue.size - largest // 2
        dropped = 0
        while self._data_bytes > self._max_bytes and self._drop_oldest(queue, newest):
            dropped += 1
            if queue.size < target:
                break
        if not queue.messages:
            self._remove_queue(key, queue)
        return dropped

    def _expire(self, queue: _KeyQueue, key: int, now: float) -> None:
        """Drop a key's entries older than its ``max_age``; the newest entry only if the key is ``strict``."""
        bounds = queue.bounds
        if bounds.max_age is None:
            return
        kept, since = (0, 0.0) if bounds.strict else (1, self._standstill_end)
        while len(queue.messages) > kept and queue.size > bounds.above:
            message = queue.messages[0]
            if message.sent or message.pinned or now - max(message.born, since) <= bounds.max_age:
                return
            queue.messages.popleft()
            self._release(queue, message)
            message.dropped = True
            self.expired[key] += 1
