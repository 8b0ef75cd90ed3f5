"""An XML-RPC server: POST to any path, each response in one piece, all sizes and times bounded.

``ros.wire.http`` parses HTTP, ``ros.wire.xmlrpc`` the bodies. The server fits ROS's existing clients: XmlRpc++ wants
``Content-length`` and no chunks; Python keeps its connections open for as long as its threads live.

All clients are on this machine, so their addresses do not distinguish them. A well-behaved client is fast: it sends
its call at once and reads the answer. A port scanner, or a stuck, stopped or hostile program, sends a byte now and
then. When there are too many connections, or too many bytes of calls, the slowest is closed: ``rostopic list`` is
answered beside any number of these.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import socket
import struct
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Generator
from itertools import islice
from typing import Any, Final

from rmpa.core.errors import RemoteProtocolError, StartError
from rmpa.core.limits import KIB
from rmpa.core.log import RefusalLog
from rmpa.core.statistics import Counters
from rmpa.ros import limits
from rmpa.ros.http.rpc import read_large, slices
from rmpa.ros.wire.http import CONTINUE, HttpRequest, RequestParser, response_head
from rmpa.ros.wire.xmlrpc import RosFault, XmlRpcValue, brief, response_pieces, serialize_fault
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import DESCRIPTORS, Acceptor, Use, open_files_advice
from rmpa.runtime.kernel_tcp import program_at
from rmpa.runtime.loop import yield_to_data
from rmpa.runtime.tasks import OwnedTasks, start_task

_log = logging.getLogger(__name__)

# Bytes a second: the connection of a slower call is closed where room is short; loopback carries 1 GB/s.
_HTTP_PACE_MIN: Final = 64 * KIB
# Time before the pace of a call is judged.
_HTTP_SLOW_AFTER: Final = 1.0
# Connections of which one gives way: judging thousands for each new one would take milliseconds.
_EVICTED_OF: Final = 64
# Connections accepted in one turn of the event loop, 40 microseconds each.
_HTTP_ACCEPTS: Final = 4
# Length of the listen queue: all nodes of a robot register at once, and a refused SYN is repeated after 1 s.
_HTTP_BACKLOG: Final = 1024

# SO_LINGER: closing resets the connection, like a port where nothing listens.
RESET: Final = struct.pack("ii", 1, 0)
# Bytes parsed at once: the granularity of the bound on headers; other pending data is served in between.
_PIECE: Final = 16 * KIB
# Seconds; the least duration in the pace of a call.
_MOMENT: Final = 1e-3

# ``(method, params) -> value``, at once or awaited.
#
# A ``RosFault`` raised becomes a fault. ``ResetConnection``, raised at once, resets the connection.
Handler = Callable[[str, tuple[XmlRpcValue, ...]], XmlRpcValue | Awaitable[XmlRpcValue]]


class ResetConnection(Exception):  # noqa: N818 - the name says what the handler wants
    """Raised by a handler: the call's connection is reset, as by a port where no process listens."""


class HttpConnection(asyncio.Protocol):
    """A connection that a server accepted: one call at a time is answered.

    Args:
        server: Answers the calls.

    Attributes:
        client: The client's address.
        requests: Parses what is received.
        begun: When the call began that is unfinished, or whose answer is not read yet, by the loop's clock.
    """

    _transport: asyncio.Transport
    _task: asyncio.Task[None] | None = None
    _more: asyncio.Handle | None = None
    _timer: asyncio.TimerHandle | None = None
    _unread = memoryview(b"")
    _eof = _closing = _writing_paused = False
    client = "?"

    def __init__(self, server: XmlRpcServer) -> None:
        self._server = server
        self._loop = asyncio.get_running_loop()
        self.requests = RequestParser(lambda size: server.reserve(self, size), self._begin)
        self._waiting: deque[HttpRequest] = deque()
        self.begun = self._loop.time()

    @property
    def idle(self) -> bool:
        """Whether no request is being received or answered, and no answer is unread."""
        return not (self.requests.receiving or self._waiting or self._task or self._transport.get_write_buffer_size())

    @property
    def answering(self) -> bool:
        """Whether a call is being answered."""
        return self._task is not None

    def pace(self, now: float) -> float:
        """Bytes a second of an unfinished call; 0 for a client that does not read its answer."""
        received = self.requests.size if self.requests.receiving else 0
        return received / max(now - self.begun, _MOMENT)

    def slow(self, now: float) -> bool:
        """Whether the client takes too long for its call or for reading the answer."""
        return now - self.begun > _HTTP_SLOW_AFTER and self.pace(now) < _HTTP_PACE_MIN

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
        self.requests.close()
        for pending in (self._timer, self._task, self._more):
            if pending is not None:
                pending.cancel()

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
        if self._task is not None or self._more is not None or self._writing_paused:
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()

    def _expect(self, seconds: float) -> None:
        """Close the connection after this many seconds, unless a later call sets another time, or it is answering."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_later(seconds, self._late)

    def _late(self) -> None:
        if self._task is not None:
            self._expect(limits.HTTP_IDLE_TIMEOUT)
            return
        if self.requests.receiving:
            self._server.refuse("http.timeout", self, "a request was not finished in time")
        self.abort()

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
                self._waiting += self.requests.feed(piece)
                if self.requests.expects_continue and not self._waiting:
                    self.requests.expects_continue = False
                    self._transport.write(CONTINUE)
                if not self._waiting:
                    yield_to_data()
            elif self._eof:
                self._waiting += self.requests.feed_eof()
                if not self._waiting:
                    self.close_when_answered()
            else:
                break
        self._adjust_reading()

    def _take(self, request: HttpRequest) -> None:
        self._closing = request.close
        if request.refusal:
            self._server.refuse(request.counter, self, request.refusal)
        if request.status != 200:
            self._reject(request)
            return
        self._server.touch(self)
        if request.refusal:
            self._reply(serialize_fault(-1, request.refusal))
            return
        yield_to_data()
        answer = self._server.answer(request.body, self)
        try:
            answer.send(None)
        except StopIteration as end:
            yield_to_data()
            self._reply(end.value)
        else:
            self._task = start_task(self._wait(_Begun(answer)), "answer a call")

    async def _wait(self, answer: Awaitable[bytes]) -> None:
        await asyncio.sleep(0)  # at which it has stopped
        body = await answer
        self._task = None
        self._reply(body)
        self._advance()

    def _reply(self, body: bytes) -> None:
        self.requests.reserved = 0
        if self._transport.is_closing():
            return
        self._transport.write(response_head(200, len(body), close=self._closing) + body)
        if self._closing:
            self._close()
        else:
            self._expect(limits.HTTP_REQUEST_TIMEOUT if self.requests.receiving else limits.HTTP_IDLE_TIMEOUT)

    def _reject(self, request: HttpRequest) -> None:
        """Answer with an HTTP error and half-close; reading goes on for a moment: closing would lose the answer."""
        if not self._transport.is_closing():
            body = f"{request.refusal}\n".encode()
            self._transport.write(response_head(request.status, len(body), close=True) + body)
            self._transport.write_eof()
            self.requests.receiving = False
            self._expect(runtime_limits.DRAIN_TIMEOUT)

    def close_when_answered(self) -> None:
        """Close now, or after the answer to the call under way."""
        self._closing = True
        if self._task is None:
            self._close()

    def _close(self) -> None:
        # Written data is still sent, but a client that does not read it cannot hold the socket for long.
        self._transport.close()
        self._expect(limits.HTTP_REQUEST_TIMEOUT)

    def reset(self) -> None:
        """Close at once, and tell the client by a reset."""
        self._transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        self.abort()

    def abort(self) -> None:
        """Close at once."""
        self._closing = True
        self._transport.abort()


class XmlRpcServer:
    """Listens at one address and hands each call to ``handler``, in the loop.

    Args:
        handler: Answers the calls; those of one connection one at a time and in order.
        host: Numeric address or name to listen at.
        port: 0 lets the system choose.
        counters: Count refusals (``http.*``, ``xmlrpc.*``) and calls.
        name: The server, for messages: ``ROS core``, ``node /talker``.
        use: The purpose of its connections, which decides whether they may take the last file descriptors.
    """

    def __init__(
        self,
        handler: Handler,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        counters: Counters | None = None,
        name: str = "XML-RPC server",
        use: Use = Use.DATA,
    ) -> None:
        self._handler = handler
        self._address = (host, port)
        self._name = name
        self.counters = counters if counters is not None else Counters()
        self._refusals = RefusalLog(_log, self.counters)
        self._use = use
        self._acceptor: Acceptor | None = None
        self._arriving = OwnedTasks()
        # In the order of their last use, which ``_evict`` needs.
        self._connections: dict[HttpConnection, None] = {}
        self._empty: asyncio.Future[None] | None = None
        self.port = 0

    async def start(self) -> None:
        """Listen.

        Raises:
            StartError: The address is in use, not of this machine, or not allowed.
        """
        sock = await listen(self._name, *self._address, self._use)
        self.port = sock.getsockname()[1]
        self._acceptor = Acceptor(
            sock,
            self.adopt,
            name=self._name,
            use=self._use,
            at_once=_HTTP_ACCEPTS,
            make_room=self._evict,
        )
        self._acceptor.start()
        _log.info("= %s listens at %s:%d", self._name, self._address[0], self.port)

    def adopt(self, sock: socket.socket, _client: tuple[str, int]) -> None:
        """Serve an accepted connection, of this server's own socket or of one that several nodes share.

        Args:
            sock: Non-blocking; owned from here on.
        """
        self._arriving.start(self._connect(sock), f"serve a connection of {self._name}", raises=(OSError,))

    async def _connect(self, sock: socket.socket) -> None:
        try:
            await asyncio.get_running_loop().connect_accepted_socket(lambda: HttpConnection(self), sock)
        except BaseException:
            sock.close()
            raise

    async def close(self) -> None:
        """Stop listening; wait up to ``runtime.limits.DRAIN_TIMEOUT`` for calls under way; close all connections."""
        if self._acceptor is not None:
            self._acceptor.close()
            self._acceptor = None
        if self._arriving:
            await asyncio.wait(self._arriving)
        for connection in list(self._connections):
            connection.close_when_answered()
        if self._connections:
            self._empty = asyncio.get_running_loop().create_future()
            await asyncio.wait([self._empty], timeout=runtime_limits.DRAIN_TIMEOUT)
        for connection in list(self._connections):
            connection.abort()

    def admit(self, connection: HttpConnection) -> bool:
        """Whether there is room for a new connection; another one may be closed for it."""
        if len(self._connections) >= limits.HTTP_CONNECTIONS_MAX and not self._evict():
            self.refuse("http.refused.connections", connection, "all connections are busy; this one is refused")
            return False
        self._connections[connection] = None
        return True

    def _evict(self) -> bool:
        """Close a connection for a new one; return whether there is one that is not being answered.

        Of ``_EVICTED_OF`` that were not used for longest it is the slowest of those below ``_HTTP_PACE_MIN``; else
        the one that is idle for longest, whose client reconnects by itself; else the slowest.
        """
        now = asyncio.get_running_loop().time()
        oldest = list(islice((one for one in self._connections if not one.answering), _EVICTED_OF))
        idle = next((one for one in oldest if one.idle), None)
        slow = [one for one in oldest if not one.idle and one.slow(now)]
        evicted = min(slow or oldest, key=lambda one: one.pace(now), default=None)
        if idle is not None and not slow:
            evicted = idle
        if evicted is not None:
            self._give_up(evicted)
        return evicted is not None

    def _give_up(self, connection: HttpConnection) -> None:
        """Close a connection for another one; the client of an idle one reconnects by itself."""
        if connection.idle:
            self.counters.add("http.evicted")
        else:
            text = "a call that came too slowly, or an answer that was not read, gave way to others"
            self.refuse("http.evicted.slow", connection, f"{text}; is a program stopped, or a port scanner at work?")
        self.remove(connection)
        connection.abort()

    def reserve(self, connection: HttpConnection, size: int) -> bool:
        """Whether there is room for a call of ``size`` bytes, which stays reserved until it is answered.

        The slowest other calls are closed for it.
        """
        now = asyncio.get_running_loop().time()
        while sum(one.requests.reserved for one in self._connections) + size > limits.HTTP_BODIES_MAX:
            slow = [one for one in self._connections if one.requests.reserved and not one.answering and one.slow(now)]
            slowest = min(slow, key=lambda one: one.pace(now), default=connection)
            if slowest is connection:
                return False
            self._give_up(slowest)
        return True

    def touch(self, connection: HttpConnection) -> None:
        """Put a connection that is used last in the order of use."""
        if connection in self._connections:
            del self._connections[connection]
            self._connections[connection] = None

    def remove(self, connection: HttpConnection) -> None:
        """Forget a closed connection."""
        self._connections.pop(connection, None)
        if self._empty is not None and not self._connections and not self._empty.done():
            self._empty.set_result(None)

    def refuse(self, name: str, connection: HttpConnection, text: str) -> None:
        """Count a refusal by its name, and log it."""
        now = asyncio.get_running_loop().time()
        self._refusals.refuse(now, name, connection.client, f"{self._name}: {connection.client}: {text}")

    async def answer(self, body: memoryview, connection: HttpConnection) -> bytes:
        """Answer one call: without waiting, unless the handler has to wait, or there is much to read or write."""
        try:
            method, params = (await read_large(slices(body))).call()
        except RemoteProtocolError as error:
            self.refuse("xmlrpc.malformed", connection, f"refused a call: {error}")
            return serialize_fault(1, str(error))
        self.counters.add("xmlrpc.calls")
        if _log.isEnabledFor(logging.DEBUG):
            _log.debug("< %s %s%s", connection.client, method, brief(params))
        try:
            value = self._handler(method, params)
            if isinstance(value, Awaitable):
                await asyncio.sleep(0)  # so that a task awaits it: see ``_take``
                value = await value
            return await _written(value)
        except ResetConnection:
            connection.reset()
            return b""
        except RosFault as fault:
            return serialize_fault(fault.number, fault.text)
        except Exception as error:  # noqa: BLE001 - the top of a call: the caller gets an answer in any case
            self.counters.add("xmlrpc.failed")
            _log.error("! %s: %s failed", self._name, method, exc_info=error)
            return serialize_fault(1, f"{method} failed here: {type(error).__name__}: {error}")


async def _written(value: XmlRpcValue) -> bytes:
    """The document of a response; other callbacks run between the pieces of a large one.

    Raises:
        LocalProtocolError: The value cannot be written.
    """
    pieces: list[bytes] = []
    size = 0
    for piece in response_pieces(value):
        pieces.append(piece)
        size += len(piece)
        if size > limits.HTTP_BODY_INLINE:
            await asyncio.sleep(0)
        else:
            yield_to_data()
    return b"".join(pieces)


class _Begun:
    """A coroutine that has stopped at an ``asyncio.sleep(0)``, to be awaited for the rest of it."""

    def __init__(self, coroutine: Coroutine[Any, Any, bytes]) -> None:
        self._coroutine = coroutine

    def __await__(self) -> Generator[Any, None, bytes]:
        return self._coroutine.__await__()


async def listen(name: str, host: str, port: int, use: Use) -> socket.socket:
    """Open a listening socket; ``host`` may be empty for all addresses.

    Raises:
        StartError: The address is in use, not of this machine, or not allowed.
    """
    try:
        address = host, port
        if host.strip("0123456789."):  # a name
            loop = asyncio.get_running_loop()
            found = await loop.getaddrinfo(host, port, family=socket.AF_INET, type=socket.SOCK_STREAM)
            address = str(found[0][4][0]), port
        with contextlib.ExitStack() as on_error:
            sock = on_error.enter_context(DESCRIPTORS.open_socket(use, what=name))
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(address)
            sock.listen(_HTTP_BACKLOG)
            on_error.pop_all()
    except OSError as error:
        owner = await asyncio.to_thread(program_at, port) if error.errno == errno.EADDRINUSE else ""
        problems = {
            errno.EADDRINUSE: (
                f"port {port} is already in use" + (f" by {owner}" if owner else ""),
                "end that program (another core?) or choose another port",
            ),
            errno.EACCES: ("this user may not use that port", "choose a port above 1023"),
            errno.EPERM: ("this user may not use that port", "choose a port above 1023"),
            errno.EADDRNOTAVAIL: ("this machine does not have that address", "choose one that `ip addr` shows"),
            errno.EMFILE: ("no file descriptors left", open_files_advice()),
        }
        problem = problems.get(error.errno or 0, (error.strerror or str(error), ""))
        raise StartError(f"{name} at {host}:{port}", *problem, code="port-in-use") from error
    return sock
