"""HTTP as it comes to the XML-RPC server and as it comes back to its client."""

from __future__ import annotations

import asyncio
import contextlib
import socket

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.statistics import Counters
from rmpa.ros.http.server import HttpConnection, XmlRpcServer
from rmpa.ros.wire.http import ResponseParser
from rmpa.ros.wire.xmlrpc import XmlRpcValue, serialize_response
from tests.ros.documents import serialize_call

_CALL = serialize_call("getPid", ["/x"])
_REPLY = serialize_response([1, "", 5])

SEEDS: list[bytes] = [
    b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: %d\r\n\r\n" % len(_CALL) + _CALL,
    b"POST /RPC2 HTTP/1.0\r\nUser-Agent: XMLRPC++ 0.7\r\nContent-length: %d\r\n\r\n" % len(_CALL) + _CALL,
    b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\nExpect: 100-continue\r\n\r\n2\r\nhi\r\n0\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
    b"HTTP/1.1 200 OK\r\nServer: XMLRPC++ 0.7\r\nContent-length: %d\r\n\r\n" % len(_REPLY) + _REPLY,
    b"HTTP/1.1 100 Continue\r\n\r\nHTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n3\r\nabc\r\n0\r\n\r\n",
]


class _Wire(asyncio.Transport):
    """A transport into nothing; what is left of it after ``close()`` is an error."""

    def __init__(self, end: socket.socket) -> None:
        super().__init__({"peername": ("192.0.2.1", 4711), "socket": end})
        self.closed = False

    def write(self, data: bytes | bytearray | memoryview) -> None:
        assert isinstance(data, bytes)

    def close(self) -> None:
        self.closed = True

    def abort(self) -> None:
        self.closed = True

    def is_closing(self) -> bool:
        return self.closed

    def write_eof(self) -> None:
        assert not self.closed

    def get_write_buffer_size(self) -> int:
        return 0

    def pause_reading(self) -> None:
        pass

    def resume_reading(self) -> None:
        pass


def _answer(method: str, params: tuple[XmlRpcValue, ...]) -> XmlRpcValue:
    return [1, method, [len(params)]]


async def _serve(data: bytes) -> None:
    server = XmlRpcServer(_answer, counters=Counters())
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as end:
        connection = HttpConnection(server)
        wire = _Wire(end)
        connection.connection_made(wire)
        half = len(data) // 2
        for part in (data[:half], data[half:]):
            if not wire.closed:
                connection.data_received(part)
        if not wire.closed:
            connection.eof_received()
        connection.connection_lost(None)
    assert len(server._connections) == 0


def _be_answered(data: bytes) -> None:
    response = ResponseParser("http://x:1/")
    half = len(data) // 2
    with contextlib.suppress(RemoteProtocolError):
        for part in (data[:half], data[half:], b""):
            if response.feed(part) is not None:
                break


def fuzz(data: bytes) -> None:
    """Both directions; refusals are counted inside, anything else comes out."""
    asyncio.run(_serve(data))
    _be_answered(data)
