"""What waits for a WebSocket client, and its frames to the connection without a copy of large payloads.

Before Python 3.12 asyncio's transport copies what the socket does not take at once, for each client. Here a frame's
header and payload go to the socket in one system call, and what it does not take waits as views of the payload, which
all clients share. With TLS the transport writes, as it encrypts.
"""

from __future__ import annotations

import asyncio
import logging
import struct
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Generic, TypeAlias, TypeVar

from aiohttp import WSCloseCode, web

from rmpa.core.limits import KIB
from rmpa.runtime.tls import unsent
from rmpa.web import limits

if TYPE_CHECKING:
    import socket

    from rmpa.web.hub.node_link import Payload

_log = logging.getLogger(__name__)
_T = TypeVar("_T")
_FIN: Final = 0x80
_SHORT: Final = struct.Struct("!BB")
_MIDDLE: Final = struct.Struct("!BBH")
_LONG: Final = struct.Struct("!BBQ")


class Opcode(IntEnum):
    """The kind of a frame."""

    TEXT = 1
    BINARY = 2
    PING = 9
    PONG = 10


# A frame for the client: its kind, and its payload in pieces.
OutFrame: TypeAlias = tuple[Opcode, Sequence["Payload"]]


def size_of(frame: OutFrame) -> int:
    """Bytes of a frame's payload."""
    return sum(map(len, frame[1]))


def frame_header(opcode: Opcode, size: int) -> bytes:
    """The header of one unmasked, unfragmented frame with ``size`` bytes of payload."""
    if size < 126:
        return _SHORT.pack(_FIN | opcode, size)
    if size < 1 << 16:
        return _MIDDLE.pack(_FIN | opcode, 126, size)
    return _LONG.pack(_FIN | opcode, 127, size)


@dataclass(slots=True, eq=False)
class _Queue(Generic[_T]):
    stream: object
    priority: int
    entries: deque[tuple[_T, int]] = field(default_factory=deque)
    size: int = 0


@dataclass(slots=True)
class _Pace:
    """Of a subscription: seconds from one message to the next, how many may wait, and when the next one may go."""

    interval: float
    length: int
    free_at: float = float("-inf")


class FairQueue(Generic[_T]):
    """What waits for one client: a queue for each subscription, bounded in bytes, served in turn.

    Higher priorities go first; the subscriptions of one priority take turns, a message each, so that a map does not
    hold up commands. Beyond a bound the oldest message of the subscription with the most bytes is dropped, of the
    lowest priority first. What belongs to no subscription goes before all else and is never dropped; a client that
    lets it grow beyond the bound does not read at all, and is to be disconnected (``overflow``).

    A subscription may want its messages at a pace (``pace``): they wait here for their time, and those that it does
    not want do not count as dropped.

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
        self._urgent: _Queue[_T] = _Queue(None, 0)
        # The subscriptions that have entries, in the order of their turns.
        self._queues: dict[object, _Queue[_T]] = {}
        self._paces: dict[object, _Pace] = {}
        # Bytes that wait.
        self.bytes = 0
        # Messages dropped so far, by subscription, of the present ones.
        self.dropped: Counter[Any] = Counter()
        # Messages dropped so far, those of ended subscriptions included.
        self.dropped_total = 0

    @property
    def overflow(self) -> bool:
        """Whether the entries that are never dropped exceed the bound alone."""
        return self._urgent.size > self._total

    @property
    def waiting(self) -> Mapping[object, int]:
        """Messages that wait, by subscription."""
        return {stream: len(queue.entries) for stream, queue in self._queues.items()}

    @property
    def due(self) -> float | None:
        """When the next entry may go that its pace holds back; ``None`` where there is none."""
        return min((pace.free_at for stream, pace in self._paces.items() if stream in self._queues), default=None)

    def pace(self, stream: object, interval: float, length: int) -> None:
        """Let a subscription have one message in each interval of so many seconds; with 0 all.

        Of those that come meanwhile the newest ``length`` wait; with 0 they are left out.
        """
        known = self._paces.pop(stream, None)
        if interval:
            free_at = known.free_at + interval - known.interval if known is not None else float("-inf")
            self._paces[stream] = _Pace(interval, length, free_at)
            if (queue := self._queues.get(stream)) is not None:
                self._shorten(queue, max(length, 1))

    def push(self, stream: object, entry: _T, size: int, priority: int = 0, now: float = 0.0) -> None:
        """Add an entry.

        Args:
            stream: The subscription; ``None`` for an entry that is never dropped.
            entry: What is to be sent.
            size: Its bytes.
            priority: Of the subscription; a higher one is served first.
            now: Seconds of the clock of all calls, for a subscription with a pace.
        """
        pace = self._paces.get(stream)
        if pace is not None and not pace.length and (now < pace.free_at or stream in self._queues):
            return
        queue = self._urgent
        if stream is not None:
            queue = self._queues.get(stream) or self._queues.setdefault(stream, _Queue(stream, priority))
        queue.entries.append((entry, size))
        queue.size += size
        self.bytes += size
        if pace is not None:
            self._shorten(queue, max(pace.length, 1))
        while stream is not None and queue.size > self._each and len(queue.entries) > 1:
            self._drop_oldest(queue)
        while self.bytes > self._total and self._queues and self._drops_for(queue):
            pass

    def pop(self, now: float = 0.0) -> _T | None:
        """The next entry; ``None`` where there is none, or none whose time has come."""
        if self._urgent.entries:
            return self._take(self._urgent)
        queues: Iterable[_Queue[_T]] = self._queues.values()
        if self._paces:
            held = {stream for stream, pace in self._paces.items() if now < pace.free_at}
            queues = [queue for queue in queues if queue.stream not in held]
        # The first of the highest priority: its next turn is behind all others.
        queue = max(queues, key=_priority, default=None)
        if queue is None:
            return None
        del self._queues[queue.stream]
        entry = self._take(queue)
        if queue.entries:
            self._queues[queue.stream] = queue
        if self._paces and (pace := self._paces.get(queue.stream)) is not None:
            pace.free_at = now + pace.interval
        return entry

    def end(self, stream: object) -> None:
        """Forget a subscription, and what waits for it."""
        self.dropped.pop(stream, None)
        self._paces.pop(stream, None)
        if (queue := self._queues.pop(stream, None)) is not None:
            self.bytes -= queue.size

    def _drops_for(self, newest: _Queue[_T]) -> bool:
        """Drop a message, as all together do not fit; the newest one stays where it is the only one."""
        lowest = min(map(_priority, self._queues.values()))
        queues = [queue for queue in self._queues.values() if queue.priority == lowest]
        fullest = max(queues, key=lambda queue: queue.size)
        if fullest is newest and len(fullest.entries) == 1:
            if len(self._queues) == 1 and not self._urgent.entries:
                return False
            # Others of the same or a higher priority wait: the newest gives way if it alone has this priority.
            others = [queue for queue in queues if queue is not newest]
            fullest = max(others, key=lambda queue: queue.size, default=fullest)
        self._drop_oldest(fullest)
        return True

    def _shorten(self, queue: _Queue[_T], length: int) -> None:
        while len(queue.entries) > length:
            self._take(queue)

    def _drop_oldest(self, queue: _Queue[_T]) -> None:
        self._take(queue)
        self.dropped[queue.stream] += 1
        self.dropped_total += 1
        if not queue.entries:
            del self._queues[queue.stream]

    def _take(self, queue: _Queue[_T]) -> _T:
        entry, size = queue.entries.popleft()
        queue.size -= size
        self.bytes -= size
        return entry


def _priority(queue: _Queue[Any]) -> int:
    return queue.priority


# Buffers of one system call.
_BUFFERS: Final = 64
# System calls for one frame before others have their turn: a fast reader often makes room at once.
_TRIES: Final = 4


class FrameSocket(web.WebSocketResponse):
    """A WebSocket whose close frame, which aiohttp writes, comes behind the frames of a ``FrameWriter``."""

    # Called before the close frame is written; see ``FrameWriter.hand_over``.
    before_close: Callable[[], None] | None = None

    async def close(self, *, code: int = WSCloseCode.OK, message: bytes = b"", drain: bool = True) -> bool:
        """Close the WebSocket."""
        if self.before_close is not None:
            self.before_close()
        return await super().close(code=code, message=message, drain=drain)


class FrameWriter:
    """Writes the frames of one WebSocket, each whole and in order.

    Args:
        transport: Of the connection. Nothing else writes to it until ``hand_over``.
        drain: Waits until the transport's own buffer has room.
    """

    def __init__(self, transport: asyncio.Transport, drain: Callable[[], Awaitable[None]]) -> None:
        self._transport = transport
        self._drain = drain
        self._loop = asyncio.get_running_loop()
        # A descriptor of our own, as asyncio does not let others wait for the transport's; ``None``: the transport
        # writes.
        self._socket = _socket_of(transport)
        self._waiting: deque[memoryview] = deque()
        self._waiting_bytes = 0
        self._room: asyncio.Future[None] | None = None

    @property
    def unsent(self) -> int:
        """Bytes that the kernel has not taken yet."""
        return self._waiting_bytes + self._transport.get_write_buffer_size()

    @property
    def is_closing(self) -> bool:
        """Whether the connection has ended, or ends."""
        return self._transport.is_closing()

    def write(self, opcode: Opcode, parts: Sequence[Payload]) -> None:
        """Write one frame, or keep what the socket does not take.

        Args:
            opcode: Its kind.
            parts: Its payload; buffers of bytes, which must not change until they are sent.
        """
        if self._transport.is_closing():
            return
        header = frame_header(opcode, sum(map(len, parts)))
        if self._socket is None or self._transport.get_write_buffer_size():
            self._write_by_transport(header, parts)
        elif self._waiting:
            self._keep((header, *parts))
        else:
            self._write_to(self._socket, (header, *parts))

    async def drain(self) -> None:
        """Wait until at most ``limits.WRITE_BUFFER`` bytes wait, or the connection has ended."""
        while self._waiting_bytes > limits.WRITE_BUFFER:
            self._room = self._loop.create_future()
            await self._room
        if self._transport.get_write_buffer_size():
            await self._drain()

    def hand_over(self) -> None:
        """Pass what waits on to the transport, behind which others may write to it, and write by it from now on."""
        waiting = self._stop()
        if not self._transport.is_closing():
            for view in waiting:
                self._transport.write(view)

    def close(self) -> None:
        """Forget what waits; the connection itself is not closed."""
        self._stop()

    def _write_to(self, sock: socket.socket, buffers: Sequence[Payload]) -> None:
        left: Sequence[Payload] = buffers
        for _ in range(_TRIES):
            sent = self._send(sock, left)
            if sent < 0:
                return
            left = unsent(left, sent)
            if not left:
                return
            if not sent:
                break
        self._keep(left)
        self._loop.add_writer(sock.fileno(), self._writable)

    def _keep(self, buffers: Sequence[Payload]) -> None:
        for buffer in buffers:
            if buffer:
                self._waiting.append(memoryview(buffer))
                self._waiting_bytes += len(buffer)

    def _writable(self) -> None:
        sock = self._socket
        if sock is None:
            return
        sent = self._send(sock, [*islice(self._waiting, _BUFFERS)])
        if sent <= 0:
            return
        self._waiting_bytes -= sent
        while sent:
            first = self._waiting[0]
            if sent < len(first):
                self._waiting[0] = first[sent:]
                break
            sent -= len(first)
            self._waiting.popleft()
        if not self._waiting:
            self._loop.remove_writer(sock.fileno())
        if self._waiting_bytes <= limits.WRITE_BUFFER:
            self._make_room()

    def _send(self, sock: socket.socket, buffers: Sequence[Payload]) -> int:
        """How many bytes the socket took; -1 where the connection has ended."""
        if self._transport.is_closing():
            self._stop()
            return -1
        try:
            return sock.sendmsg(buffers)
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError as error:
            _log.debug("! sending: %s", error)
            self._stop()
            self._transport.abort()
            return -1

    def _write_by_transport(self, header: bytes, parts: Sequence[Payload]) -> None:
        small: list[Payload] = [header]
        for part in parts:
            if len(part) <= 32 * KIB:  # a larger one is written by itself, and not copied
                small.append(part)
                continue
            self._transport.write(b"".join(small))
            self._transport.write(part)
            small.clear()
        if small:
            self._transport.write(b"".join(small))

    def _stop(self) -> Sequence[memoryview]:
        """Write to the socket no more; returns what waits."""
        waiting, self._waiting, self._waiting_bytes = self._waiting, deque(), 0
        if self._socket is not None:
            if waiting:
                self._loop.remove_writer(self._socket.fileno())
            self._socket.close()
            self._socket = None
        self._make_room()
        return waiting

    def _make_room(self) -> None:
        if self._room is not None and not self._room.done():
            self._room.set_result(None)


def _socket_of(transport: asyncio.Transport) -> socket.socket | None:
    """A further descriptor of a connection without TLS; ``None`` where there is none."""
    sock = transport.get_extra_info("socket")
    if sock is None or transport.get_extra_info("sslcontext") is not None:
        return None
    try:
        found: socket.socket = sock.dup()
    except OSError as error:
        _log.warning(
            "! no file descriptor is left for a client, so each message is copied: %s [out-of-descriptors]", error
        )
        return None
    return found
