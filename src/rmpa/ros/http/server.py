"""An XML-RPC server on h11: POST to any path, one response in one piece, everything bounded.

``ros.wire.http_head`` knows the requests of rospy and roscpp, h11 speaks HTTP/1.1 (RFC 9112) with everybody else,
``ros.wire.xmlrpc`` reads the bodies. Made for clients as they are: XmlRpc++ wants ``Content-length`` and no chunks,
Python keeps its connections open for as long as its threads live.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable, Iterator
from typing import Final

import h11

from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.ros import limits
from rmpa.ros.http import eviction, listen
from rmpa.ros.wire.call_body import CallBody
from rmpa.ros.wire.http_head import REASONS, Head, plain_head
from rmpa.ros.wire.xmlrpc import CallReader, RosFault, XmlRpcValue, brief, response_pieces, serialize_fault
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.acceptor import Acceptor
from rmpa.runtime.descriptors import DESCRIPTORS, Use
from rmpa.runtime.event_loop import yield_to_data

_log = logging.getLogger(__name__)

Handler = Callable[[str, tuple[XmlRpcValue, ...], str], XmlRpcValue | Awaitable[XmlRpcValue]]
"""``(method, params, address of the client) -> value``, at once or awaited; a ``RosFault`` raised becomes a fault."""


class XmlRpcServer:
    """Listens at one address and hands each call to ``handler``, in the loop.

    Args:
        handler: Answers the calls; of one connection one at a time and in order.
        host: Numeric address or name to listen at.
        port: 0 lets the system choose.
        counters: Where refusals (``http.*``, ``xmlrpc.*``) and calls are counted.
        name: What listens here, for messages: ``ROS core``, ``node /talker``.
        use: What its connections are for: whether they may take the last file descriptors.
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
        self._host = host
        self._wanted_port = port
        self._name = name
        self.counters = counters if counters is not None else Counters()
        self._refusals = RefusalLog(_log, self.counters)
        self._use = use
        self._acceptor: Acceptor | None = None
        self._arriving: set[asyncio.Task[None]] = set()
        # In the order of their last use, so that the first idle one is the one to give up.
        self._connections: dict[_Connection, None] = {}
        self.port = 0
        """The port that it listens at; 0 before ``start``."""

    @property
    def connections(self) -> int:
        """Open connections."""
        return len(self._connections)

    async def start(self) -> None:
        """Listen.

        Raises:
            StartError: The address is in use, not ours, or not allowed.
        """
        sock = await listen.listen(self._name, self._host, self._wanted_port, self._use)
        self.port = sock.getsockname()[1]
        self._acceptor = Acceptor(sock, self.adopt, name=self._name, use=self._use, at_once=limits.HTTP_ACCEPTS)
        self._acceptor.start()
        _log.info("= %s listens at %s:%d", self._name, self._host, self.port)

    def adopt(self, sock: socket.socket, _client: tuple[str, int]) -> None:
        """Serve a connection that was accepted, by this server's own socket or by one that several nodes share.

        Args:
            sock: Non-blocking; owned from here on.
        """
        task = asyncio.get_running_loop().create_task(self._connect(sock))
        self._arriving.add(task)
        task.add_done_callback(self._arriving.discard)

    async def _connect(self, sock: socket.socket) -> None:
        try:
            await asyncio.get_running_loop().connect_accepted_socket(lambda: _Connection(self), sock)
        except BaseException:
            sock.close()
            raise

    async def close(self) -> None:
        """Stop listening, let calls that are being answered finish (``limits.DRAIN_TIMEOUT``), close the rest."""
        if self._acceptor is not None:
            self._acceptor.close()
            self._acceptor = None
        if self._arriving:
            await asyncio.wait(self._arriving)
        for connection in list(self._connections):
            connection.close_when_answered()
        gone = [connection.gone for connection in self._connections]
        if gone:
            await asyncio.wait(gone, timeout=runtime_limits.DRAIN_TIMEOUT)
        for connection in list(self._connections):
            connection.abort()

    # --- what connections ask of their server -----------------------------------------------------------------

    def _joined(self, connection: _Connection) -> bool:
        if len(self._connections) >= limits.HTTP_CONNECTIONS_MAX:
            evicted = eviction.for_newcomer(self._connections, asyncio.get_running_loop().time())
            if evicted is None:
                self._refuse("http.refused.connections", connection, "all connections are busy; this one is refused")
                return False
            self._give_up(evicted)
        if not self._connections:
            DESCRIPTORS.offer(self, self._close_idle)
        self._connections[connection] = None
        return True

    def _give_up(self, connection: _Connection) -> None:
        """Close a connection for one that needs its place; an idle one's client connects anew without a word."""
        if connection.idle:
            self.counters.add("http.evicted")
        else:
            text = "a call that came too slowly, or an answer that was not read, gave way to others"
            self._refuse("http.evicted.slow", connection, f"{text}; is a program stopped, or a port scanner at work?")
        self._left(connection)
        connection.abort()

    def _reserve(self, connection: _Connection, size: int) -> bool:
        """Whether there is room for a large call, which is set aside until it is answered."""
        now = asyncio.get_running_loop().time()
        while sum(one.reserved for one in self._connections) + size > limits.HTTP_BODIES_MAX:
            slow = eviction.for_call(self._connections, now)
            if slow is None or slow is connection:
                return False
            self._give_up(slow)
        return True

    def _used(self, connection: _Connection) -> None:
        if connection in self._connections:
            del self._connections[connection]
            self._connections[connection] = None

    def _left(self, connection: _Connection) -> None:
        self._connections.pop(connection, None)
        if not self._connections:
            DESCRIPTORS.offer(self, None)

    def _close_idle(self) -> bool:
        """Close a connection whose client has had its answer, for one that waits for a descriptor elsewhere."""
        before = asyncio.get_running_loop().time() - limits.HTTP_IDLE_MIN
        for connection in self._connections:
            if connection.answered is not None and connection.answered < before and connection.idle:
                connection.abort()
                return True
        return False

    def _refuse(self, name: str, connection: _Connection, text: str) -> None:
        now = asyncio.get_running_loop().time()
        self._refusals.refuse(now, name, connection.client, f"{self._name}: {connection.client}: {text}")

    def _answer(self, body: bytes | memoryview, connection: _Connection) -> bytes | Awaitable[bytes]:
        """The response to one call, at once unless the handler has to wait, or there is much to read or write."""
        if len(body) > limits.HTTP_BODY_INLINE:
            return self._answer_large(body, connection)
        reader = CallReader()
        try:
            for begin in range(0, len(body), limits.XMLRPC_SLICE):
                reader.feed(body[begin : begin + limits.XMLRPC_SLICE])
                yield_to_data()
            method, params = reader.close()
        except RemoteProtocolError as error:
            return self._malformed(error, connection)
        return self._dispatch(method, params, connection)

    async def _answer_large(self, body: bytes | memoryview, connection: _Connection) -> bytes:
        # Not in a thread: one that computes takes the interpreter from the loop for milliseconds at a time.
        reader = CallReader()
        try:
            for begin in range(0, len(body), limits.XMLRPC_SLICE):
                reader.feed(body[begin : begin + limits.XMLRPC_SLICE])
                await asyncio.sleep(0)
            method, params = reader.close()
        except RemoteProtocolError as error:
            return self._malformed(error, connection)
        except asyncio.CancelledError:
            reader.abandon()
            raise
        answer = self._dispatch(method, params, connection)
        return answer if isinstance(answer, bytes) else await answer

    def _malformed(self, error: RemoteProtocolError, connection: _Connection) -> bytes:
        self._refuse("xmlrpc.malformed", connection, f"refused a call: {error}")
        return serialize_fault(1, str(error))

    def _dispatch(
        self, method: str, params: tuple[XmlRpcValue, ...], connection: _Connection
    ) -> bytes | Awaitable[bytes]:
        self.counters.add("xmlrpc.calls")
        if _log.isEnabledFor(logging.DEBUG):
            _log.debug("< %s %s%s", connection.client, method, brief(params))
        try:
            value = self._handler(method, params, connection.client)
        except Exception as error:  # noqa: BLE001 - the top of a call: whatever it is, the caller gets an answer
            return self._failed(method, error)
        if isinstance(value, Awaitable):
            return self._answer_later(method, value)
        return self._respond(method, value)

    async def _answer_later(self, method: str, value: Awaitable[XmlRpcValue]) -> bytes:
        try:
            answer = self._respond(method, await value)
        except Exception as error:  # noqa: BLE001 - as above
            return self._failed(method, error)
        return answer if isinstance(answer, bytes) else await answer

    def _respond(self, method: str, value: XmlRpcValue) -> bytes | Awaitable[bytes]:
        written: list[bytes] = []
        size = 0
        rest = response_pieces(value)
        try:
            for piece in rest:
                written.append(piece)
                size += len(piece)
                if size > limits.HTTP_BODY_INLINE:
                    return self._respond_large(method, written, rest)
                yield_to_data()
        except LocalProtocolError as error:
            return self._failed(method, error)
        return b"".join(written)

    async def _respond_large(self, method: str, written: list[bytes], rest: Iterator[bytes]) -> bytes:
        try:
            for piece in rest:
                written.append(piece)
                await asyncio.sleep(0)
        except LocalProtocolError as error:
            return self._failed(method, error)
        return b"".join(written)

    def _failed(self, method: str, error: Exception) -> bytes:
        if isinstance(error, RosFault):
            return serialize_fault(error.code, error.text)
        self.counters.add("xmlrpc.failed")
        _log.error("! %s: %s failed", self._name, method, exc_info=error)
        return serialize_fault(1, f"{method} failed here: {type(error).__name__}: {error}")


class _Connection(asyncio.Protocol):
    """One client: bytes to h11 unless they are plain, bodies to the server's ``_answer``, one answer at a time."""

    def __init__(self, server: XmlRpcServer) -> None:
        self._server = server
        self._loop = asyncio.get_running_loop()
        # From the first request on that is not plain.
        self._http: h11.Connection | None = None
        self._unread = bytearray()
        self._head: Head | None = None
        self._plain = False
        self._transport: asyncio.Transport | None = None
        self._body = CallBody(lambda size: server._reserve(self, size))  # noqa: SLF001 - two halves of one thing
        self._task: asyncio.Task[None] | None = None
        self._more: asyncio.Handle | None = None
        self._closing = False
        self._deadline = 0.0
        self.begun = self._loop.time()
        self._timer: asyncio.TimerHandle | None = None
        self._receiving = False
        self.gone: asyncio.Future[None] = self._loop.create_future()
        self.client = "?"
        self.answered: float | None = None
        """When the last answer was written, by the loop's clock."""

    @property
    def idle(self) -> bool:
        """Whether no request is on its way in and no answer on its way out."""
        return not self._receiving and self._task is None and self._transport is not None and not self._pending()

    @property
    def answering(self) -> bool:
        """Whether a call has come and is being answered."""
        return self._task is not None

    @property
    def reserved(self) -> int:
        """Bytes set aside for its call."""
        return self._body.reserved

    @property
    def received(self) -> int:
        """Bytes of an unfinished call that have come; 0 while an answer is not read."""
        return len(self._unread) + len(self._body) if self._receiving else 0

    def _begin(self) -> None:
        """A call has begun to come."""
        self._receiving = True
        self._expect(limits.HTTP_REQUEST_TIMEOUT)
        self.begun = self._deadline - limits.HTTP_REQUEST_TIMEOUT

    def _pending(self) -> int:
        return self._transport.get_write_buffer_size() if self._transport is not None else 0

    # --- asyncio's side ---------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - a TCP server's is one; for mypy
        self._transport = transport
        peer = transport.get_extra_info("peername")
        self.client = peer[0] if peer else "?"
        if not self._server._joined(self):  # noqa: SLF001 - two halves of one thing
            transport.abort()
            return
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._expect(limits.HTTP_REQUEST_TIMEOUT)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - asyncio's interface
        self._server._left(self)  # noqa: SLF001
        if self._timer is not None:
            self._timer.cancel()
        if self._task is not None:
            self._task.cancel()
        if not self.gone.done():
            self.gone.set_result(None)

    def data_received(self, data: bytes) -> None:
        if self._closing and self._task is None:
            return  # the rest of a refused request
        if self._http is None:
            self._unread += data
            if self._task is None:
                self._take()
        else:
            self._http.receive_data(data)
            self._advance(self._http)

    def eof_received(self) -> bool:
        if self._closing and self._task is None:
            return False
        self._hand_over(end=True)
        # A client may half-close behind its request; it still gets its answer.
        return self._task is not None or self._more is not None

    def pause_writing(self) -> None:
        if self._transport is not None:
            self._transport.pause_reading()

    def resume_writing(self) -> None:
        if self._transport is not None and self._task is None:
            self._transport.resume_reading()

    def _expect(self, seconds: float) -> None:
        """Something must happen within this time, or the connection is closed."""
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
            if self._receiving:
                self._server._refuse("http.timeout", self, "a request was not finished in time")  # noqa: SLF001
            self.abort()

    # --- plain requests ---------------------------------------------------------------------------------------

    def _take(self) -> None:
        """Take a plain request if it is whole; leave the connection to h11 if it is none."""
        if not self._unread:
            return
        if self._head is None:
            self._head = plain_head(self._unread)
            if self._head is None:
                self._hand_over()
                return
            self._begin()
            if self._head.length > limits.HTTP_BODY_INLINE and not self._body.expect(self._head.length):
                self._hand_over()
                return
        missing = self._head.end + self._head.length - len(self._unread)
        if missing < 0:  # the next one is right behind it
            self._hand_over()
        elif missing == 0:
            # A view, and another buffer for what comes next: to copy a large one would hold up data.
            body = memoryview(self._unread)[self._head.end :]
            self._unread = bytearray()
            self._closing, self._plain, self._head = self._head.close, True, None
            self._call(body)

    def _hand_over(self, *, end: bool = False) -> None:
        """To h11, from now on: all that was not taken yet, and perhaps the end of it."""
        if self._http is None:
            self._http = h11.Connection(h11.SERVER, max_incomplete_event_size=limits.HTTP_HEADERS_MAX)
        if self._unread:
            self._http.receive_data(bytes(self._unread))
            self._unread.clear()
            self._head = None
        if end:
            self._http.receive_data(b"")
        self._advance(self._http)

    # --- h11's side -------------------------------------------------------------------------------------------

    def _advance(self, http: h11.Connection) -> None:
        """Take what h11 has, up to the end of the next request that has to wait."""
        while self._task is None and not self._closing:
            yield_to_data()
            try:
                event = http.next_event()
            except h11.RemoteProtocolError as error:
                self._reject(error.error_status_hint, str(error), "http.malformed")
                return
            match event:
                case h11.Request():
                    self._begin()
                    if not self._accepts(event, http):
                        return
                case h11.Data(data=data):
                    self._body.add(data)
                case h11.EndOfMessage():
                    self._take_end()
                    if http.trailing_data[0] and self._task is None:
                        self._more = self._loop.call_soon(self._go_on, http)
                        return
                case h11.ConnectionClosed():
                    self.close_when_answered()
                    return
                case _:  # NEED_DATA or PAUSED
                    if event is h11.NEED_DATA and not self._receiving and http.trailing_data[0]:
                        self._begin()
                    return

    def _go_on(self, http: h11.Connection) -> None:
        """Take the next call of those that came in one go; others had a turn before it."""
        self._more = None
        if not self.gone.done():
            self._advance(http)

    def _accepts(self, request: h11.Request, http: h11.Connection) -> bool:
        if request.method != b"POST":
            self._reject(405, f"{request.method.decode('ascii')}: XML-RPC is called by POST only", "http.method")
            return False
        for name, value in request.headers:
            if name == b"content-length":
                self._body.expect(int(value))
                if int(value) > limits.HTTP_DISCARDED_MAX:
                    self._reject(413, f"a body of {int(value)} bytes, above {limits.HTTP_BODY_MAX}", "http.too_large")
                    return False
            if name == b"content-encoding" and value.lower() != b"identity":
                self._reject(415, "an encoded body; send it as it is", "http.encoding")
                return False
        if http.they_are_waiting_for_100_continue:
            if self._body.refused:
                self._reject(413, f"a body of more than {limits.HTTP_BODY_MAX} bytes", "http.too_large")
                return False
            self._write(http, h11.InformationalResponse(status_code=100, headers=[], reason=b"Continue"))
        return True

    def _take_end(self) -> None:
        """A body is whole."""
        body, refusal = self._body.end()
        if not refusal:
            self._call(body)
            return
        self._receiving = False
        self._server._used(self)  # noqa: SLF001 - two halves of one thing
        self._server._refuse("http.too_large", self, refusal)  # noqa: SLF001
        self._reply(200, serialize_fault(-1, refusal))

    # --- answers ----------------------------------------------------------------------------------------------

    def _call(self, body: memoryview) -> None:
        self._receiving = False
        self._server._used(self)  # noqa: SLF001
        yield_to_data()
        answer = self._server._answer(body, self)  # noqa: SLF001
        yield_to_data()
        if isinstance(answer, bytes):
            self._body.answered()
            self._reply(200, answer)
            return
        if self._transport is not None:
            self._transport.pause_reading()
        self._task = self._loop.create_task(self._wait(answer))

    async def _wait(self, answer: Awaitable[bytes]) -> None:
        body = await answer
        self._task = None
        self._body.answered()
        self._reply(200, body)
        if self._transport is not None and not self._closing:
            self._transport.resume_reading()
            if self._http is None:
                self._take()
            else:
                self._advance(self._http)

    def _reply(self, status: int, body: bytes) -> None:
        if self._transport is None or self._transport.is_closing():
            return
        self.answered = self._loop.time()
        if self._plain or self._http is None:
            self._plain = False
            close = b"Connection: close\r\n" if self._closing else b""
            self._transport.write(_PLAIN_REPLY % (len(body), close) + body)
            if self._closing:
                self._close()
            else:
                self._expect(limits.HTTP_IDLE_TIMEOUT)
            return
        self._reply_by(self._http, status, body)

    def _reply_by(self, http: h11.Connection, status: int, body: bytes) -> None:
        headers = [
            (b"Server", b"rmpa"),
            (b"Content-Type", b"text/xml" if status == 200 else b"text/plain; charset=utf-8"),
            (b"Content-length", str(len(body)).encode("ascii")),
        ]
        if status != 200 or self._closing:
            headers.append((b"Connection", b"close"))
        self._write(
            http,
            h11.Response(status_code=status, headers=headers, reason=REASONS.get(status, b"Refused")),
            h11.Data(data=body),
            h11.EndOfMessage(),
        )
        if http.our_state is h11.DONE and http.their_state is h11.DONE and not self._closing:
            http.start_next_cycle()
            self._expect(limits.HTTP_IDLE_TIMEOUT)
        elif status == 200:
            self._close()

    def _write(self, http: h11.Connection, *events: h11.Event) -> None:
        assert self._transport is not None  # noqa: S101 - for mypy: nothing is received before
        self._transport.write(b"".join(http.send(event) or b"" for event in events))

    def _reject(self, status: int, text: str, name: str) -> None:
        self._server._refuse(name, self, text)  # noqa: SLF001
        if self._http is not None and self._http.our_state in {h11.IDLE, h11.SEND_RESPONSE}:
            self._closing = True
            if self._transport is not None and not self._transport.is_closing():
                self._reply_by(self._http, status, f"{text}\n".encode())
            self._linger()
        else:
            self._close()

    def _linger(self) -> None:
        """End our half and read on for a moment: closing over unread bytes would take the answer back."""
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write_eof()
            self._receiving = False
            self._expect(runtime_limits.DRAIN_TIMEOUT)

    # --- the end ----------------------------------------------------------------------------------------------

    def close_when_answered(self) -> None:
        """Close now, or behind the answer that is on its way."""
        self._closing = True
        if self._task is None:
            self._close()

    def _close(self) -> None:
        self._closing = True
        if self._transport is not None:
            # What is written still leaves, but a client that does not read it cannot hold the socket.
            self._transport.close()
            self._expect(limits.HTTP_REQUEST_TIMEOUT)

    def abort(self) -> None:
        """Close at once."""
        self._closing = True
        if self._transport is not None:
            self._transport.abort()


_PLAIN_REPLY: Final = b"HTTP/1.1 200 OK\r\nServer: rmpa\r\nContent-Type: text/xml\r\nContent-length: %d\r\n%s\r\n"
