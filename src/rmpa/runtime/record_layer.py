"""TLS below a ``Stream``: a socket whose ``sendmsg`` and ``recv_into`` encrypt and decrypt, by OpenSSL's memory BIOs.

asyncio's own TLS copies each message several times and takes 100 µs more a round trip, and ``ssl.SSLSocket`` has no
``sendmsg``. Here a small message is one record, one ``send`` and one ``recv``, as without TLS.

Ciphertext belongs to one connection, so it never comes into an outbox: what the socket does not take waits here, and
while it does, ``sendmsg`` takes nothing more. ``pending`` and ``readable`` say what epoll does not see.
"""

from __future__ import annotations

import contextlib
import ssl
from typing import TYPE_CHECKING, Final, Protocol, cast

from rmpa.core.errors import LocalProtocolError
from rmpa.core.sizes import KIB
from rmpa.runtime.segments import SegmentedSocket

if TYPE_CHECKING:
    import socket
    from collections.abc import Sequence

Buffer = bytes | bytearray | memoryview

_RECORD: Final = 16 * KIB
"""Plain bytes of the largest record (RFC 8446, section 5.1)."""
_WRITE_MAX: Final = 256 * KIB
"""Plain bytes that are encrypted at once at most, as many as a fragment and its header may have: 0.3 ms."""
_READ: Final = 256 * KIB
"""Bytes that are read from the socket at once."""
_scratch: Final = memoryview(bytearray(_READ))
"""Where every connection reads ciphertext: one loop, one thread, and nothing stays in it."""


class DataSocket(Protocol):
    """A connected, non-blocking socket, or ``segments.SegmentedSocket``."""

    def sendmsg(self, buffers: Sequence[Buffer], /) -> int:
        """Send as much as the socket takes now."""
        ...

    def recv_into(self, buffer: memoryview, /) -> int:
        """Read into a buffer; 0 at the end of the stream."""
        ...

    def shutdown(self, how: int, /) -> None:
        """Close one direction."""
        ...

    def close(self) -> None:
        """Close the socket."""
        ...


class RecordIncomplete(BlockingIOError):  # noqa: N818 - the name says what happened, as in core.errors
    """Bytes came, but no whole record yet: nothing can be read, and the other side is alive."""


class TlsHandshake:
    """The TLS handshake of one connection: bytes go in and out, without a socket.

    Args:
        context: With this side's certificate, and what it accepts of the other one.
        server_side: Whether this side accepted the connection.
    """

    def __init__(self, context: ssl.SSLContext, *, server_side: bool) -> None:
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side=server_side)
        self.done = False
        """Whether this side has finished; a server may still refuse the client's certificate afterwards."""

    @property
    def tls(self) -> ssl.SSLObject:
        """The connection's state, for the certificate and the protocol that was chosen."""
        return self._tls

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
            self._tls.do_handshake()
        except ssl.SSLWantReadError:
            return
        self.done = True

    def take_output(self) -> bytes:
        """The bytes to send now."""
        return self._outgoing.read()

    def secure(self, sock: DataSocket) -> SecureSocket:
        """The socket to be used from now on; bytes that came behind the handshake are read first.

        Raises:
            LocalProtocolError: The handshake is not done.
        """
        if not self.done:
            raise LocalProtocolError("the TLS handshake is not done")
        return SecureSocket(sock, self._tls, self._incoming, self._outgoing)


class SecureSocket:
    """A socket whose bytes are encrypted.

    Args:
        sock: The socket below; owned from here on.
        tls: The connection's state, behind its handshake.
        incoming: Where ``tls`` reads ciphertext.
        outgoing: Where ``tls`` writes ciphertext.
    """

    def __init__(
        self, sock: DataSocket, tls: ssl.SSLObject, incoming: ssl.MemoryBIO, outgoing: ssl.MemoryBIO
    ) -> None:
        self._sock = sock
        self._tls = tls
        self._incoming = incoming
        self._outgoing = outgoing
        self._unsent: memoryview | None = None
        self._most = _WRITE_MAX
        """Plain bytes that are encrypted at once: one record once the socket was full, as neither the drop policy
        nor more urgent messages reach what is encrypted; more again as long as the socket takes all."""
        self.readable = incoming.pending > 0
        """Whether there may be bytes for ``recv_into`` that epoll does not know of."""

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
        most = self._most
        taken = 0
        small: list[Buffer] = []
        waiting = 0
        for part in parts:
            size = len(part)
            if size > most - taken:
                part = memoryview(part)[: most - taken]  # noqa: PLW2901 - the rest is for the next call
                size = len(part)
            taken += size
            if waiting + size <= _RECORD:
                small.append(part)
                waiting += size
                continue
            # The first record is filled up, so that a header is none of its own; OpenSSL makes records of the rest.
            view = memoryview(part)
            room = _RECORD - waiting
            self._tls.write(b"".join((*small, view[:room])))
            self._tls.write(view[room:])
            small, waiting = [], 0
            if taken == most:
                break
        if waiting:
            self._tls.write(b"".join(small))
        if taken:
            self._send(self._outgoing.read())
            if self._unsent is not None:
                self._most = _RECORD
            elif most < _WRITE_MAX and taken == most:
                self._most = 2 * most
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

        Raises:
            RecordIncomplete: Bytes came, but nothing can be read yet.
            BlockingIOError: Nothing came.
            OSError: The connection is gone, or (``ssl.SSLError``) its bytes are not TLS, or an alert came.
        """
        held = self.readable
        if not held:
            received = self._sock.recv_into(_scratch)
            if not received:
                return 0
            self._incoming.write(_scratch[:received])
        try:
            count = self._decrypt(buffer)
        except ssl.SSLZeroReturnError:
            return 0
        if not count:
            # What is held is read alone, without the socket, so that a fast sender does not keep the loop busy.
            raise BlockingIOError if held else RecordIncomplete
        return count

    def segment(self, size: int) -> None:
        """Send in packets of at most ``size`` bytes from now on."""
        if isinstance(self._sock, SegmentedSocket):
            self._sock.size = size
        else:
            self._sock = SegmentedSocket(cast("socket.socket", self._sock), size)

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

    def _decrypt(self, buffer: memoryview) -> int:
        """Read records into a buffer until it is full or there is none; return the number of bytes."""
        count, size = 0, len(buffer)
        more = True
        try:
            # Asking first: the error by which OpenSSL says that there is no more takes a quarter of a message's time.
            while more and count < size:
                got: int = self._tls.read(size - count, buffer[count:])  # type: ignore[assignment] # with a buffer
                count += got
                more = got > 0 and (self._incoming.pending > 0 or self._tls.pending() > 0)
        except ssl.SSLWantReadError:
            pass
        except ssl.SSLZeroReturnError:
            if not count:
                raise
        self.readable = more and count == size
        if self._outgoing.pending and self._unsent is None:
            self._send(self._outgoing.read())  # the answer to an update of keys
        return count

    def _send(self, ciphertext: Buffer) -> None:
        try:
            sent = self._sock.sendmsg((ciphertext,))
        except (BlockingIOError, InterruptedError):
            sent = 0
        if sent < len(ciphertext):
            self._unsent = memoryview(ciphertext)[sent:]
