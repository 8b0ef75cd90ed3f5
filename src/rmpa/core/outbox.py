"""Bytes that wait for a slow socket: bounded, a turn for each key, drops counted by reason.

Pure: no socket here. A driver pushes what it could not send at once, asks for ``head()`` when the socket is
writable again and tells how much of it was ``consumed()``.

Two kinds of entries wait. What is *pushed* goes out as it is, in one piece. What is *opened* is a ``QueuedMessage``
whose bytes follow while it may already be leaving (cut-through); where the outbox has a framer, a parcel leaves in
fragments, each with a header of its own, and the fragments of several keys take turns.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from rmpa.core import limits
from rmpa.core.errors import LocalProtocolError

URGENT: Final = -1
"""The key of entries that are never dropped and go in front of the others."""

FIRST: Final = 1
"""A fragment's flag: the first of its parcel."""
LAST: Final = 2
"""A fragment's flag: the last of its parcel."""
ABORT: Final = 4
"""A fragment's flag: the rest of its parcel will never come."""


class QueuedMessage:
    """One message that waits; of an opened one, bytes may still be missing.

    Args:
        key: Its flow.
        size: How many bytes it has in all.
        sequence: For the framer.
        stamp_ns: For the framer.
        born: When it was pushed, monotonic seconds.
    """

    __slots__ = (
        "born",
        "chunks",
        "dropped",
        "framed",
        "held",
        "key",
        "pinned",
        "sent",
        "sequence",
        "size",
        "stamp_ns",
    )

    def __init__(self, key: int, size: int, sequence: int = 0, stamp_ns: int = 0, born: float = 0.0) -> None:
        self.key = key
        self.size = size
        self.sequence = sequence
        self.stamp_ns = stamp_ns
        self.born = born
        self.framed = True
        self.pinned = False
        self.chunks: deque[memoryview] = deque()
        self.held = 0
        """Bytes of ``chunks``."""
        self.sent = 0
        """Bytes that were given to the socket, or are about to be: it can no longer be dropped."""
        self.dropped = False


Framer = Callable[[QueuedMessage, int, int], bytes]
"""``(parcel, length, flags)``: the header of a fragment."""


@dataclass(slots=True)
class _Terms:
    """What one key may hold."""

    entries: int
    max_age: float | None = None
    strict: bool = False
    spared: bool = False


@dataclass(slots=True)
class _KeyQueue:
    terms: _Terms
    parcels: deque[QueuedMessage] = field(default_factory=deque)
    size: int = 0
    marks: int = 0
    turning: bool = False


class Outbox:
    """Bounded queues of byte strings, one a key, that take turns; beyond a bound the oldest is dropped.

    Too many entries of one key: the oldest of that key. Too many bytes: the oldest of whichever key holds the
    most, so that a flood of images does not push commands out. An entry that was sent in part is never dropped
    (half a message must not stay on the wire) and not counted against the bound, and one message always fits,
    however large: at most ``max(max_bytes, the newest entry)`` plus the entries half sent is held.

    Args:
        max_entries: Entries of one key that may wait, at least 1.
        max_bytes: Bytes that may wait over all keys but ``URGENT``.
        frame: Makes the headers of fragments; without it an opened parcel's bytes go out as they are.
        fragment: Bytes of one turn of a parcel.
    """

    def __init__(
        self,
        max_entries: int,
        max_bytes: int,
        *,
        frame: Framer | None = None,
        fragment: int = limits.FRAGMENT_BYTES,
    ) -> None:
        self._terms = _Terms(max_entries)
        self._special: dict[int, _Terms] = {}
        self._max_bytes = max_bytes
        self._frame = frame
        self._fragment = fragment
        self._urgent: deque[bytes] = deque()
        self._flows: dict[int, _KeyQueue] = {}
        self._turns: deque[int] = deque()
        self._committed: deque[memoryview] = deque()
        self._committed_bytes = 0
        self._urgent_bytes = 0
        self._data_bytes = 0
        self._begun_bytes = 0
        self.dropped: Counter[int] = Counter()
        """Entries dropped so far because a bound was reached, by key."""
        self.expired: Counter[int] = Counter()
        """Entries dropped so far because they were too old, by key."""

    def __bool__(self) -> bool:
        """Whether there is something to send now."""
        return bool(self._committed or self._urgent or self._turns)

    def set_bounds(self, max_entries: int, max_bytes: int) -> None:
        """Change the bounds; they count from the next ``push()`` on. A subscriber's are known with its topic only."""
        self._terms.entries = max_entries
        self._max_bytes = max_bytes

    def set_terms(
        self, key: int, max_entries: int, max_age: float | None = None, *, strict: bool = False, spared: bool = False
    ) -> None:
        """Give one key bounds of its own.

        Args:
            key: Which.
            max_entries: Entries that may wait.
            max_age: Seconds that one may wait; ``None``: for ever.
            strict: Drop one that is too old even if none of its key is behind it (a lifespan); else the newest
                always leaves.
            spared: Drop none of it for the bytes of all keys together: its owner bounds it.
        """
        terms = self._special[key] = _Terms(max_entries, max_age, strict, spared)
        if key in self._flows:
            self._flows[key].terms = terms

    @property
    def urgent_bytes(self) -> int:
        """Bytes of whole urgent entries that wait; they have no bound here, the owner watches this."""
        return self._urgent_bytes

    @property
    def pending_bytes(self) -> int:
        """Bytes that still wait, urgent ones and those of the entry half sent included."""
        return self._committed_bytes + self._urgent_bytes + self._data_bytes + self._begun_bytes

    @property
    def pending_entries(self) -> int:
        """Entries that wait, urgent ones and the parts that are about to leave included."""
        return len(self._committed) + len(self._urgent) + sum(len(f.parcels) for f in self._flows.values())

    @property
    def waiting_entries(self) -> int:
        """Entries of all keys that wait, marks between them and what is about to leave not included."""
        return sum(len(flow.parcels) - flow.marks for flow in self._flows.values())

    def waiting(self, key: int) -> int:
        """Entries of one key that wait."""
        flow = self._flows.get(key)
        return len(flow.parcels) if flow is not None else 0

    # --- putting in -----------------------------------------------------------------------------------------

    def push_urgent(self, data: bytes) -> None:
        """Queue control bytes: in front of all data but behind what was begun."""
        if data:
            self._urgent.append(data)
            self._urgent_bytes += len(data)

    def push_rest(self, data: bytes, key: int) -> None:  # noqa: ARG002 - whose rest it is, for the reader
        """Queue the rest of an entry whose first part the driver has sent: it goes first, and stays.

        Raises:
            LocalProtocolError: Something waits already; the driver sent out of turn.
        """
        if self:
            raise LocalProtocolError("a message was begun while others wait")
        if data:
            self._commit_bytes(memoryview(data))

    def commit(self, data: bytes) -> None:
        """Queue a part of a parcel whose parts before it have left or are committed: it stays, in front of turns."""
        if data:
            self._commit_bytes(memoryview(data))

    def prepend(self, data: bytes) -> None:
        """Queue bytes in front of everything: what a connection still had to say before it carried this outbox."""
        if data:
            self._committed.appendleft(memoryview(data))
            self._committed_bytes += len(data)

    def push(self, data: bytes, key: int, now: float = 0.0, *, pinned: bool = False) -> int:
        """Queue one whole entry; return how many older ones, of any key, were dropped for it.

        An empty entry is nothing to send and not queued. A pinned one, a mark between messages, is never dropped and
        not counted against the bounds.
        """
        if not data:
            return 0
        parcel = QueuedMessage(key, len(data), born=now)
        parcel.framed = False
        parcel.pinned = pinned
        return self._enter(parcel, memoryview(data))

    def extend(self, parcel: QueuedMessage, data: bytes) -> int:
        """Queue more bytes of a parcel, its first ones or further ones; return as for ``push``.

        Nothing happens for a parcel that was dropped.

        Raises:
            LocalProtocolError: They are more than it was said to have.
        """
        if parcel.dropped or not data:
            return 0
        if parcel.sent + parcel.held + len(data) > parcel.size:
            raise LocalProtocolError(f"more than the {parcel.size} bytes that a message was said to have")
        flow = self._flows.get(parcel.key)
        # A parcel's bytes come in one go before another of its key: if it waits at all, it is the last one.
        if flow is None or not flow.parcels or flow.parcels[-1] is not parcel:
            return self._enter(parcel, memoryview(data))
        parcel.chunks.append(memoryview(data))
        parcel.held += len(data)
        if parcel.sent:
            self._begun_bytes += len(data)
        else:
            flow.size += len(data)
            self._data_bytes += len(data)
        self._turn(flow, parcel.key)
        return self._bound(parcel)

    def abandon(self, parcel: QueuedMessage) -> bool:
        """The rest of a parcel will never come: drop it, and tell the other side if it has a part of it.

        Returns:
            Whether the other side holds half a message that nothing can be done about: there is no framer.
        """
        if parcel.dropped:
            return False
        parcel.dropped = True
        flow = self._flows.get(parcel.key)
        if flow is not None and parcel in flow.parcels:
            flow.parcels.remove(parcel)
            self._release(flow, parcel)
            if not flow.parcels:
                self._forget(parcel.key, flow)
        if not parcel.sent:
            return False
        if self._frame is None:
            return True
        self._commit_bytes(memoryview(self._frame(parcel, 0, LAST | ABORT)))
        return False

    def discard(self, key: int) -> int:
        """Drop all that waits of one key (its route closed); return how many entries that were, uncounted.

        One that was begun is abandoned.
        """
        flow = self._flows.pop(key, None)
        self._special.pop(key, None)
        if flow is None:
            return 0
        count = 0
        for parcel in tuple(flow.parcels):
            self._release(flow, parcel)
            if parcel.sent and self._frame is not None and not parcel.dropped:
                self._commit_bytes(memoryview(self._frame(parcel, 0, LAST | ABORT)))
            parcel.dropped = True
            count += 1
        flow.parcels.clear()
        if flow.turning:
            self._turns.remove(key)
        return count

    def reset(self) -> int:
        """The connection is gone: forget what was begun, keep what was not; return how many entries were torn.

        Urgent entries are what the connection itself had to say: the next one must not begin with its bye.
        """
        torn = 0
        self._committed.clear()
        self._urgent.clear()
        self._committed_bytes = self._urgent_bytes = 0
        for key, flow in list(self._flows.items()):
            parcel = flow.parcels[0] if flow.parcels else None
            if parcel is not None and parcel.sent:
                parcel.dropped = True
                flow.parcels.popleft()
                self._release(flow, parcel)
                torn += 1
            if not flow.parcels:
                self._forget(key, flow)
            elif flow.parcels[0].chunks:
                self._turn(flow, key)
        return torn

    def clear(self) -> None:
        """Let go of everything that waits; the counts stay."""
        for flow in self._flows.values():
            for parcel in flow.parcels:
                parcel.dropped = True
        self._urgent.clear()
        self._flows.clear()
        self._turns.clear()
        self._committed.clear()
        self._committed_bytes = self._urgent_bytes = self._data_bytes = self._begun_bytes = 0

    # --- taking out -----------------------------------------------------------------------------------------

    def head(self, max_parts: int = 64, now: float = 0.0) -> list[memoryview]:
        """The next bytes to send, in order, as parts for ``sendmsg``; nothing is taken out.

        What was shown here has begun: it can no longer be dropped, only followed.
        """
        while len(self._committed) < max_parts and self._committed_bytes < limits.COMMIT_BYTES:
            if not self._commit(now):
                break
        committed = self._committed
        if len(committed) <= max_parts:
            return list(committed)
        return [committed[i] for i in range(max_parts)]

    def consumed(self, count: int) -> None:
        """Take out the first ``count`` bytes of what ``head()`` gave.

        Raises:
            LocalProtocolError: More than waits.
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

    # --- inside ---------------------------------------------------------------------------------------------

    def _commit_bytes(self, data: memoryview) -> None:
        self._committed.append(data)
        self._committed_bytes += len(data)

    def _commit(self, now: float) -> bool:
        """Let the next in turn begin, or go on; ``False`` when nobody can."""
        if self._urgent:
            data = self._urgent.popleft()
            self._urgent_bytes -= len(data)
            self._commit_bytes(memoryview(data))
            return True
        while self._turns:
            key = self._turns.popleft()
            flow = self._flows[key]
            flow.turning = False
            if now:
                self._expire(flow, key, now)
            if not flow.parcels:
                self._forget(key, flow)
                continue
            parcel = flow.parcels[0]
            if not parcel.chunks:
                continue  # it comes back with its next bytes
            self._commit_turn(flow, parcel)
            if parcel.sent == parcel.size:
                flow.parcels.popleft()
                flow.marks -= parcel.pinned
            if not flow.parcels:
                self._forget(key, flow)
            elif flow.parcels[0].chunks:
                self._turn(flow, key)
            return True
        return False

    def _commit_turn(self, flow: _KeyQueue, parcel: QueuedMessage) -> None:
        """Commit one turn's bytes of a parcel that has some."""
        flags = 0 if parcel.sent else FIRST
        if not parcel.sent and not parcel.pinned:  # begun from here on: no longer counted against the bound
            flow.size -= parcel.held
            self._data_bytes -= parcel.held
            self._begun_bytes += parcel.held
        limit = self._fragment if parcel.framed else parcel.held
        parts: list[memoryview] = []
        length = 0
        while parcel.chunks and length < limit:
            chunk = parcel.chunks.popleft()
            if length + len(chunk) > limit:
                parcel.chunks.appendleft(chunk[limit - length :])
                chunk = chunk[: limit - length]
            parts.append(chunk)
            length += len(chunk)
        parcel.held -= length
        parcel.sent += length
        self._begun_bytes -= length
        if parcel.framed and self._frame is not None:
            self._commit_bytes(memoryview(self._frame(parcel, length, flags | LAST * (parcel.sent == parcel.size))))
        for part in parts:
            self._commit_bytes(part)

    def _enter(self, parcel: QueuedMessage, data: memoryview) -> int:
        """Put a parcel, with its first bytes, at the end of its flow."""
        flow = self._flows.get(parcel.key)
        if flow is None:
            flow = self._flows[parcel.key] = _KeyQueue(self._special.get(parcel.key, self._terms))
        dropped = 0
        if parcel.pinned:
            flow.marks += 1
        else:
            while len(flow.parcels) - flow.marks >= flow.terms.entries and self._drop_oldest(flow, parcel):
                dropped += 1
        parcel.chunks.append(data)
        parcel.held = len(data)
        flow.parcels.append(parcel)
        if parcel.sent or parcel.pinned:
            self._begun_bytes += len(data)
        else:
            flow.size += len(data)
            self._data_bytes += len(data)
        self._turn(flow, parcel.key)
        return dropped + self._bound(parcel)

    def _turn(self, flow: _KeyQueue, key: int) -> None:
        if not flow.turning and flow.parcels and flow.parcels[0].chunks:
            flow.turning = True
            self._turns.append(key)

    def _bound(self, newest: QueuedMessage) -> int:
        dropped = 0
        while self._data_bytes > self._max_bytes:
            count = self._drop_largest(newest)
            if not count:
                break
            dropped += count
        return dropped

    def _release(self, flow: _KeyQueue, parcel: QueuedMessage) -> None:
        """Let go of a parcel's bytes, and of their account."""
        if parcel.sent or parcel.pinned:
            self._begun_bytes -= parcel.held
        else:
            flow.size -= parcel.held
            self._data_bytes -= parcel.held
        parcel.held = 0
        parcel.chunks.clear()

    def _forget(self, key: int, flow: _KeyQueue) -> None:
        del self._flows[key]
        if flow.turning:
            self._turns.remove(key)

    def _drop_oldest(self, flow: _KeyQueue, newest: QueuedMessage) -> bool:
        """Drop a flow's oldest parcel that was not begun and is not ``newest``; whether there was one."""
        index = 0
        while index < len(flow.parcels) and (flow.parcels[index].sent or flow.parcels[index].pinned):
            index += 1
        if index == len(flow.parcels) or flow.parcels[index] is newest:
            return False
        parcel = flow.parcels[index]
        del flow.parcels[index]
        self._release(flow, parcel)
        parcel.dropped = True
        self.dropped[parcel.key] += 1
        return True

    def _drop_largest(self, newest: QueuedMessage) -> int:
        """Drop the oldest of the key that holds the most bytes, but never the entry just pushed.

        Half of what the key holds may go at once, so that room for one large entry is not searched for by
        looking at all keys before each of a thousand small drops.
        """
        own = 0 if newest.sent else newest.held
        sizes = [
            (flow.size - own * (flow.parcels[-1] is newest), key)
            for key, flow in self._flows.items()
            if not flow.terms.spared
        ]
        if not sizes:
            return 0
        largest, key = max(sizes)
        flow = self._flows[key]
        target = flow.size - largest // 2
        dropped = 0
        while self._data_bytes > self._max_bytes and self._drop_oldest(flow, newest):
            dropped += 1
            if flow.size < target:
                break
        if not flow.parcels:
            self._forget(key, flow)
        return dropped

    def _expire(self, flow: _KeyQueue, key: int, now: float) -> None:
        """Drop what has waited for too long: unless ``strict``, never the newest."""
        terms = flow.terms
        if terms.max_age is None:
            return
        kept = 0 if terms.strict else 1
        while len(flow.parcels) > kept:
            parcel = flow.parcels[0]
            if parcel.sent or parcel.pinned or now - parcel.born <= terms.max_age:
                return
            flow.parcels.popleft()
            self._release(flow, parcel)
            parcel.dropped = True
            self.expired[key] += 1
