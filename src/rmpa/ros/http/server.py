"""An XML-RPC server: POST to any path, each response in one piece, all sizes and times bounded.

``ros.wire.http`` parses HTTP, ``ros.wire.xmlrpc`` the bodies. The server fits ROS's existing clients: XmlRpc++ wants
``Content-length`` and no chunks; Python keeps its connections open for as long as its threads live.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterator
from typing import TYPE_CHECKING

from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.ros import limits
from rmpa.ros.http import eviction, listen
from rmpa.ros.http.connection import HttpConnection
from rmpa.ros.http.documents import read_large, read_small, slices
from rmpa.ros.wire.xmlrpc import CallReader, RosFault, XmlRpcValue, brief, response_pieces, serialize_fault
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import Acceptor, Use
from rmpa.runtime.loop import yield_to_data

if TYPE_CHECKING:
    import socket

_log = logging.getLogger(__name__)

Handler = Callable[[str, tuple[XmlRpcValue, ...], str], XmlRpcValue | Awaitable[XmlRpcValue]]
"""``(method, params, address of the client) -> value``, at once or awaited.

A ``RosFault`` raised becomes a fault. ``ResetConnection``, raised at once, resets the connection.
"""


class ResetConnection(Exception):  # noqa: N818 - the name says what the handler wants
    """Raised by a handler: the call's connection is reset, as by a port where no process listens."""


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
        self._host = host
        self._wanted_port = port
        self._name = name
        self.counters = counters if counters is not None else Counters()
        self._refusals = RefusalLog(_log, self.counters)
        self._use = use
        self._acceptor: Acceptor | None = None
        self._arriving: set[asyncio.Task[None]] = set()
        # In the order of their last use, which ``eviction.for_newcomer`` needs.
        self._connections: dict[HttpConnection, None] = {}
        self.port = 0
        """The listening port; 0 before ``start``."""

    @property
    def connections(self) -> int:
        """Open connections."""
        return len(self._connections)

    async def start(self) -> None:
        """Listen.

        Raises:
            StartError: The address is in use, not of this machine, or not allowed.
        """
        sock = await listen.listen(self._name, self._host, self._wanted_port, self._use)
        self.port = sock.getsockname()[1]
        self._acceptor = Acceptor(
            sock,
            self.adopt,
            name=self._name,
            use=self._use,
            at_once=limits.HTTP_ACCEPTS,
            make_room=self._evict,
        )
        self._acceptor.start()
        _log.info("= %s listens at %s:%d", self._name, self._host, self.port)

    def adopt(self, sock: socket.socket, _client: tuple[str, int]) -> None:
        """Serve an accepted connection, of this server's own socket or of one that several nodes share.

        Args:
            sock: Non-blocking; owned from here on.
        """
        task = asyncio.get_running_loop().create_task(self._connect(sock))
        self._arriving.add(task)
        task.add_done_callback(self._arriving.discard)

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
        gone = [connection.gone for connection in self._connections]
        if gone:
            await asyncio.wait(gone, timeout=runtime_limits.DRAIN_TIMEOUT)
        for connection in list(self._connections):
            connection.abort()

    # --- http.connection.HttpConnectionOwner -------------------------------------------------------------------

    def admit(self, connection: HttpConnection) -> bool:
        """Whether there is room for a new connection; another one may be closed for it."""
        if len(self._connections) >= limits.HTTP_CONNECTIONS_MAX and not self._evict():
            self.refuse("http.refused.connections", connection, "all connections are busy; this one is refused")
            return False
        self._connections[connection] = None
        return True

    def _evict(self) -> bool:
        """Close a connection for a new one, if there is one that is idle or slow."""
        evicted = eviction.for_newcomer(self._connections, asyncio.get_running_loop().time())
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
        """Whether there is room for a large call, which stays reserved until it is answered."""
        now = asyncio.get_running_loop().time()
        while sum(one.reserved for one in self._connections) + size > limits.HTTP_BODIES_MAX:
            slow = eviction.for_call(self._connections, now)
            if slow is None or slow is connection:
                return False
            self._give_up(slow)
        return True

    def touch(self, connection: HttpConnection) -> None:
        """Put a connection last in the order of use."""
        if connection in self._connections:
            del self._connections[connection]
            self._connections[connection] = None

    def remove(self, connection: HttpConnection) -> None:
        """Forget a closed connection."""
        self._connections.pop(connection, None)

    def refuse(self, name: str, connection: HttpConnection, text: str) -> None:
        """Count a refusal by its name, and log it."""
        now = asyncio.get_running_loop().time()
        self._refusals.refuse(now, name, connection.client, f"{self._name}: {connection.client}: {text}")

    def answer(self, body: memoryview, connection: HttpConnection) -> bytes | Awaitable[bytes]:
        """Answer one call: at once, unless the handler has to wait, or there is much to read or write."""
        if len(body) > limits.HTTP_BODY_INLINE:
            return self._answer_large(body, connection)
        try:
            method, params = read_small(CallReader(), body)
        except RemoteProtocolError as error:
            return self._malformed(error, connection)
        return self._dispatch(method, params, connection)

    async def _answer_large(self, body: memoryview, connection: HttpConnection) -> bytes:
        try:
            method, params = await read_large(CallReader(), slices(body))
        except RemoteProtocolError as error:
            return self._malformed(error, connection)
        answer = self._dispatch(method, params, connection)
        return answer if isinstance(answer, bytes) else await answer

    def _malformed(self, error: RemoteProtocolError, connection: HttpConnection) -> bytes:
        self.refuse("xmlrpc.malformed", connection, f"refused a call: {error}")
        return serialize_fault(1, str(error))

    def _dispatch(
        self, method: str, params: tuple[XmlRpcValue, ...], connection: HttpConnection
    ) -> bytes | Awaitable[bytes]:
        self.counters.add("xmlrpc.calls")
        if _log.isEnabledFor(logging.DEBUG):
            _log.debug("< %s %s%s", connection.client, method, brief(params))
        try:
            value = self._handler(method, params, connection.client)
        except ResetConnection:
            connection.reset()
            return b""
        except Exception as error:  # noqa: BLE001 - the top of a call: the caller gets an answer in any case
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
