"""XML-RPC calls to nodes and masters, each on a connection of its own.

No connection is kept alive: each costs a Python node a thread, and opening one on loopback takes 50 microseconds.

A document of some MiB takes seconds to parse. It is read in slices of ``XMLRPC_SLICE``, and other pending data
is served between two slices; not in a thread, because a thread that computes takes the interpreter from the event
loop for milliseconds at a time.
"""

from __future__ import annotations

import asyncio
import errno
import functools
import ipaddress
import logging
import os
import socket
from typing import TYPE_CHECKING, Final, TypeVar
from urllib.parse import urlsplit

from rmpa.core.errors import OutOfDescriptors, UnreachableError
from rmpa.core.limits import KIB
from rmpa.ros import limits
from rmpa.ros.wire.http import ResponseParser, post_request
from rmpa.ros.wire.xmlrpc import DocumentReader, RosReply, XmlRpcValue, brief, call_pieces
from rmpa.runtime.accept import DESCRIPTORS, OUT_OF_DESCRIPTORS, Use
from rmpa.runtime.loop import yield_to_data, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.ros.wire.tcpros import Buffer

_log = logging.getLogger(__name__)

# Bytes of XML parsed at once, some 100 microseconds; then pending data is served.
XMLRPC_SLICE: Final = 2 * KIB

# Seconds of silence before the first keepalive probe; this and the next two are roscpp's values.
_TCP_KEEPALIVE_IDLE: Final = 60
# Seconds between probes.
_TCP_KEEPALIVE_INTERVAL: Final = 10
# Unanswered probes before the connection is dead.
_TCP_KEEPALIVE_COUNT: Final = 9
_CHUNK: Final = 64 * KIB
_LOOPBACK: Final = "127.0.0.1"
_Document = TypeVar("_Document", bytes, bytearray, memoryview, str)


def slices(document: _Document) -> Iterator[_Document]:
    """A document in slices."""
    for begin in range(0, len(document), XMLRPC_SLICE):
        yield document[begin : begin + XMLRPC_SLICE]


async def read_large(pieces: Iterable[Buffer]) -> DocumentReader:
    """Read a document of any size; after ``limits.HTTP_BODY_INLINE`` bytes other callbacks run between the pieces.

    Raises:
        RemoteProtocolError: As ``DocumentReader.feed``.
    """
    reader = DocumentReader()
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
    return reader


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


async def _resolve(host: str, port: int) -> list[tuple[str, int]]:
    try:
        return [(str(ipaddress.IPv4Address(host)), port)]
    except ValueError:
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
    if is_own_name(host):
        try:
            return await _connect_one((_LOOPBACK, port), use)
        except OSError as refused:
            if host == "localhost":
                raise
            error = refused  # a node may listen only at this machine's address in the network
    for address in await _resolve(host, port):
        try:
            return await _connect_one(address, use)
        except OSError as refused:
            error = refused
    raise error


def keep_alive(sock: socket.socket) -> None:
    """Let the kernel detect a machine that was switched off, with roscpp's timing."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, _TCP_KEEPALIVE_IDLE)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, _TCP_KEEPALIVE_INTERVAL)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, _TCP_KEEPALIVE_COUNT)


def tcpros_info(sock: socket.socket) -> str:
    """The addresses of a connection, in the form of ``rosnode info``."""
    host, port = sock.getpeername()[:2]
    return f"TCPROS connection on port {sock.getsockname()[1]} to [{host}:{port}]"


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
    document = b"".join(yielding_to_data(call_pieces(method, params)))
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
                response.close()
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
    return (await read_large(slices(body))).response()


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
