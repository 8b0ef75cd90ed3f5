"""One accepted TCPROS connection: receives a header, then sends messages."""

from __future__ import annotations

import logging
import socket
from typing import TYPE_CHECKING, Final

from rmpa.core.outbox import URGENT, Outbox
from rmpa.ros import limits
from rmpa.ros.wire.tcpros import encode_header, error_header, parse_header
from rmpa.runtime.stream import Stream

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.core.outbox import QueuedMessage
    from rmpa.ros.wire.tcpros import Buffer, Header
    from rmpa.runtime.stream import OnBytes

_log = logging.getLogger(__name__)
_MESSAGES: Final = 0


def keep_alive(sock: socket.socket) -> None:
    """Let the kernel detect a machine that was switched off, with roscpp's timing."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, limits.TCP_KEEPALIVE_IDLE)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, limits.TCP_KEEPALIVE_INTERVAL)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, limits.TCP_KEEPALIVE_COUNT)


class AcceptedConnection:
    """A connection that another node opened to a node of this process.

    Args:
        sock: Accepted, non-blocking; owned from here on.
        number: The node's own number for this connection.
        on_header: Called once, with the fields.
        on_end: Called once when the other side closed the connection or broke the protocol (then with the error); not
            after ``close()`` or ``refuse()``. The publication or service that takes the connection replaces it.

    Attributes:
        on_bytes: Gets the bytes after the header, as ``runtime.stream`` defines; with ``None``, as for subscribers,
            they are dropped.
    """

    def __init__(
        self,
        sock: socket.socket,
        number: int,
        *,
        on_header: Callable[[AcceptedConnection, Header], None],
        on_end: Callable[[AcceptedConnection, Exception | None], None],
    ) -> None:
        self.number = number
        self.fields: Header = {}
        """The other side's header, once received."""
        self.peer: tuple[str, int] = sock.getpeername()[:2]
        self.messages = 0
        """Messages queued for sending, those that were dropped later included."""
        self.on_end = on_end
        self.on_bytes: OnBytes | None = None
        self._on_header = on_header
        self._sock = sock
        self._local_port: int = sock.getsockname()[1]
        self._has_header = False
        keep_alive(sock)
        self._outbox = Outbox(limits.SUBSCRIBER_QUEUE_MESSAGES, limits.SUBSCRIBER_QUEUE_BYTES)
        self.stream = Stream(sock, on_bytes=self._take, on_close=self._ended, outbox=self._outbox)

    @property
    def caller_id(self) -> str:
        """The other node's name, from its header."""
        return self.fields.get("callerid", "")

    @property
    def dropped(self) -> int:
        """Messages dropped because the other side is slow."""
        return self._outbox.dropped[_MESSAGES]

    @property
    def info(self) -> str:
        """The addresses, in the form of ``rosnode info``."""
        return f"TCPROS connection on port {self._local_port} to [{self.peer[0]}:{self.peer[1]}]"

    def accept(
        self, header: Mapping[str, str], queue_messages: int, queue_bytes: int, *, nodelay: bool = False
    ) -> None:
        """Answer with the reply header; messages may follow. Does nothing if the connection has ended already.

        Args:
            header: The reply header.
            queue_messages: The most messages in the queue of this connection.
            queue_bytes: The most bytes in the queue; one message always fits.
            nodelay: Whether TCP_NODELAY is set even if the other side did not ask for it.
        """
        if self.stream.closed:  # while it was held; ``on_end`` follows
            return
        if nodelay or self.fields.get("tcp_nodelay") == "1":
            self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._outbox.set_bounds(queue_messages, queue_bytes)
        self.stream.send([encode_header(header)], URGENT)

    def bound(self, queue_messages: int, queue_bytes: int) -> None:
        """Change the bounds of the queue."""
        self._outbox.set_bounds(queue_messages, queue_bytes)

    def refuse(self, text: str) -> None:
        """Answer with an error header and close; the other side does not try again by itself."""
        self.stream.send([encode_header(error_header(text))], URGENT)
        self.close()

    def send(self, framed: Buffer) -> int:
        """Send one message, its length in front; return how many older ones were dropped for it."""
        self.messages += 1
        return self.stream.send([framed], _MESSAGES)

    def begin(self, size: int) -> QueuedMessage:
        """Begin a message of ``size`` bytes, its length included, that is sent in parts."""
        self.messages += 1
        return self.stream.open(_MESSAGES, size)

    def extend(self, message: QueuedMessage, part: Buffer) -> int:
        """Send a part of a message; return how many older messages were dropped for it."""
        return self.stream.extend(message, part)

    def abandon(self, message: QueuedMessage) -> bool:
        """Give up a message; return whether its beginning was sent, so that the connection has to be closed."""
        return self.stream.abandon(message)

    def close(self) -> None:
        """Close at once, without a call of ``on_end``."""
        self.stream.close()

    def _take(self, data: memoryview) -> tuple[int, int]:
        if self._has_header:
            if self.on_bytes is not None:
                return self.on_bytes(data)
            # A subscriber sends nothing more; reading goes on to detect the end of the stream.
            return len(data), 0
        fields, consumed, wanted = parse_header(data)
        if fields is None:
            return 0, wanted
        self._has_header = True
        self.fields = fields
        self._on_header(self, fields)
        if self.on_bytes is not None and consumed < len(data):
            taken, wanted = self.on_bytes(data[consumed:])
            return consumed + taken, wanted
        return consumed, 0

    def _ended(self, error: Exception | None) -> None:
        self.on_end(self, error)
