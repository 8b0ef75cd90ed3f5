"""Limits of connections that aiohttp has not: their number, the time of a request and of a response, bytes in a row.

Each connection has a ``GuardedConnection`` between its transport and aiohttp's protocol. Where there is no room for
a new connection, the one that has gone without a request for longest is closed: connections that send nothing, or
one byte a second, keep no others out.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final, cast

from rmpa.core.counters import RefusalLog
from rmpa.web import limits
from rmpa.web.gateways.websocket_frames import MaskCheck

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.counters import Counters

_log = logging.getLogger(__name__)
REASONS: Final = ("connections", "slow_request", "slow_response", "oversized")
"""Why connections are closed, as counted."""


class ConnectionTable:
    """All connections of one server.

    Args:
        make_protocol: Makes aiohttp's protocol of a new connection.
        counters: Counts what is closed, by the words of ``REASONS``.
    """

    def __init__(self, make_protocol: Callable[[], asyncio.Protocol], counters: Counters) -> None:
        self._make_protocol = make_protocol
        self._refusals = RefusalLog(_log, counters)
        self._open: dict[GuardedConnection, None] = {}
        self.accepted = 0
        """Connections so far."""

    def __len__(self) -> int:
        return len(self._open)

    def make(self) -> GuardedConnection:
        """The protocol of a new connection, for ``loop.create_server``."""
        return GuardedConnection(self, self._make_protocol())

    def opened(self, connection: GuardedConnection) -> bool:
        """Take a connection in; return whether there is room."""
        self.accepted += 1
        if len(self._open) >= limits.WEB_CONNECTIONS_MAX:
            idle = next((each for each in self._open if not each.is_answering), connection)
            idle.refuse("connections", f"{limits.WEB_CONNECTIONS_MAX} connections are open; the idlest is closed")
            if idle is connection:
                return False
        self._open[connection] = None
        return True

    def used(self, connection: GuardedConnection) -> None:
        """Note that a connection got a request: others are idler."""
        if connection in self._open:
            del self._open[connection]
            self._open[connection] = None

    def closed(self, connection: GuardedConnection) -> None:
        """Forget a connection."""
        self._open.pop(connection, None)

    def refuse(self, now: float, reason: str, address: str, text: str) -> None:
        """Count and log a connection that is closed."""
        self._refusals.refuse(now, reason, address, f"{address}: {text}")

    def abort_all(self) -> None:
        """Close every connection at once."""
        for connection in list(self._open):
            connection.abort()


class GuardedConnection(asyncio.Protocol):
    """One connection, between its transport and aiohttp's protocol.

    Args:
        table: The server's.
        inner: aiohttp's protocol.
    """

    def __init__(self, table: ConnectionTable, inner: asyncio.Protocol) -> None:
        self._table = table
        self._inner = inner
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._received = 0
        self._arriving = False
        self._unread = False
        self._upgraded = False
        self._mask: MaskCheck | None = None
        self._on_unmasked: Callable[[], None] | None = None
        self.received = 0
        """Bytes of the client so far."""
        self.is_answering = False
        """Whether a response is being made."""

    # --- what aiohttp's handlers tell ---

    def request_begins(self) -> None:
        """A request has arrived; its response is being made."""
        self.is_answering, self._arriving = True, False
        self._table.used(self)
        self._limit(limits.WEB_RESPONSE_TIMEOUT, "slow_response", "the response takes too long")

    def request_ends(self) -> None:
        """The response is made; the client has some time to read it and to send the next request."""
        self.is_answering, self._received = False, 0
        if not self._upgraded:
            self._limit(limits.WEB_IDLE_TIMEOUT, None, "")

    def upgrade(self, on_unmasked: Callable[[], None]) -> None:
        """The connection is a WebSocket from now on, whose handler has limits of its own.

        Args:
            on_unmasked: Called when a frame of the client is not masked; it and all after it is dropped.
        """
        self._upgraded = True
        self._mask, self._on_unmasked = MaskCheck(), on_unmasked
        self._stop_timer()

    # --- the transport ---

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Pass the transport on, if there is room."""
        self._transport = cast("asyncio.Transport", transport)
        self._inner.connection_made(transport)
        if self._table.opened(self):
            self._await_request()

    def data_received(self, data: bytes) -> None:
        """Pass bytes on, as many as one request may have."""
        self.received += len(data)
        if self._on_unmasked is not None and (self._mask is None or not self._mask.passes(data)):
            if self._mask is not None:
                self._mask = None
                self._on_unmasked()
            return
        if not self._upgraded:
            self._received += len(data)
            if self._received > limits.WEB_REQUEST_MAX:
                self.refuse("oversized", f"it sent more than {limits.WEB_REQUEST_MAX} bytes at once")
                return
            if not (self._arriving or self.is_answering or self._unread):
                self._await_request()
        self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        """Pass the end of the client's bytes on."""
        return self._inner.eof_received()

    def pause_writing(self) -> None:
        """Pass on that the client reads too slowly; it has some time to go on."""
        self._unread = True
        if not self._upgraded:
            self._limit(limits.WEB_RESPONSE_TIMEOUT, "slow_response", "it does not read the response")
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Pass on that it reads again."""
        self._unread = False
        if not self._upgraded:
            self._limit(limits.WEB_IDLE_TIMEOUT, None, "")
        self._inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._stop_timer()
        self._table.closed(self)
        self._inner.connection_lost(exc)

    # --- limits ---

    def refuse(self, reason: str, text: str) -> None:
        """Close the connection for one of ``REASONS``."""
        peer = self._transport.get_extra_info("peername") if self._transport is not None else None
        self._table.refuse(self._loop.time(), reason, str(peer[0]) if peer else "?", text)
        self.abort()

    def abort(self) -> None:
        """Close the connection; what waits to be sent is dropped."""
        self._stop_timer()
        self._table.closed(self)
        if self._transport is not None:
            self._transport.abort()

    def _await_request(self) -> None:
        self._arriving = True
        seconds = limits.WEB_REQUEST_TIMEOUT
        self._limit(seconds, "slow_request", f"no complete request came within {seconds:g} s")

    def _limit(self, seconds: float, reason: str | None, text: str) -> None:
        self._stop_timer()
        if self._transport is not None and not self._transport.is_closing():
            self._timer = self._loop.call_later(seconds, self._too_slow, reason, text)

    def _too_slow(self, reason: str | None, text: str) -> None:
        if reason is None:
            self.abort()
        else:
            self.refuse(reason, text)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
