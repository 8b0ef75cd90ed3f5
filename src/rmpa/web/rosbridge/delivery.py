"""Messages of a client that are held back (``throttle_rate``), and fragments of its ops and of messages to it."""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.core.errors import LimitExceeded
from rmpa.web import limits
from rmpa.web.gateways.frame_writer import Opcode
from rmpa.web.rosbridge.protocol import Id, OpError, data_of, encode, size_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.web.gateways.frame_writer import OutFrame
    from rmpa.web.hub.topics import ReceivedMessage


class QueuedBytes:
    """Bytes queued for all topics of a client together."""

    def __init__(self) -> None:
        self.used = 0


class Throttle:
    """Holds back the messages of one topic for one client: ``throttle_rate`` and ``queue_length``.

    Without a queue, messages within the interval are dropped. With one they wait, the oldest is dropped when it is
    full, and one is sent in each interval.

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
            self._take_oldest()

    def offer(self, message: ReceivedMessage, now: float) -> list[ReceivedMessage]:
        """Take a message; returns those to be sent now."""
        if not self._queue and now >= self._free_at:
            self._free_at = now + self.interval
            return [message]
        if not self.length:
            return []
        size = len(message.payload)
        while self._queue and (len(self._queue) >= self.length or self._bytes + size > limits.QUEUE_BYTES_MAX):
            self._take_oldest()
        if not self._total.used or self._total.used + size <= limits.QUEUES_BYTES_MAX:
            self._queue.append(message)
            self._count(size)
        return self.due(now)

    def due(self, now: float) -> list[ReceivedMessage]:
        """The messages whose time has come: all where there is no interval any more."""
        sent: list[ReceivedMessage] = []
        while self._queue and now >= self._free_at:
            sent.append(self._take_oldest())
            self._free_at = now + self.interval
        return sent

    def next_timer(self) -> float | None:
        """When `due` has something; None for never."""
        return self._free_at if self._queue else None

    def clear(self) -> None:
        """Drop all that is queued; the client no longer wants it."""
        self._count(-self._bytes)
        self._queue.clear()

    def _take_oldest(self) -> ReceivedMessage:
        message = self._queue.popleft()
        self._count(-len(message.payload))
        return message

    def _count(self, size: int) -> None:
        self._bytes += size
        self._total.used += size


def split(frame: OutFrame, size: int, mid: Id) -> list[OutFrame]:
    """Cut a frame of JSON into fragments of up to `size` characters; a frame that fits, and CBOR, stay whole.

    Args:
        frame: The op.
        size: Characters, 1 or more.
        mid: The id of all fragments.

    Raises:
        OpError: The fragments are too many.
    """
    opcode, _ = frame
    if opcode is Opcode.BINARY or size_of(frame) <= size:
        return [frame]
    text = bytes(data_of(frame)).decode()
    total = -(-len(text) // size)
    if total > limits.FRAGMENTS_MAX:
        problem = f"a message of {len(text)} characters would be {total} fragments of {size}"
        raise OpError(problem, f"ask for a fragment_size of {-(-len(text) // limits.FRAGMENTS_MAX)} or more")
    if total == 1:
        return [frame]
    pieces = (text[at : at + size] for at in range(0, len(text), size))
    return [
        encode({"op": "fragment", "id": mid, "data": piece, "num": num, "total": total})
        for num, piece in enumerate(pieces)
    ]


@dataclass(slots=True)
class _Incomplete:
    total: int
    deadline: float
    size: int = 0
    pieces: dict[int, str] = field(default_factory=dict)


class Assembler:
    """Puts a client's fragments together. They may come in any order; a repeated one is ignored."""

    def __init__(self) -> None:
        self._messages: OrderedDict[tuple[str, str | int], _Incomplete] = OrderedDict()
        self._bytes = 0

    def add(self, kind: str, mid: str | int, num: int, total: int, data: str, now: float) -> str | None:
        """Take one fragment.

        Args:
            kind: Its op, fragment or png.
            mid: Its id.
            num: Its place, from 0.
            total: How many there are.
            data: Its text.
            now: The present time.

        Returns:
            The whole text with the last missing fragment; else None.

        Raises:
            OpError: The numbers are impossible.
            LimitExceeded: The message has too many fragments, or is too long.
        """
        if total > limits.FRAGMENTS_MAX:
            raise LimitExceeded("total of fragments", total, limits.FRAGMENTS_MAX)
        if total < 1 or not 0 <= num < total:
            raise OpError(f"fragment {num} of {total} cannot be: they count from 0")
        key = (kind, mid)
        message = self._messages.get(key)
        if message is None:
            message = self._messages[key] = _Incomplete(total, now)
        elif message.total != total:
            self._drop(key)
            raise OpError(f"the fragments of {str(mid)[:80]!r} disagree: {message.total} or {total} in all")
        message.deadline = now + limits.FRAGMENT_TIMEOUT
        self._messages.move_to_end(key)
        if num not in message.pieces:
            self._store(key, message, num, data)
        if len(message.pieces) < total:
            return None
        self._drop(key)
        return "".join(message.pieces[index] for index in range(total))

    def _store(self, key: tuple[str, str | int], message: _Incomplete, num: int, data: str) -> None:
        # Python keeps up to four bytes a character, and some 200 bytes for each piece.
        size = len(data) * (1 if data.isascii() else 4) + 200
        if message.size + size > limits.FRAGMENTED_MAX:
            self._drop(key)
            raise LimitExceeded("message in fragments", message.size + size, limits.FRAGMENTED_MAX)
        message.pieces[num] = data
        message.size += size
        self._bytes += size
        while self._bytes > limits.FRAGMENTED_MAX or len(self._messages) > limits.FRAGMENTED_MESSAGES_MAX:
            self._drop(next(iter(self._messages)))

    def next_timer(self) -> float | None:
        """When `expire` is to be called; None for never."""
        return min((each.deadline for each in self._messages.values()), default=None)

    def expire(self, now: float) -> Iterator[str | int]:
        """Drop the messages whose next fragment is overdue; yields their ids."""
        for key, message in list(self._messages.items()):
            if message.deadline <= now:
                self._drop(key)
                yield key[1]

    def _drop(self, key: tuple[str, str | int]) -> None:
        self._bytes -= self._messages.pop(key).size
