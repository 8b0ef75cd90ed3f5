from __future__ import annotations

import asyncio
import socket
from typing import TYPE_CHECKING, Self

import pytest

from rmpa.core.errors import LocalProtocolError, PeerRefused, UnreachableError
from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed
from rmpa.ros.wire.tcpros import ServiceDescription, encode_header, server_header
from tests.ros.node.peers import DEADLINE, RawSubscriber, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

MD5 = "6a2e34150c00229791cc89ff309fff21"
ADD = ServiceDescription("rospy_tutorials/AddTwoInts", MD5)


class RawServer:
    """A listening socket whose connections are accepted by hand."""

    def __init__(self) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._links: list[RawSubscriber] = []
        self.uri = f"rosrpc://127.0.0.1:{self._socket.getsockname()[1]}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        for link in self._links:
            link.close()

    async def accept(self) -> RawSubscriber:
        """The next connection."""
        async with asyncio.timeout(DEADLINE):
            sock, _ = await asyncio.get_running_loop().sock_accept(self._socket)
        sock.setblocking(False)
        self._links.append(RawSubscriber(sock))
        return self._links[-1]

    async def serve(self, header: dict[str, str] | None = None) -> tuple[ServiceConnection, RawSubscriber]:
        """A connection of ours, and its other side behind the headers."""
        opening = asyncio.create_task(ServiceConnection.open(self.uri, "/add", "/c"))
        link = await self.accept()
        fields = await link.header()
        assert fields == {"service": "/add", "callerid": "/c", "md5sum": "*", "persistent": "1"}
        await link.send(encode_header(header if header is not None else server_header("/server", ADD)))
        return await opening, link


@pytest.fixture
async def server() -> AsyncIterator[RawServer]:
    with RawServer() as made:
        yield made


async def test_servers_description_is_read(server: RawServer) -> None:
    connection, link = await server.serve()
    assert connection.description.type == ADD.type
    assert connection.description.md5sum == MD5
    assert connection.caller_id == "/server"
    connection.close()
    assert connection.closed
    link.close()


async def test_a_reply_in_pieces(server: RawServer) -> None:
    connection, link = await server.serve()
    answer = asyncio.create_task(connection.call(b"12"))
    assert await link.message() == b"12"
    assert connection.busy
    for byte in b"\x01\x03\x00\x00\x00abc":
        await link.send(bytes([byte]))
        await asyncio.sleep(0)
    assert await answer == (True, b"abc")
    assert not connection._stream.closed
    connection.close()
    link.close()


async def test_one_call_at_a_time(server: RawServer) -> None:
    connection, link = await server.serve()
    answer = asyncio.create_task(connection.call(b"1"))
    assert await link.message() == b"1"
    with pytest.raises(LocalProtocolError, match="two calls at once"):
        await connection.call(b"2")
    await link.send(b"\x01\x00\x00\x00\x00")
    assert await answer == (True, b"")
    connection.close()
    link.close()


async def test_a_server_that_dies_in_the_middle_of_a_call(server: RawServer) -> None:
    connection, link = await server.serve()
    answer = asyncio.create_task(connection.call(b"1"))
    assert await link.message() == b"1"
    await link.send(b"\x01\x03\x00")
    link.close()
    with pytest.raises(
        ServiceFailed, match=r"service \[/add\]: its server died.* in the middle of the call"
    ) as error:
        await answer
    assert error.value.sent
    assert connection.closed


async def test_server_that_closed_before_the_call_is_distinguished(server: RawServer) -> None:
    told: list[bool] = []
    connection, link = await server.serve()
    connection._on_closed = lambda: told.append(True)
    link.close()
    with pytest.raises(ServiceFailed, match="has closed the connection") as error:  # before the loop has looked
        await connection.call(b"1")
    assert not error.value.sent
    connection, link = await server.serve()
    connection._on_closed = lambda: told.append(True)
    link.close()
    await until(lambda: told)
    assert connection.closed
    with pytest.raises(ServiceFailed) as error:
        await connection.call(b"1")
    assert not error.value.sent


async def test_a_late_answer_closes_the_connection(server: RawServer) -> None:
    connection, link = await server.serve()
    with pytest.raises(ServiceFailed, match=r"no answer within 0\.02 s"):
        await connection.call(b"1", 0.02)
    assert connection.closed
    link.close()


async def test_who_does_not_wait_for_the_answer_closes_the_connection(server: RawServer) -> None:
    connection, link = await server.serve()
    answer = asyncio.create_task(connection.call(b"1"))
    assert await link.message() == b"1"
    answer.cancel()
    await until(lambda: connection.closed)
    assert await link.ended()
    link.close()


async def test_close_fails_the_call(server: RawServer) -> None:
    connection, link = await server.serve()
    answer = asyncio.create_task(connection.call(bytes(10_000_000)))
    await until(lambda: connection.busy)
    connection.close()
    with pytest.raises(ServiceFailed, match="the connection was closed"):
        await answer
    link.close()


@pytest.mark.parametrize(
    ("sent", "problem"),
    [
        (b"\x01\xff\xff\xff\xff", "broke the protocol: service response of 4294967295 bytes exceeds the limit"),
    ],
)
async def test_a_server_that_breaks_the_protocol(server: RawServer, sent: bytes, problem: str) -> None:
    connection, link = await server.serve()
    answer = asyncio.create_task(connection.call(b"1"))
    await link.message()
    await link.send(sent)
    with pytest.raises(ServiceFailed, match=problem):
        await answer
    link.close()


async def test_unrequested_bytes_break_the_protocol(server: RawServer) -> None:
    connection, link = await server.serve()
    await link.send(b"\x01\x00\x00\x00\x00")
    await until(lambda: connection.closed)
    link.close()


async def test_refusals(server: RawServer) -> None:
    with pytest.raises(PeerRefused, match="service /add: its server refused: no such service"):
        await server.serve({"error": "no such service"})
    with pytest.raises(PeerRefused, match="'md5sum' is missing"):
        await server.serve({"callerid": "/server"})
    opening = asyncio.create_task(ServiceConnection.open(server.uri, "/add", "/c", md5sum="0" * 32))
    link = await server.accept()
    await link.header()
    await link.send(encode_header(server_header("/server", ADD)))
    with pytest.raises(PeerRefused, match=f"the server of /add has md5sum .{MD5}., not"):
        await opening
    link.close()


async def test_nobody_there() -> None:
    with RawServer() as server:
        with pytest.raises(
            UnreachableError, match=r"no server of service /add answers at rosrpc://.* within 0\.05 s"
        ):
            await ServiceConnection.open(server.uri, "/add", "/c", timeout=0.05)
        uri = server.uri
    with pytest.raises(UnreachableError, match="Connect call failed"):
        await ServiceConnection.open(uri, "/add", "/c")
