"""A connected TCP socket on the data path: one growing read buffer, one ``sendmsg`` a write, a bounded outbox.

asyncio's transports join or copy what cannot be sent at once, and have no bound with a drop policy. A ``Stream``
queues it in an ``Outbox``, and needs one system call for each message. A large message can be sent in parts while it
is received (``open``, ``extend``). Messages of one read are sent in one write (*corking*, as TCP_CORK does).
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import logging
import math
import socket
import sys
import termios
from collections.abc import Callable, Sequence
from typing import Final, cast

from rmpa.core import limits as core_limits
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.limits import KIB, MIB
from rmpa.core.outbox import ABORT, FIRST, LAST, URGENT, Framer, Outbox, QueuedMessage
from rmpa.runtime import limits
from rmpa.runtime.tls import INCOMPLETE, Buffer, SecureSocket, unsent

_log = logging.getLogger(__name__)

_FIRST_BUFFER: Final = 64 * KIB
_BUSY_BUFFER: Final = 256 * KIB
_KEPT_BUFFER: Final = 4 * MIB
_IOV: Final = 512
_WRITES: Final = 16
_CORK_ABOVE: Final = 512
_CORK_MESSAGES: Final = 128
_CORK_BYTES: Final = 512 * KIB
_PART: Final = MIB
_NOTHING_COLLECTED: Final = contextlib.nullcontext()

# Further bytes that a reader needs which leaves the rest of them for another turn, so that others get theirs.
LATER: Final = -1

OnBytes = Callable[[memoryview], tuple[int, int]]
OnClose = Callable[[Exception | None], None]

# One loop and one thread handle reads, one after the other; a read may be handled within another one.
# Called in order at the end of the read that is handled now; ``None``: nothing is collected.
collected: list[Callable[[], None]] | None = None


class CollectedSends:
    """A context that collects the messages that are sent within, whose parts must not change until its end.

    At its end each stream sends them by one system call.
    """

    __slots__ = ("_outer",)

    def __enter__(self) -> None:
        """Begin to collect."""
        global collected  # noqa: PLW0603 - one loop, one thread
        self._outer = collected
        collected = []

    def __exit__(self, *_: object) -> None:
        """Send what was collected."""
        global collected  # noqa: PLW0603 - as above
        try:
            for end in collected or ():
                end()
        finally:
            collected = self._outer


def after_read(call: Callable[[], None]) -> None:
    """Call ``call`` once the present read is handled; at once if none is, or if it is of a few bytes."""
    if collected is not None:
        collected.append(call)
    else:
        call()


class Stream:
    """Reads and writes one socket by the loop's readiness callbacks.

    Args:
        sock: Connected, non-blocking; the stream owns and closes it.
        on_bytes: Called with all received bytes that are not consumed yet; returns ``(consumed, wanted)``: how many
            bytes it took, and how many further bytes it needs before it can take more (0: unknown; ``LATER``: none;
            it is called again in another turn of the loop, and nothing is read meanwhile). The view is only valid
            during the call. A ``RemoteProtocolError`` raised by it closes the stream with that error; any other
            exception is a bug, is logged, and closes the stream too.
        on_close: Called once when the socket is gone, from the loop and never from within a method: with ``None``
            after an orderly end, with the error otherwise. Not called after ``close()``.
        outbox: The queue of the bytes that the socket does not take; entries that are in it already are sent first.
        secure: Encrypts and decrypts what ``sock`` carries; bytes that it holds already are delivered soon.
    """

    def __init__(
        self,
        sock: socket.socket,
        *,
        on_bytes: OnBytes,
        on_close: OnClose,
        outbox: Outbox,
        secure: SecureSocket | None = None,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._secure = secure
        self._sock: socket.socket | SecureSocket = sock if secure is None else secure
        self._on_bytes = on_bytes
        self._on_close = on_close
        # The queue of the waiting bytes, with the counts of dropped entries.
        self.outbox = outbox
        # Makes the header of each fragment of an opened message; without it opened messages are sent without headers.
        self._frame: Framer | None = None
        # Whether entries stay in the outbox when the socket is gone, for the next stream.
        self._keep = False
        self._buffer = bytearray(_FIRST_BUFFER)
        self._view = memoryview(self._buffer)
        self._filled = 0
        self._wanted = 0
        self._writing = False
        self._finishing = False
        self._kept: list[tuple[Sequence[Buffer], int, bool]] = []
        self._kept_bytes = 0
        # The read for which messages are kept.
        self._collection: object = None
        # Whether the socket is gone.
        self.closed = False
        self._reading_held = False
        self._later: asyncio.Handle | None = None
        self._drained: asyncio.Future[None] | None = None
        self._report: asyncio.Handle | None = None
        self._leaving: asyncio.TimerHandle | None = None
        self.bytes_in = 0
        self.bytes_out = 0
        # When bytes were last received (``loop.time()``), even if ``on_bytes`` was not called for them yet.
        self.last_in = self._loop.time()
        # When the last silence of more than ``limits.STALE_AGE`` was about to end: the time of the last poll that
        # found no bytes (``loop.time()``). Bytes that the remote side sent before that time were delayed by the
        # network; later ones may have waited in this process.
        self.resumed_at = -math.inf
        self._fd = sock.fileno()
        # An agent's loop calls readers of the data path directly; other loops (tools, tests) have no such method.
        add_reader = getattr(self._loop, "add_direct_reader", self._loop.add_reader)
        add_reader(self._fd, self._readable)
        if outbox:
            self._wait_for_room()
        if secure is not None and secure.readable:
            self._loop.call_soon(self._read_held)

    @property
    def pending_bytes(self) -> int:
        """Bytes in the outbox, which the socket has not taken yet."""
        return self.outbox.pending_bytes

    @property
    def unacknowledged(self) -> int:
        """Bytes in the kernel's send queue: not sent yet, or not acknowledged by the remote side."""
        if self.closed:
            return 0
        return int.from_bytes(fcntl.ioctl(self._fd, termios.TIOCOUTQ, bytes(4)), sys.byteorder)

    def feed(self, data: Buffer) -> None:
        """Take bytes that were read from the socket before the stream existed."""
        if self.closed:
            return
        self._reserve(self._filled + len(data))
        self._view[self._filled : self._filled + len(data)] = data
        self._filled += len(data)
        self.bytes_in += len(data)
        self._deliver()

    def send(self, parts: Sequence[Buffer], key: int) -> int:
        """Send one message made of ``parts``, or queue the bytes that the socket does not take.

        Args:
            parts: In order; views must have items of one byte. Within ``on_bytes`` they may be views of the bytes
                being handled: such messages are sent together after the whole read is handled. Outside of
                ``on_bytes`` they are not referenced after the call.
            key: The flow that the message belongs to, for the drop policy; ``URGENT`` is never dropped.

        Returns:
            How many older messages, of any key, were dropped to make room.
        """
        if self.closed or self._finishing:
            return 0
        if self._writing:
            return self._queue(b"".join(parts), key)
        if collected is not None:
            self._cork(parts, key)
            return 0
        return self._send_now(parts, key)

    def send_mark(self, data: bytes, key: int) -> None:
        """Send a mark after all present messages of a key; unlike a message, a mark is never dropped."""
        if self.closed or self._finishing:
            return
        if self._kept:
            self._uncork()
        if self._writing:
            self.outbox.push(data, key, self._loop.time(), pinned=True)
        else:
            self._send_now((data,), key)

    def adopt(self, outbox: Outbox, frame: Framer | None) -> None:
        """Send from another outbox from now on, its present entries first; it is kept when the socket is gone.

        Args:
            outbox: The outbox.
            frame: Makes the headers of fragments; must be the outbox's own.
        """
        self._uncork()
        rest = b"".join(self.outbox.head(1 << 20))
        self.outbox.clear()
        outbox.prepend(rest)
        self.outbox = outbox
        self._frame = frame
        self._keep = True
        self.pump()

    def _send_now(self, parts: Sequence[Buffer], key: int, part: bool = False) -> int:
        size = 0
        for buffer in parts:
            size += len(buffer)
        sent = self._transmit(parts, size)
        if sent == size or self.closed:
            if self._secure is not None:
                self._flush_later()
            return 0
        self._wait_for_room()
        if not sent and not part:
            return self._queue(b"".join(parts), key)
        self.outbox.push_rest(b"".join(unsent(parts, sent)))
        return 0

    def _transmit(self, parts: Sequence[Buffer], size: int) -> int:
        """Send what the socket takes now of ``size`` bytes; return how many it took.

        A message that it took in part is tried once more, because queueing its rest means copying it: the socket
        often has room again at once.
        """
        sent = 0
        try:
            while sent < size:
                sent += self._sock.sendmsg(unsent(parts, sent) if sent else parts)
        except BlockingIOError:
            pass
        except OSError as error:
            self.lost(error)
        self.bytes_out += sent
        return sent

    def _flush_later(self) -> None:
        """Wait for room if the socket has not taken all ciphertext of messages that count as sent."""
        if self._secure is not None and self._secure.pending and not self.closed:
            self._wait_for_room()

    def _wait_for_room(self) -> None:
        self._writing = True
        self._loop.add_writer(self._fd, self._writable)

    def open(self, key: int, size: int, sequence: int = 0, stamp_ns: int = 0) -> QueuedMessage:
        """Begin a message of ``size`` bytes, which ``extend`` adds before another message of its key begins."""
        return QueuedMessage(key, size, sequence, stamp_ns, self._loop.time())

    def extend(self, parcel: QueuedMessage, data: Buffer) -> int:
        """Send further bytes of an opened message, or queue those that the socket does not take.

        ``data`` is not referenced after the call. Bytes of a message that was dropped are ignored.

        Returns:
            How many older messages, of any key, were dropped to make room.
        """
        if self.closed or self._finishing or parcel.dropped:
            return 0
        view, dropped = memoryview(data), 0
        while len(view) > _PART:
            dropped += self._extend(parcel, view[:_PART])
            view = view[_PART:]
        return dropped + self._extend(parcel, view)

    def _extend(self, parcel: QueuedMessage, view: memoryview) -> int:
        if self._writing:
            return self.outbox.extend(parcel, bytes(view))
        if self.outbox.waiting(parcel.key):
            # The first bytes had to wait, so the outbox keeps this message's counts.
            if self._kept:
                self._uncork()
            dropped = self.outbox.extend(parcel, bytes(view))
            self._wait_for_room()
            self._writable()
            return dropped
        parts: list[Buffer] = self._framed(parcel, view) if self._frame is not None else [view]
        parcel.sent += len(view)
        if collected is not None:
            self._cork(parts, parcel.key, part=True)
            return 0
        return self._send_now(parts, parcel.key, part=True)

    def abandon(self, parcel: QueuedMessage) -> bool:
        """Give up an opened message whose rest will never come.

        Returns:
            Whether the remote side has an incomplete message that cannot be aborted, so that the connection must be
            closed.
        """
        if self.closed or parcel.sent == parcel.size:
            return False
        if self._kept:
            self._uncork()
        waits = self._writing or self.outbox.waiting(parcel.key)
        if not waits and parcel.sent and not parcel.dropped and self._frame is not None:
            parcel.dropped = True
            self._send_now([self._frame(parcel, 0, LAST | ABORT)], parcel.key)
            return False
        torn = self.outbox.abandon(parcel)
        self.pump()
        return torn

    def pump(self) -> None:
        """Send the entries that other code has put into the outbox."""
        if self._kept:
            self._uncork()
        if self.outbox and not self._writing and not self.closed:
            self._wait_for_room()

    def _framed(self, parcel: QueuedMessage, view: memoryview) -> list[Buffer]:
        """The bytes of ``view`` as parts, with a header before each fragment."""
        frame = cast("Framer", self._frame)
        parts: list[Buffer] = []
        size = len(view)
        for start in range(0, size, core_limits.FRAGMENT_BYTES):
            part = view[start : start + core_limits.FRAGMENT_BYTES]
            first = FIRST if parcel.sent + start == 0 else 0
            last = LAST if parcel.sent + start + len(part) == parcel.size else 0
            parts += (frame(parcel, len(part), first | last), part)
        return parts

    def _cork(self, parts: Sequence[Buffer], key: int, *, part: bool = False) -> None:
        """Keep a message until the present read is handled; all kept messages are then sent in one system call."""
        if self._collection is not collected:
            # Each read has its own: its views end with it.
            self._collection = collected
            after_read(self._uncork)
        self._kept.append((parts, key, part))
        for buffer in parts:
            self._kept_bytes += len(buffer)
        if len(self._kept) >= _CORK_MESSAGES or self._kept_bytes >= _CORK_BYTES:
            self._uncork()

    def _uncork(self) -> None:
        kept, self._kept = self._kept, []
        size, self._kept_bytes = self._kept_bytes, 0
        self._collection = None
        if self.closed or not kept:
            return
        if self._writing or self.outbox:
            self._keep_rest(kept, 0)  # after the entries that the outbox is sending
            return
        whole = kept[0][0] if len(kept) == 1 else [buffer for parts, _, _ in kept for buffer in parts]
        sent = self._transmit(whole, size)
        if sent < size and not self.closed:
            self._keep_rest(kept, sent)
        else:
            self._flush_later()

    def _keep_rest(self, kept: list[tuple[Sequence[Buffer], int, bool]], sent: int) -> None:
        """Queue the part of a batch that ``sendmsg`` did not take: the rest of one message, if any, then whole ones.

        Entries before a fragment are committed too, because the fragment already has its header and cannot take
        turns.
        """
        self._wait_for_room()
        last_part = max((index for index, (_, _, part) in enumerate(kept) if part), default=-1)
        for index, (parts, key, _) in enumerate(kept):
            length = sum(map(len, parts))
            if sent >= length:
                sent -= length
            elif sent > 0:
                self.outbox.push_rest(b"".join(unsent(parts, sent)))
                sent = 0
            elif index <= last_part:
                self.outbox.commit(b"".join(parts))
            else:
                self._queue(b"".join(parts), key)

    def close(self) -> None:
        """Close at once, without sending the waiting bytes. ``on_close`` is not called."""
        self._uncork()
        if self._report is not None:
            self._report.cancel()
            self._report = None
        self._shut()

    def leave(self, within: float) -> None:
        """Close once all waiting bytes are sent, or after ``within`` seconds. ``on_close`` may be called."""
        self._uncork()
        if self.closed or not self._writing:
            self.close()
        else:
            self._leaving = self._loop.call_later(within, self.close)

    def finish(self) -> None:
        """Half-close the socket once all waiting bytes are sent. Reading goes on.

        Not for ROS connections: rospy and roscpp treat a half-closed socket as dead.
        """
        if not self._finishing:
            self._uncork()
            self._finishing = True
            if not self._writing:
                self._shut_write()

    async def drained(self, within: float = limits.DRAIN_TIMEOUT) -> None:
        """Return when the outbox is empty, the stream is closed, or ``within`` seconds have passed."""
        if self.closed or not self._writing:
            return
        if self._drained is None or self._drained.done():
            self._drained = self._loop.create_future()
        await asyncio.wait([self._drained], timeout=within)

    def _queue(self, message: bytes, key: int) -> int:
        if key == URGENT:
            self.outbox.push_urgent(message)
            return 0
        return self.outbox.push(message, key, self._loop.time())

    def _shut(self) -> None:
        if self.closed:
            return
        self.closed = True
        for handle in (self._later, self._leaving):
            if handle is not None:
                handle.cancel()
        self._loop.remove_reader(self._fd)
        if self._writing:
            self._loop.remove_writer(self._fd)
        self._sock.close()
        # No callback is called from now on; dropping them breaks the reference cycle of the stream and its owner.
        del self._on_bytes, self._on_close
        self._view = memoryview(b"")
        self._buffer = bytearray()
        if not self._keep:
            self.outbox.clear()
        self._done_draining()

    def _shut_write(self) -> None:
        if not self.closed:
            with contextlib.suppress(OSError):  # the remote side may be gone; the reader will notice
                self._sock.shutdown(socket.SHUT_WR)

    def _done_draining(self) -> None:
        if self._drained is not None and not self._drained.done():
            self._drained.set_result(None)

    def lost(self, error: Exception | None) -> None:
        """End the connection as at an error of its own, which ``on_close`` gets; ``None``: the other side ended."""
        if not self.closed:
            on_close = self._on_close
            self._shut()
            # Later, not from here: this may be a ``send`` within the owner's loop over its streams.
            self._report = self._loop.call_soon(self._report_end, on_close, error)

    def _report_end(self, on_close: OnClose, error: Exception | None) -> None:
        self._report = None
        on_close(error)

    def _reserve(self, size: int) -> None:
        if size > len(self._buffer):
            buffer = bytearray(size)
            buffer[: self._filled] = self._view[: self._filled]
            self._buffer = buffer
            self._view = memoryview(buffer)

    def _readable(self, *, held: bool = False) -> None:
        if self._later is not None or (self._reading_held and not held):
            return  # within ``_read_held``, whose handlers yield to data: its bytes come first
        try:
            count = self._sock.recv_into(self._view[self._filled :])
        except BlockingIOError:
            return
        except OSError as error:
            self.lost(error)
            return
        if count == 0:
            self.lost(None)
            return
        self._heard()
        if count == INCOMPLETE:  # a large record on a slow network is no silence
            return
        self.bytes_in += count
        self._filled += count
        if self._filled == _FIRST_BUFFER == len(self._buffer):
            self._reserve(_BUSY_BUFFER)  # more bytes wait, so messages are large: read more at once from now on
        if self._filled >= self._wanted or self._filled == len(self._buffer):
            self._deliver()
        if self._secure is not None and self._secure.readable and not held:
            self._read_held()

    def _read_held(self) -> None:
        """Read the bytes that were received with a record but found no room, as the loop does not see them."""
        self._reading_held = True
        try:
            while self._secure is not None and self._secure.readable and not self.closed and self._later is None:
                self._readable(held=True)
        finally:
            self._reading_held = False

    def _heard(self) -> None:
        """Note that bytes came now."""
        now = self._loop.time()
        if now - self.last_in > limits.STALE_AGE:
            # Only a silence during which the socket was polled counts: not one in which this process got no CPU.
            polled = getattr(self._loop, "previous_poll_at", now)
            if polled - self.last_in > limits.STALE_AGE:
                self.resumed_at = polled
        self.last_in = now

    def _deliver(self) -> None:
        # A few bytes are one or two messages, sent at once unless an outer read collects. What is collected is sent
        # before anything moves in the buffer, because it is views of it.
        collects = self._filled > _CORK_ABOVE or collected is not None
        try:
            with CollectedSends() if collects else _NOTHING_COLLECTED:
                consumed, wanted = self._on_bytes(self._view[: self._filled])
        except Exception as error:  # noqa: BLE001 - a callback's top: else the same bytes would be offered for ever
            if not isinstance(error, RemoteProtocolError):
                _log.error("! a reader of bytes failed; its connection is closed", exc_info=error)
            self.lost(error)
            return
        if self.closed:
            return
        rest = self._filled - consumed
        if consumed and rest:
            # Forwards within one buffer: memoryview assignment is a memmove, so an overlap is safe.
            self._view[:rest] = self._view[consumed : self._filled]
        self._filled = rest
        self._wanted = max(0, wanted)
        if wanted == LATER:
            self._later = self._loop.call_soon(self._deliver_rest)
        if rest == len(self._buffer) or wanted > len(self._buffer):
            # A size that a peer claims is not allocated at once: the buffer grows with what has really arrived.
            self._reserve(min(max(wanted, 2 * rest), max(4 * rest, _FIRST_BUFFER)))
        elif rest <= _FIRST_BUFFER // 2 and wanted <= _FIRST_BUFFER and len(self._buffer) > _KEPT_BUFFER:
            view = self._view
            self._buffer = bytearray(_FIRST_BUFFER)
            self._view = memoryview(self._buffer)
            self._view[:rest] = view[:rest]

    def _deliver_rest(self) -> None:
        self._later = None
        self._deliver()
        self._read_held()

    def _writable(self) -> None:
        """Send queued entries until the socket takes no more, or ``_WRITES`` system calls were made."""
        for _ in range(_WRITES):
            # Without parts: all entries were too old, and were dropped.
            parts = self.outbox.head(_IOV, self._loop.time())
            try:
                sent = self._sock.sendmsg(parts) if parts or self._secure is not None else 0
            except BlockingIOError:
                return
            except OSError as error:
                self.lost(error)
                return
            self.bytes_out += sent
            self.outbox.consumed(sent)
            if not self.outbox:
                if self._secure is None or not self._secure.pending:
                    self._all_sent()
                return
            if sent < sum(map(len, parts)):
                return

    def _all_sent(self) -> None:
        self._writing = False
        self._loop.remove_writer(self._fd)
        if self._leaving is not None:
            self.close()
        if self._finishing:
            self._shut_write()
        self._done_draining()
