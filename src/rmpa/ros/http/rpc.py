"""XML-RPC over HTTP: the server, the client, and the pages for browsers.

An XML-RPC server: POST to any path, each response in one piece, all sizes and times bounded.

``ros.wire.http`` parses HTTP, ``ros.wire.xmlrpc`` the bodies. The server fits ROS's existing clients: XmlRpc++ wants
``Content-length`` and no chunks; Python keeps its connections open for as long as its threads live.
"""

from __future__ import annotations

import asyncio
import errno
import functools
import ipaddress
import logging
import os
import socket
from collections.abc import Awaitable, Callable, Iterator
from typing import TYPE_CHECKING, Final, TypeVar, overload
from urllib.parse import urlsplit

from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import LocalProtocolError, OutOfDescriptors, RemoteProtocolError, UnreachableError
from rmpa.core.limits import KIB
from rmpa.ros import limits
from rmpa.ros.http import connection as eviction
from rmpa.ros.http import connection as listen
from rmpa.ros.http.connection import HttpConnection
from rmpa.ros.wire.http import ResponseParser, post_request
from rmpa.ros.wire.xmlrpc import (
    CallReader,
    ResponseReader,
    RosFault,
    RosReply,
    XmlRpcValue,
    brief,
    call_pieces,
    response_pieces,
    serialize_fault,
)
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import DESCRIPTORS, OUT_OF_DESCRIPTORS, Acceptor, Use
from rmpa.runtime.loop import yield_to_data, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.ros.wire.xmlrpc import DocumentReader


# Reads XML-RPC documents in slices of ``limits.XMLRPC_SLICE``; other pending data is served between two slices.
#
# A document of some MiB takes seconds to parse. It is not parsed in a thread, because a thread that computes takes
# the
# interpreter from the event loop for milliseconds at a time.


_T = TypeVar("_T")


@overload
def slices(document: Buffer) -> Iterator[Buffer]: ...
@overload
def slices(document: str) -> Iterator[str]: ...
def slices(document: Buffer | str) -> Iterator[Buffer | str]:
    """A document in slices."""
    for begin in range(0, len(document), limits.XMLRPC_SLICE):
        yield document[begin : begin + limits.XMLRPC_SLICE]


def read_small(reader: DocumentReader[_T], document: Buffer) -> _T:
    """Read a document of at most ``limits.HTTP_BODY_INLINE`` bytes; the errors are those of ``reader``."""
    for piece in slices(document):
        reader.feed(piece)
        yield_to_data()
    return reader.close()


async def read_large(reader: DocumentReader[_T], pieces: Iterable[Buffer]) -> _T:
    """Read a document of any size; after ``limits.HTTP_BODY_INLINE`` bytes other callbacks run between slices.

    Args:
        reader: Its errors are raised.
        pieces: Slices of the document.
    """
    size = 0
    try:
        for piece in pieces:
            reader.feed(piece)
            size += len(piece)
            if size > limits.HTTP_BODY_INLINE:
                await asyncio.sleep(0)
            else:
                yield_to_data()
    except BaseException:
        reader.abandon()
        raise
    return reader.close()


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


# XML-RPC calls to nodes and masters, each on a connection of its own.
#
# No connection is kept alive: each costs a Python node a thread, and opening one on loopback takes 50 microseconds.


__all__ = ["RosFault", "call", "call_api", "connect", "exchange", "is_own_name", "read_response", "split_uri"]


_CHUNK: Final = 64 * KIB
_LOOPBACK: Final = "127.0.0.1"


@functools.lru_cache(maxsize=1024)
def split_uri(uri: str) -> tuple[str, int, str]:
    """Split ``http://host:port/path`` into ``(host, port, path)``; the path is at least ``/``.

    Raises:
        UnreachableError: The text is not such a URI; ROS requires the port.
    """
    try:
        parts = urlsplit(uri)
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port, parts = None, None, None
    if parts is None or parts.scheme != "http" or not host or not port:
        raise UnreachableError("XML-RPC server", repr(uri), "a ROS URI looks like http://host:11311/")
    return host, port, parts.path or "/"


def is_own_name(host: str) -> bool:
    """Whether a host name is this machine's, which is reached by loopback."""
    return host in {"localhost", socket.gethostname()}


async def _addresses(host: str, port: int) -> list[tuple[str, int]]:
    """Addresses of a host, best first; numbers and names of this machine do not go to the resolver."""
    if is_own_name(host):
        return [(_LOOPBACK, port)]
    try:
        return [(str(ipaddress.IPv4Address(host)), port)]
    except ValueError:
        return await _resolve(host, port)


async def _resolve(host: str, port: int) -> list[tuple[str, int]]:
    loop = asyncio.get_running_loop()
    try:
        found = await loop.getaddrinfo(host, port, family=socket.AF_INET, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise UnreachableError(
            "machine", host, f"the name does not resolve here ({error}); set ROS_IP where that node runs"
        ) from error
    return [(address[0], port) for *_, address in found if isinstance(address[0], str)]


async def _connect_one(address: tuple[str, int], use: Use) -> socket.socket:
    sock = DESCRIPTORS.open_socket(use, what=f"a connection to {address[0]}:{address[1]}")
    try:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        await asyncio.get_running_loop().sock_connect(sock, address)
        # getpeername() raises as well if the other side closed at once.
        if sock.getsockname() == sock.getpeername():
            # A connect to a port of the ephemeral range where nothing listens can connect to itself.
            raise ConnectionRefusedError(errno.ECONNREFUSED, "connected to itself")  # noqa: TRY301 - see below
    except BaseException:
        sock.close()
        raise
    return sock


async def connect(host: str, port: int, use: Use = Use.DATA) -> socket.socket:
    """Connect by TCP, non-blocking and with TCP_NODELAY.

    Args:
        host: An address, a name of this machine (connected on loopback, without the resolver) or any other name.
        port: The port.
        use: The purpose, which decides whether the connection may take one of the last file descriptors.

    Raises:
        UnreachableError: The name does not resolve.
        OSError: The connection is refused (``ConnectionRefusedError``), the network fails, or no file descriptor is
            left (``EMFILE``).
    """
    error: OSError = ConnectionRefusedError(errno.ECONNREFUSED, f"no address for {host}")
    addresses = await _addresses(host, port)
    for address in addresses:
        try:
            return await _connect_one(address, use)
        except OSError as refused:
            error = refused
    if is_own_name(host) and host != "localhost":
        # A node may listen only at this machine's address in the network.
        for address in await _resolve(host, port):
            if address not in addresses:
                try:
                    return await _connect_one(address, use)
                except OSError as refused:
                    error = refused
    raise error


async def call(
    uri: str,
    method: str,
    *params: XmlRpcValue,
    timeout: float = limits.SLAVE_CALL_TIMEOUT,  # noqa: ASYNC109 - the message names it
    use: Use = Use.DATA,
) -> XmlRpcValue:
    """Call a method of the server at ``uri``.

    Args:
        uri: ``http://host:port/``.
        method: The method's name.
        params: The parameters.
        timeout: Seconds for everything: the connection, the call and its response.
        use: The purpose, which decides whether the connection may take one of the last file descriptors.

    Raises:
        UnreachableError: The server does not answer, or not in time.
        OutOfDescriptors: No file descriptor is left for the call.
        RosFault: The response is a fault.
        RemoteProtocolError: The response is not XML-RPC, or too large.
        LocalProtocolError: A parameter cannot be written in XML-RPC.
    """
    if _log.isEnabledFor(logging.DEBUG):
        _log.debug("> %s %s%s", uri, method, brief(params))
    document = b"".join(yielding_to_data(call_pieces(method, params), every=1))
    return await read_response(await exchange(uri, method, document, timeout=timeout, use=use))


async def exchange(
    uri: str,
    method: str,
    document: bytes,
    *,
    timeout: float,  # noqa: ASYNC109 - the message names it
    use: Use = Use.DATA,
) -> bytes:
    """Send a ``methodCall`` document and return the document of the response, unparsed.

    A caller that polls compares the bytes with those of the last response, and need not parse the same one twice.
    Arguments and errors are those of ``call``; ``read_response`` parses the document.
    """
    host, port, path = split_uri(uri)
    loop = asyncio.get_running_loop()
    response = ResponseParser(uri)
    try:
        async with asyncio.timeout(timeout):
            sock = await connect(host, port, use)
            try:
                await loop.sock_sendall(sock, post_request(host, port, path, document))
                while (body := response.feed(await loop.sock_recv(sock, _CHUNK))) is None:
                    pass
                return body
            finally:
                sock.close()
    except TimeoutError as error:
        raise UnreachableError(
            "XML-RPC server", uri, f"no answer to {method} in {timeout:g} s; is that program stopped?"
        ) from error
    except OSError as error:
        if error.errno in OUT_OF_DESCRIPTORS:
            raise OutOfDescriptors("XML-RPC server", uri, "`rmpa doctor` says what to do") from error
        problem = os.strerror(error.errno) if error.errno else str(error)
        raise UnreachableError("XML-RPC server", uri, f"{problem}; is that program running?") from error


async def read_response(body: bytes) -> XmlRpcValue:
    """Parse the document of a response; other callbacks run between the slices of a large one.

    Raises:
        RosFault, RemoteProtocolError: As for ``call``.
    """
    return await read_large(ResponseReader(), slices(body))


async def call_api(
    uri: str,
    method: str,
    *params: XmlRpcValue,
    timeout: float = limits.SLAVE_CALL_TIMEOUT,  # noqa: ASYNC109 - handed to ``call``
    use: Use = Use.DATA,
) -> RosReply:
    """Call a method of a ROS API, which answers ``[code, status, value]``.

    Raises:
        RemoteProtocolError: The answer is not such a triple (that of roscpp's ``getBusStats`` is not).
        UnreachableError, RosFault, LocalProtocolError: As for ``call``.
    """
    return RosReply.of(await call(uri, method, *params, timeout=timeout, use=use))
