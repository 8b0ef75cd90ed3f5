"""TLS for a stream: a socket with records, and what a partial write leaves of its buffers."""

from __future__ import annotations

import contextlib
import ssl
from typing import TYPE_CHECKING, Final, cast

from rmpa.core.errors import LocalProtocolError
from rmpa.core.limits import KIB

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Sequence

Buffer = bytes | bytearray | memoryview


def unsent(parts: Sequence[Buffer], sent: int) -> list[Buffer]:
    """The parts without their first ``sent`` bytes; nothing is copied."""
    left: list[Buffer] = []
    for part in parts:
        size = len(part)
        if sent >= size:
            sent -= size
        else:
            left.append(memoryview(part)[sent:] if sent else part)
            sent = 0
    return left


# TLS below a ``Stream``. A socket whose ``sendmsg`` and ``recv_into`` encrypt and decrypt, by OpenSSL's memory BIOs.
#
# asyncio's own TLS copies each message several times and takes 100 µs more a round trip, and ``ssl.SSLSocket`` has
# no ``sendmsg``. Here a small message is one record, one ``send`` and one ``recv``, as without TLS.
#
# Ciphertext belongs to one connection, so it never comes into an outbox: what the socket does not take waits here,
# and while it does, ``sendmsg`` takes nothing more. ``pending`` and ``readable`` say what epoll does not see.


# What ``SecureSocket.recv_into`` returns for a part of a record: the other side is alive.
INCOMPLETE: Final = -1
# Plain bytes of the largest record (RFC 8446, section 5.1).
_RECORD: Final = 16 * KIB
# Plain bytes that are encrypted at once at most, 0.1 ms. Twice as many are no faster, and OpenSSL keeps buffers of
# the largest size for each connection.
_WRITE_MAX: Final = 128 * KIB
# Bytes that are read from the socket at once.
_READ: Final = 128 * KIB
# Where every connection reads ciphertext: one loop, one thread, and nothing stays in it.
_scratch: Final = memoryview(bytearray(_READ))


class TlsHandshake:
    """The TLS handshake of one connection: bytes go in and out, without a socket.

    Args:
        context: With this side's certificate, and what it accepts of the other one.
        server_side: Whether this side accepted the connection.
    """

    def __init__(self, context: ssl.SSLContext, *, server_side: bool) -> None:
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        # The connection's state, for the certificate and the protocol that was chosen.
        self.tls = context.wrap_bio(self._incoming, self._outgoing, server_side=server_side)
        # Whether this side has finished; a server may still refuse the client's certificate afterwards.
        self.done = False

    def receive(self, data: Buffer) -> None:
        """Take bytes of the other side; at first none, so that a client begins.

        Raises:
            ssl.SSLError: The handshake failed; ``take_output`` has the alert for the other side.
        """
        if data:
            self._incoming.write(data)
        if self.done:
            return
        try:
            self.tls.do_handshake()
        except ssl.SSLWantReadError:
            return
        self.done = True

    def take_output(self) -> bytes:
        """The bytes to send now."""
        return self._outgoing.read()

    def secure(self, sock: socket.socket) -> SecureSocket:
        """The socket to be used from now on; bytes that came behind the handshake are read first.

        Raises:
            LocalProtocolError: The handshake is not done.
        """
        if not self.done:
            raise LocalProtocolError("the TLS handshake is not done")
        return SecureSocket(sock, self.tls, self._incoming, self._outgoing)


class SecureSocket:
    """A socket whose bytes are encrypted.

    Args:
        sock: The socket below; owned from here on.
        tls: The connection's state, behind its handshake.
        incoming: Where ``tls`` reads ciphertext.
        outgoing: Where ``tls`` writes ciphertext.
    """

    def __init__(
        self, sock: socket.socket, tls: ssl.SSLObject, incoming: ssl.MemoryBIO, outgoing: ssl.MemoryBIO
    ) -> None:
        self._sock = sock
        self._transmit = sock.send  # 0.3 µs faster than ``sendmsg``
        self._receive = sock.recv_into
        self._tls = tls
        self._write = tls.write
        self._read = cast("Callable[[int, memoryview], int]", tls.read)
        self._incoming = incoming
        self._outgoing = outgoing
        self._unsent: memoryview | None = None
        # Plain bytes that are encrypted at once: one record once the socket was full, as neither the drop policy
        # nor more urgent messages reach what is encrypted; more again as long as the socket takes all.
        self._most = _WRITE_MAX
        # Whether there may be bytes for ``recv_into`` that epoll does not know of.
        self.readable = incoming.pending > 0

    @property
    def pending(self) -> bool:
        """Whether ciphertext waits for the socket: ``flush`` when it is writable."""
        return self._unsent is not None

    def sendmsg(self, parts: Sequence[Buffer]) -> int:
        """Encrypt and send; return how many bytes were taken, as a kernel's buffer would.

        Raises:
            BlockingIOError: Ciphertext of an earlier call waits; nothing was taken.
            OSError: The connection is gone.
        """
        if self._unsent is not None and not self.flush():
            raise BlockingIOError
        size = 0
        for part in parts:
            size += len(part)
        if size > _RECORD:
            size = self._encrypt(parts)
        elif size:
            self._write(b"".join(parts))
        else:
            return 0
        self._send(self._outgoing.read())
        if self._unsent is not None:
            self._most = _RECORD
        elif size == self._most < _WRITE_MAX:
            self._most *= 2
        return size

    def _encrypt(self, parts: Sequence[Buffer]) -> int:
        """Encrypt more than one record, at most ``_most`` bytes; return how many were taken."""
        most = self._most
        taken = waiting = 0
        small: list[Buffer] = []
        for part in parts:
            view = memoryview(part)[: most - taken]
            size = len(view)
            taken += size
            if waiting + size <= _RECORD:
                small.append(view)
                waiting += size
            else:
                # The first record is filled up, so that a header is none of its own; OpenSSL divides the rest.
                room = _RECORD - waiting
                self._write(b"".join((*small, view[:room])))
                self._write(view[room:])
                small, waiting = [], 0
            if taken == most:
                break
        if waiting:
            self._write(b"".join(small))
        return taken

    def flush(self) -> bool:
        """Send the ciphertext that waits; return whether none is left.

        Raises:
            OSError: The connection is gone.
        """
        if self._unsent is not None:
            unsent, self._unsent = self._unsent, None
            self._send(unsent)
        return self._unsent is None

    def recv_into(self, buffer: memoryview) -> int:
        """Read and decrypt; 0 at the end of the stream, with or without TLS's own end.

        Returns:
            How many bytes; ``INCOMPLETE`` if some came, but no whole record yet: nothing can be read.

        Raises:
            BlockingIOError: Nothing came.
            OSError: The connection is gone, or (``ssl.SSLError``) its bytes are not TLS, or an alert came.
        """
        if self.readable:
            return self._read_held(buffer)
        received = self._receive(_scratch)
        if not received:
            return 0
        incoming = self._incoming
        incoming.write(_scratch[:received])
        try:
            count = self._read(len(buffer), buffer)
        except ssl.SSLWantReadError:
            return INCOMPLETE
        except ssl.SSLZeroReturnError:
            return 0
        # A buffer with room left has the whole record; OpenSSL reads no further than the end of a record.
        if not count or (count < len(buffer) and not incoming.pending):
            return count
        return self._read_more(buffer, count)

    def _read_held(self, buffer: memoryview) -> int:
        """Read what is held alone, without the socket, so that a fast sender does not keep the loop busy."""
        self.readable = False
        try:
            count = self._read(len(buffer), buffer)
        except ssl.SSLWantReadError:
            raise BlockingIOError from None
        except ssl.SSLZeroReturnError:
            return 0
        return self._read_more(buffer, count) if count else 0

    def _read_more(self, buffer: memoryview, count: int) -> int:
        """Read further records until the buffer is full or there is none; return the number of all bytes."""
        size = len(buffer)
        try:
            # Asking first: the error by which OpenSSL says that there is no more takes a quarter of a message's time.
            while (pending := self._incoming.pending) and count < size:
                got = self._read(size - count, buffer[count:])
                if not got:
                    self.readable = True  # the next call says the end; nothing behind it is read, whatever follows
                    return count
                count += got
        except ssl.SSLWantReadError:
            return count
        except ssl.SSLZeroReturnError:
            self.readable = True
            return count
        self.readable = count == size and (pending > 0 or self._tls.pending() > 0)
        return count

    def shutdown(self, how: int) -> None:
        """Say the end of the stream, and close one direction of the socket."""
        with contextlib.suppress(ssl.SSLError):  # the other side's end is still to come, or the connection is broken
            self._tls.unwrap()
        if self.flush() and (alert := self._outgoing.read()):
            self._send(alert)
        self._sock.shutdown(how)

    def close(self) -> None:
        """Close the socket."""
        self._unsent = None
        self._sock.close()

    def _send(self, ciphertext: Buffer) -> None:
        try:
            sent = self._transmit(ciphertext)
        except BlockingIOError:
            sent = 0
        if sent < len(ciphertext):
            self._unsent = memoryview(ciphertext)[sent:]
