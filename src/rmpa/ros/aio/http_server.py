"""An XML-RPC server on h11: POST to any path, one response in one piece, everything bounded.

``ros.http_head`` knows the requests of rospy and roscpp, h11 speaks HTTP/1.1 (RFC 9112) with everybody else,
``ros.xmlrpc`` reads the bodies. Made for clients as they are: XmlRpc++ wants ``Content-length`` and no chunks, Python
keeps its connections open for as long as its threads live.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections.abc import Awaitable, Callable, Iterator
from typing import Final

import h11

from rmpa.core import limits
from rmpa.core.aio.loop import breathe
from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import LocalProtocolError, RemoteProtocolError, StartError
from rmpa.ros.http_head import Head, plain_head
from rmpa.ros.xmlrpc import CallReader, RosFault, XmlRpcValue, brief, response_pieces, serialize_fault

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
    """

    def __init__(
        self,
        handler: Handler,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        counters: Counters | None = None,
        name: str = "XML-RPC server",
    ) -> None:
        self._handler = handler
        self._host = host
        self._wanted_port = port
        self._name = name
        self.counters = counters if counters is not None else Counters()
        self._refusals = RefusalLog(_log, self.counters)
        self._server: asyncio.Server | None = None
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
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(
                lambda: _Connection(self),
                self._host,
                self._wanted_port,
                family=socket.AF_INET,
                backlog=limits.HTTP_ACCEPTS,
            )
        except OSError as error:
            raise self._start_error(error) from error
        listening = self._server.sockets[0]
        self.port = listening.getsockname()[1]
        # asyncio accepts as many at once as may wait; more may wait than shall be accepted without a pause.
        with listening.dup() as same:
            same.listen(limits.HTTP_BACKLOG)
        _log.info("= %s listens at %s:%d", self._name, self._host, self.port)

    def _start_error(self, error: OSError) -> StartError:
        where = f"{self._name} at {self._host}:{self._wanted_port}"
        match error.errno:
            case errno.EADDRINUSE:
                return StartError(
                    where,
                    f"port {self._wanted_port} is already in use",
                    "end the program that listens there (another core?) or choose another port",
                )
            case errno.EACCES | errno.EPERM:
                return StartError(where, "this user may not use that port", "choose a port above 1023")
            case errno.EADDRNOTAVAIL:
                return StartError(where, "this machine does not have that address", "choose one that `ip addr` shows")
        return StartError(where, error.strerror or str(error))

    async def close(self) -> None:
        """Stop listening, let calls that are being answered finish (``limits.DRAIN_TIMEOUT``), close the rest."""
        if self._server is None:
            return
        self._server.close()
        for connection in list(self._connections):
            connection.close_when_answered()
        gone = [connection.gone for connection in self._connections]
        if gone:
            await asyncio.wait(gone, timeout=limits.DRAIN_TIMEOUT)
        for connection in list(self._connections):
            connection.abort()
        self._server = None

    # --- what connections ask of their server -----------------------------------------------------------------

    def _joined(self, connection: _Connection) -> bool:
        if len(self._connections) >= limits.HTTP_CONNECTIONS_MAX:
            idle = next((one for one in self._connections if one.idle), None)
            if idle is None:
                self._refuse("http.refused.connections", connection, "all connections are busy; this one is refused")
                return False
            self.counters.add("http.evicted")
            idle.abort()
        self._connections[connection] = None
        return True

    def _used(self, connection: _Connection) -> None:
        if connection in self._connections:
            del self._connections[connection]
            self._connections[connection] = None

    def _left(self, connection: _Connection) -> None:
        self._connections.pop(connection, None)

    def _refuse(self, name: str, connection: _Connection, text: str) -> None:
        now = asyncio.get_running_loop().time()
        self._refusals.refuse(now, name, connection.client, f"{self._name}: {connection.client}: {text}")

    def _answer(self, body: bytes, connection: _Connection) -> bytes | Awaitable[bytes]:
        """The response to one call, at once unless the handler has to wait, or there is much to read or write."""
        if len(body) > limits.HTTP_BODY_INLINE:
            return self._answer_large(body, connection)
        reader = CallReader()
        try:
            for begin in range(0, len(body), limits.XMLRPC_SLICE):
                reader.feed(body[begin : begin + limits.XMLRPC_SLICE])
                breathe()
            method, params = reader.close()
        except RemoteProtocolError as error:
            return self._malformed(error, connection)
        return self._dispatch(method, params, connection)

    async def _answer_large(self, body: bytes, connection: _Connection) -> bytes:
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
                breathe()
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
        self._body = bytearray()
        self._task: asyncio.Task[None] | None = None
        self._closing = False
        self._deadline = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._receiving = False
        self.gone: asyncio.Future[None] = self._loop.create_future()
        self.client = "?"

    @property
    def idle(self) -> bool:
        """Whether no request is on its way in and no answer on its way out."""
        return not self._receiving and self._task is None and self._transport is not None and not self._pending()

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
        return self._task is not None

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
            self._receiving = True
            self._expect(limits.HTTP_REQUEST_TIMEOUT)
        missing = self._head.end + self._head.length - len(self._unread)
        if missing < 0:  # the next one is right behind it
            self._hand_over()
        elif missing == 0:
            body = bytes(self._unread[self._head.end :])
            self._unread.clear()
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
            breathe()
            try:
                event = http.next_event()
            except h11.RemoteProtocolError as error:
                self._reject(error.error_status_hint, str(error), "http.malformed")
                return
            match event:
                case h11.Request():
                    self._receiving = True
                    self._expect(limits.HTTP_REQUEST_TIMEOUT)
                    if not self._accepts(event, http):
                        return
                case h11.Data(data=data):
                    if len(self._body) + len(data) > limits.HTTP_BODY_MAX:
                        self._reject(413, f"a body of more than {limits.HTTP_BODY_MAX} bytes", "http.too_large")
                        return
                    self._body += data
                case h11.EndOfMessage():
                    body = bytes(self._body)
                    self._body.clear()
                    self._call(body)
                case h11.ConnectionClosed():
                    self.close_when_answered()
                    return
                case _:  # NEED_DATA or PAUSED
                    if event is h11.NEED_DATA and not self._receiving and http.trailing_data[0]:
                        self._receiving = True
                        self._expect(limits.HTTP_REQUEST_TIMEOUT)
                    return

    def _accepts(self, request: h11.Request, http: h11.Connection) -> bool:
        if request.method != b"POST":
            self._reject(405, f"{request.method.decode('ascii')}: XML-RPC is called by POST only", "http.method")
            return False
        for name, value in request.headers:
            if name == b"content-length" and int(value) > limits.HTTP_BODY_MAX:
                self._reject(413, f"a body of {int(value)} bytes, above {limits.HTTP_BODY_MAX}", "http.too_large")
                return False
            if name == b"content-encoding" and value.lower() != b"identity":
                self._reject(415, "an encoded body; send it as it is", "http.encoding")
                return False
        if http.they_are_waiting_for_100_continue:
            self._write(http, h11.InformationalResponse(status_code=100, headers=[], reason=b"Continue"))
        return True

    # --- answers ----------------------------------------------------------------------------------------------

    def _call(self, body: bytes) -> None:
        self._receiving = False
        self._server._used(self)  # noqa: SLF001
        breathe()
        answer = self._server._answer(body, self)  # noqa: SLF001
        breathe()
        if isinstance(answer, bytes):
            self._reply(200, answer)
            return
        if self._transport is not None:
            self._transport.pause_reading()
        self._task = self._loop.create_task(self._wait(answer))

    async def _wait(self, answer: Awaitable[bytes]) -> None:
        body = await answer
        self._task = None
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
            h11.Response(status_code=status, headers=headers, reason=_REASONS.get(status, b"Refused")),
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
            self._expect(limits.DRAIN_TIMEOUT)

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
_REASONS: Final = {
    200: b"OK",
    400: b"Bad Request",
    405: b"Method Not Allowed",
    413: b"Content Too Large",
    415: b"Unsupported Media Type",
    431: b"Request Header Fields Too Large",
}
