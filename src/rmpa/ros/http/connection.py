"""One client of an XML-RPC server: its bounds, which one gives way, and the listening socket.

One client of an XML-RPC server: received HTTP is parsed, one call at a time is answered, all sizes are bounded.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import ipaddress
import socket
import struct
from collections import deque
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.core.counters import remedy
from rmpa.core.errors import StartError
from rmpa.core.limits import KIB
from rmpa.ros import limits
from rmpa.ros.wire.http import CONTINUE, HttpRefusal, HttpRequest, RequestParser, response_head
from rmpa.ros.wire.xmlrpc import serialize_fault
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import DESCRIPTORS
from rmpa.runtime.kernel_tcp import program_at
from rmpa.runtime.loop import yield_to_data

if TYPE_CHECKING:
    from collections.abc import Awaitable, Iterable

    from rmpa.runtime.accept import Use

RESET: Final = struct.pack("ii", 1, 0)
"""SO_LINGER: closing resets the connection, like a port where nothing listens."""
_PIECE: Final = 16 * KIB
"""Bytes parsed at once: the granularity of the bound on headers; other pending data is served in between."""


class HttpConnectionOwner(Protocol):
    """The server of a connection, as the connection needs it."""

    def admit(self, connection: HttpConnection) -> bool:
        """Whether there is room for a new connection."""

    def remove(self, connection: HttpConnection) -> None:
        """Forget a connection, which is closed."""

    def touch(self, connection: HttpConnection) -> None:
        """Note that a connection is used, and so is the last to be closed for a new one."""

    def reserve(self, connection: HttpConnection, size: int) -> bool:
        """Whether there is room for a call of ``size`` bytes; slow connections may be closed for it."""

    def refuse(self, name: str, connection: HttpConnection, text: str) -> None:
        """Count a refusal by its name, and log it."""

    def answer(self, body: memoryview, connection: HttpConnection) -> bytes | Awaitable[bytes]:
        """The response to a call's XML, at once or awaited."""


class HttpConnection(asyncio.Protocol):
    """A connection that a server accepted.

    Args:
        server: Answers the calls.

    Attributes:
        client: The client's address.
        begun: When the call began that is unfinished, or whose answer is not read yet, by the loop's clock.
        gone: Done when the connection is closed.
    """

    def __init__(self, server: HttpConnectionOwner) -> None:
        self._server = server
        self._loop = asyncio.get_running_loop()
        self._requests = RequestParser(lambda size: server.reserve(self, size), self._begin)
        self._waiting: deque[HttpRequest | HttpRefusal] = deque()
        self._unread = memoryview(b"")
        self._transport: asyncio.Transport | None = None
        self._task: asyncio.Task[None] | None = None
        self._more: asyncio.Handle | None = None
        self._eof = self._closing = self._writing_paused = self._reading_paused = False
        self._deadline = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self.begun = self._loop.time()
        self.gone: asyncio.Future[None] = self._loop.create_future()
        self.client = "?"

    # --- what http.eviction asks ------------------------------------------------------------------------------

    @property
    def idle(self) -> bool:
        """Whether no request is being received or answered, and no answer is unread."""
        return not (
            self._requests.receiving or self._waiting or self._task or self._transport is None or self.pending
        )

    @property
    def answering(self) -> bool:
        """Whether a call is being answered."""
        return self._task is not None

    @property
    def receiving(self) -> bool:
        """Whether a part of a request is received, and the rest is not."""
        return self._requests.receiving

    @property
    def reserved(self) -> int:
        """Bytes reserved for the connection's call."""
        return self._requests.body.reserved

    @property
    def received(self) -> int:
        """Received bytes of an unfinished call; 0 without one."""
        return len(self._requests.body) if self._requests.receiving else 0

    @property
    def pending(self) -> int:
        """Bytes of answers that wait to be sent, because the client does not read them."""
        return self._transport.get_write_buffer_size() if self._transport is not None else 0

    # --- asyncio's side ---------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Ask the server for room."""
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - a TCP server's is one; for mypy
        self._transport = transport
        peer = transport.get_extra_info("peername")
        self.client = peer[0] if peer else "?"
        if not self._server.admit(self):
            transport.abort()
            return
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._expect(limits.HTTP_REQUEST_TIMEOUT)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - asyncio's interface
        """Give up the call that is being answered."""
        self._server.remove(self)
        self._requests.close()
        for pending in (self._timer, self._task, self._more):
            if pending is not None:
                pending.cancel()
        if not self.gone.done():
            self.gone.set_result(None)

    def data_received(self, data: bytes) -> None:
        """Parse received bytes, later if a call is being answered; drop the rest of a refused request."""
        if not self._closing or self._task is not None:
            self._unread = memoryview(bytes(self._unread) + data if self._unread else data)
            if self._more is None:
                self._advance()

    def eof_received(self) -> bool:
        """Note the end of the client's stream; a client that half-closes after its request still gets the answer."""
        self._eof = True
        if self._more is None:
            self._advance()
        return self._task is not None or self._more is not None

    def pause_writing(self) -> None:
        """Read no more calls, because the client does not read its answers."""
        self._writing_paused = True
        self._adjust_reading()

    def resume_writing(self) -> None:
        """Read calls again, because the client has read its answers."""
        self._writing_paused = False
        self._adjust_reading()

    def _adjust_reading(self) -> None:
        """Pause reading while a call is being answered, requests wait, or the client does not read its answers."""
        pause = self._task is not None or self._more is not None or self._writing_paused
        if pause is self._reading_paused or self._transport is None or self._transport.is_closing():
            return
        self._reading_paused = pause
        if pause:
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()

    def _expect(self, seconds: float) -> None:
        """Close the connection after this many seconds, unless a later call sets another time, or it is answering."""
        self._deadline = self._loop.time() + seconds
        if self._timer is None or self._timer.when() > self._deadline:
            if self._timer is not None:
                self._timer.cancel()
            self._timer = self._loop.call_at(self._deadline, self._late)

    def _late(self) -> None:
        self._timer = None
        if self._loop.time() < self._deadline:
            self._timer = self._loop.call_at(self._deadline, self._late)
        elif self._task is not None:
            self._expect(limits.HTTP_IDLE_TIMEOUT)
        else:
            if self._requests.receiving:
                self._server.refuse("http.timeout", self, "a request was not finished in time")
            self.abort()

    # --- requests ---------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Start the time-out of a request, whose first byte has arrived."""
        self._expect(limits.HTTP_REQUEST_TIMEOUT)
        self.begun = self._loop.time()

    def _advance(self) -> None:
        """Take the next request; further ones received with it follow in later turns of the event loop."""
        self._more = None
        while self._task is None and not self._closing:
            if self._waiting:
                self._take(self._waiting.popleft())
                if not (self.answering or self._closing) and (self._waiting or self._unread):
                    self._more = self._loop.call_soon(self._advance)
                    break
            elif self._unread:
                piece, self._unread = self._unread[:_PIECE], self._unread[_PIECE:]
                self._waiting += self._requests.feed(piece)
                if self._requests.expects_continue and not self._waiting and self._transport is not None:
                    self._requests.expects_continue = False
                    self._transport.write(CONTINUE)
                if not self._waiting:
                    yield_to_data()
            elif self._eof:
                self._waiting += self._requests.feed_eof()
                if not self._waiting:
                    self.close_when_answered()
            else:
                break
        self._adjust_reading()

    def _take(self, request: HttpRequest | HttpRefusal) -> None:
        if isinstance(request, HttpRefusal):
            self._reject(request)
            return
        self._closing = request.close
        self._server.touch(self)
        if request.refusal:
            self._server.refuse("http.too_large", self, request.refusal)
            self._reply(serialize_fault(-1, request.refusal))
            return
        yield_to_data()
        answer = self._server.answer(request.body, self)
        yield_to_data()
        if isinstance(answer, bytes):
            self._requests.body.answered()
            self._reply(answer)
        else:
            self._task = self._loop.create_task(self._wait(answer))

    async def _wait(self, answer: Awaitable[bytes]) -> None:
        body = await answer
        self._task = None
        self._requests.body.answered()
        self._reply(body)
        self._advance()

    # --- answers ----------------------------------------------------------------------------------------------

    def _reply(self, body: bytes) -> None:
        if self._transport is None or self._transport.is_closing():
            return
        self._transport.write(response_head(200, len(body), close=self._closing) + body)
        if self._closing:
            self._close()
        else:
            self._expect(limits.HTTP_REQUEST_TIMEOUT if self._requests.receiving else limits.HTTP_IDLE_TIMEOUT)

    def _reject(self, refusal: HttpRefusal) -> None:
        """Answer with an HTTP error and half-close; reading goes on for a moment: closing would lose the answer."""
        self._server.refuse(refusal.counter, self, refusal.text)
        self._closing = True
        if self._transport is not None and not self._transport.is_closing():
            body = f"{refusal.text}\n".encode()
            self._transport.write(response_head(refusal.status, len(body), close=True) + body)
            self._transport.write_eof()
            self._requests.receiving = False
            self._expect(runtime_limits.DRAIN_TIMEOUT)

    # --- the end ----------------------------------------------------------------------------------------------

    def close_when_answered(self) -> None:
        """Close now, or after the answer to the call under way."""
        self._closing = True
        if self._task is None:
            self._close()

    def _close(self) -> None:
        if self._transport is not None:
            # Written data is still sent, but a client that does not read it cannot hold the socket for long.
            self._transport.close()
            self._expect(limits.HTTP_REQUEST_TIMEOUT)

    def reset(self) -> None:
        """Close at once, and tell the client by a reset."""
        if self._transport is not None:
            self._transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        self.abort()

    def abort(self) -> None:
        """Close at once."""
        self._closing = True
        if self._transport is not None:
            self._transport.abort()


# Opens the listening socket of an XML-RPC server; errors have a remedy.


async def listen(name: str, host: str, port: int, use: Use) -> socket.socket:
    """Open a listening socket.

    Args:
        name: The server, for the text of errors.
        host: Numeric address or name; empty: all addresses.
        port: 0 lets the system choose.
        use: The purpose of its connections.

    Raises:
        StartError: The address is in use, not of this machine, or not allowed.
    """
    try:
        address = await _resolve(host, port)
        sock = DESCRIPTORS.open_socket(use, what=name)
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(address)
            sock.listen(limits.HTTP_BACKLOG)
        except BaseException:
            sock.close()
            raise
    except OSError as error:
        owner = await asyncio.to_thread(program_at, port) if error.errno == errno.EADDRINUSE else ""
        raise _start_error(error, f"{name} at {host}:{port}", port, owner) from error
    return sock


async def _resolve(host: str, port: int) -> tuple[str, int]:
    with contextlib.suppress(ValueError):
        return str(ipaddress.IPv4Address(host)), port
    if not host:
        return "", port
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(host, port, family=socket.AF_INET, type=socket.SOCK_STREAM)
    return str(found[0][4][0]), port


def _start_error(error: OSError, where: str, port: int, owner: str) -> StartError:
    match error.errno:
        case errno.EADDRINUSE:
            return StartError(
                where,
                f"port {port} is already in use" + (f" by {owner}" if owner else ""),
                "end that program (another core?) or choose another port",
            )
        case errno.EACCES | errno.EPERM:
            return StartError(where, "this user may not use that port", "choose a port above 1023")
        case errno.EADDRNOTAVAIL:
            return StartError(where, "this machine does not have that address", "choose one that `ip addr` shows")
        case errno.EMFILE:
            return StartError(where, "no file descriptors left", remedy())
    return StartError(where, error.strerror or str(error))


# Chooses the connection of an XML-RPC server to close when there are too many, or too many bytes of calls.
#
# All clients are on this machine, so their addresses do not distinguish them. A well-behaved client is fast: it
# sends
# its call at once and reads the answer. A port scanner, or a stuck, stopped or hostile program, sends a byte now
# and
# then. The slowest is closed, so that ``rostopic list`` is answered beside any number of these.


_MOMENT: Final = 1e-3
"""Seconds; the least duration in the pace of a call."""


def for_newcomer(connections: Iterable[HttpConnection], now: float) -> HttpConnection | None:
    """Choose the connection to close for a new one; ``None`` if all are being answered.

    It is the slowest of those below ``limits.HTTP_PACE_MIN``; else the one that is idle for longest, whose client
    reconnects by itself; else the slowest of all.

    Args:
        connections: In the order of their last use.
        now: Monotonic seconds.
    """
    stalled, idle = [], None
    for one in connections:
        if one.idle:
            idle = idle or one
        elif not one.answering:
            stalled.append(one)
    slow = [one for one in stalled if _is_slow(one, now)]
    if idle is not None and not slow:
        return idle
    return min(slow or stalled, key=lambda one: _pace(one, now), default=None)


def for_call(connections: Iterable[HttpConnection], now: float) -> HttpConnection | None:
    """Choose the connection to close for the bytes of another call; ``None`` if none is slow."""
    slow = [one for one in connections if one.reserved and not one.answering and _is_slow(one, now)]
    return min(slow, key=lambda one: _pace(one, now), default=None)


def _is_slow(one: HttpConnection, now: float) -> bool:
    return now - one.begun > limits.HTTP_SLOW_AFTER and _pace(one, now) < limits.HTTP_PACE_MIN


def _pace(one: HttpConnection, now: float) -> float:
    """Bytes a second; 0 for a client that does not read its answer."""
    return one.received / max(now - one.begun, _MOMENT)
