"""One accepted TCPROS connection: receives a header, then sends messages or replies."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING, Final

from rmpa.core.outbox import URGENT, Outbox
from rmpa.ros import limits
from rmpa.ros.wire.tcpros import encode_header, error_header, parse_header
from rmpa.runtime.stream import Stream

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.ros.wire.tcpros import Header
    from rmpa.runtime.stream import OnBytes

_MESSAGES: Final = 0
"""The outbox key of messages."""


def keep_alive(sock: socket.socket) -> None:
    """Let the kernel detect a machine that was switched off, with roscpp's timing."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, limits.TCP_KEEPALIVE_IDLE)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, limits.TCP_KEEPALIVE_INTERVAL)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, limits.TCP_KEEPALIVE_COUNT)


def tcpros_info(sock: socket.socket) -> str:
    """The addresses of a connection, in the form of ``rosnode info``."""
    host, port = sock.getpeername()[:2]
    return f"TCPROS connection on port {sock.getsockname()[1]} to [{host}:{port}]"


class AcceptedConnection(Stream):
    """A connection that another node opened to a node of this process: a header comes, then messages or replies go.

    Args:
        sock: Accepted, non-blocking; owned from here on.
        number: The node's own number for this connection.
        on_header: Called once, when ``request`` is known.
        on_end: Called once when the other side closed the connection or broke the protocol (then with the error); not
            after ``close()`` or ``refuse()``. The publication or service that takes the connection replaces it.

    Attributes:
        on_data: Gets the bytes after the header, as ``on_bytes`` of a stream; with ``None``, as for subscribers, they
            are dropped.
        since: The count of its publication's messages when it was served.
    """

    def __init__(
        self,
        sock: socket.socket,
        number: int,
        *,
        on_header: Callable[[AcceptedConnection], None],
        on_end: Callable[[AcceptedConnection, Exception | None], None],
    ) -> None:
        self.number = number
        self.request: Header = {}
        """The other side's header, once received."""
        self.info = tcpros_info(sock)
        self.peer: tuple[str, int] = sock.getpeername()[:2]
        self.since = 0
        self.on_end = on_end
        self.on_data: OnBytes | None = None
        self._on_header: Callable[[AcceptedConnection], None] | None = on_header
        self._socket = sock
        keep_alive(sock)
        outbox = Outbox(limits.SUBSCRIBER_QUEUE_MESSAGES, limits.SUBSCRIBER_QUEUE_BYTES)
        super().__init__(sock, on_bytes=self._take, on_close=lambda error: self.on_end(self, error), outbox=outbox)

    @property
    def caller_id(self) -> str:
        """The other node's name, from its header."""
        return self.request.get("callerid", "")

    @property
    def dropped(self) -> int:
        """Messages dropped because the other side is slow."""
        return self.outbox.dropped[_MESSAGES]

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
        if self.closed:  # while it was held; ``on_end`` follows
            return
        if nodelay or self.request.get("tcp_nodelay") == "1":
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.bound(queue_messages, queue_bytes)
        self.send([encode_header(header)], URGENT)

    def bound(self, queue_messages: int, queue_bytes: int) -> None:
        """Change the bounds of the queue."""
        self.outbox.set_bounds(queue_messages, queue_bytes)

    def refuse(self, text: str) -> None:
        """Answer with an error header and close; the other side does not try again by itself."""
        self.send([encode_header(error_header(text))], URGENT)
        self.close()

    def hang_up(self) -> None:
        """Close at once, without a call of ``on_end``."""
        self.close()

    def _take(self, data: memoryview) -> tuple[int, int]:
        consumed = 0
        if self._on_header is not None:
            fields, consumed, wanted = parse_header(data)
            if fields is None:
                return 0, wanted
            self.request = fields
            on_header, self._on_header = self._on_header, None
            on_header(self)
        if self.on_data is None:
            # A subscriber sends nothing more; reading goes on to detect the end of the stream.
            return len(data), 0
        taken, wanted = self.on_data(data[consumed:])
        return consumed + taken, wanted
