from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import AsyncIterator

import pytest

from rmpa.core.errors import LocalProtocolError, UnreachableError
from rmpa.ros.node import ask
from rmpa.ros.node.ask import probe
from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed
from rmpa.ros.wire.tcpros import ServiceDescription, encode_header, server_header
from rmpa.runtime import limits
from tests.ros.node.peers import RawServer, RawSubscriber
from tests.runtime.descriptors_left import descriptors_left
from tests.waiting import DEADLINE, until

MD5 = "6a2e34150c00229791cc89ff309fff21"
ADD = ServiceDescription("rospy_tutorials/AddTwoInts", MD5)
GET = ServiceDescription("roscpp/GetLoggers", "32e97e85527d4678a8f9279894bb64b0")
HEADER = server_header("/talker", GET)
SERVICE = "/talker/get_loggers"


class Server(RawServer):
    """A service's server, and a program at a TCP port that is no part of rmpa."""

    @property
    def uri(self) -> str:
        return f"rosrpc://127.0.0.1:{self.port}"

    async def serve(self, header: dict[str, str] | None = None) -> tuple[ServiceConnection, RawSubscriber]:
        """A connection of ours, and its other side behind the headers."""
        opening = asyncio.create_task(ServiceConnection.open(self.uri, "/add", "/c"))
        link = await self.accept()
        fields = await link.header()
        assert fields == {"service": "/add", "callerid": "/c", "md5sum": "*", "persistent": "1"}
        await link.send(encode_header(header if header is not None else server_header("/server", ADD)))
        return await opening, link

    async def asked(self, *answers: bytes, node: str = "/talker", close: bool = False) -> str:
        """The result of a probe of this program, which sends these bytes behind the header that it gets."""
        asking = asyncio.create_task(probe("127.0.0.1", self.port, SERVICE, timeout=DEADLINE, node=node))
        link = await self.accept()
        fields = await link.header()
        assert fields == {"probe": "1", "service": SERVICE, "md5sum": "*", "callerid": "/rmpa"}
        for answer in answers:
            await link.send(answer)
            await asyncio.sleep(0)
        if close:
            link.close()
        return await asking


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    made = Server()
    yield made
    made.close()


async def test_servers_description_is_read(server: Server) -> None:
    connection, _link = await server.serve()
    assert connection.description.type == ADD.type
    assert connection.description.md5sum == MD5
    assert connection.caller_id == "/server"
    connection.close()
    assert connection.closed


async def test_a_reply_in_pieces(server: Server) -> None:
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


async def test_one_call_at_a_time(server: Server) -> None:
    connection, link = await server.serve()
    answer = asyncio.create_task(connection.call(b"1"))
    assert await link.message() == b"1"
    with pytest.raises(LocalProtocolError, match="two calls at once"):
        await connection.call(b"2")
    await link.send(b"\x01\x00\x00\x00\x00")
    assert await answer == (True, b"")
    connection.close()


async def test_who_does_not_wait_for_the_answer_closes_the_connection(server: Server) -> None:
    connection, link = await server.serve()
    answer = asyncio.create_task(connection.call(b"1"))
    assert await link.message() == b"1"
    answer.cancel()
    await until(lambda: connection.closed)
    assert await link.ended()


async def test_close_fails_the_call(server: Server) -> None:
    connection, _link = await server.serve()
    answer = asyncio.create_task(connection.call(bytes(10_000_000)))
    await until(lambda: connection.busy)
    connection.close()
    with pytest.raises(ServiceFailed, match="the connection was closed"):
        await answer


async def test_a_server_that_breaks_the_protocol(server: Server) -> None:
    connection, link = await server.serve()
    answer = asyncio.create_task(connection.call(b"1"))
    await link.message()
    await link.send(b"\x01\xff\xff\xff\xff")
    with pytest.raises(ServiceFailed, match="broke the protocol: service response of 4294967295 bytes exceeds the"):
        await answer


async def test_unrequested_bytes_break_the_protocol(server: Server) -> None:
    connection, link = await server.serve()
    await link.send(b"\x01\x00\x00\x00\x00")
    await until(lambda: connection.closed)


async def test_nobody_there(server: Server) -> None:
    with pytest.raises(UnreachableError, match=r"no server of service /add answers at rosrpc://.* within 0\.05 s"):
        await ServiceConnection.open(server.uri, "/add", "/c", timeout=0.05)
    server.close()
    with pytest.raises(UnreachableError, match="Connect call failed"):
        await ServiceConnection.open(server.uri, "/add", "/c")


def refusal(text: str) -> bytes:
    return encode_header({"error": text})


ANSWER = encode_header(HEADER)
OF_ROSPY = "[{}] is not a provider of  [/talker/get_loggers]"
OF_ROSCPP = "received a tcpros connection for a nonexistent service [/talker/get_loggers]."
UNEXPECTED = "a ROS node listens there, but not the expected one: "
NO_NODE = "the program that listens there is no ROS node"


@pytest.mark.parametrize(
    ("answer", "node", "says"),
    [
        (ANSWER, "/talker", ""),
        (ANSWER, "", ""),
        (encode_header({key: value for key, value in HEADER.items() if key != "callerid"}), "/talker", ""),
        (encode_header({**HEADER, "callerid": "/camera\n"}), "/talker", "another node listens there: /camera�"),
        # An error counts only if it names the node.
        (refusal(OF_ROSPY.format("/talker")), "/talker", ""),
        (encode_header({"error": OF_ROSCPP, "callerid": "/talker"}), "/talker", ""),
        (refusal(OF_ROSCPP), "/talker", UNEXPECTED + OF_ROSCPP),
        (refusal(OF_ROSCPP), "", UNEXPECTED + OF_ROSCPP),
        (
            refusal(OF_ROSPY.format("/talker2")), "/talker", UNEXPECTED + OF_ROSPY.format("/talker2"),
        ),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "/talker", NO_NODE),
        (b"\x05\0\0\0\x01\0\0\0x", "/talker", NO_NODE),
    ],
)  # fmt: skip
async def test_a_probe_says_what_answers(server: Server, answer: bytes, node: str, says: str) -> None:
    assert await server.asked(answer, node=node) == says
    assert await server.links[0].ended(), "the probe leaves nothing behind, and sends nothing more"


async def test_an_answer_may_come_in_pieces_or_end_too_early(server: Server) -> None:
    assert await server.asked(*(ANSWER[at : at + 1] for at in range(len(ANSWER)))) == ""
    assert "closed the connection without an answer" in await server.asked(b"\x05\0", close=True)


async def test_silence_ends_with_the_timeout(server: Server) -> None:
    assert await probe("127.0.0.1", server.port, SERVICE, timeout=0.1) == "connected, but no answer within 0.1 s"
    assert await (await server.accept()).header(), "its header was sent all the same"


async def test_a_port_where_nothing_listens(server: Server) -> None:
    server.close()
    assert await probe("127.0.0.1", server.port, SERVICE, timeout=DEADLINE) == "connection refused"
    assert await probe("127.0.0.1", server.port, "", timeout=DEADLINE) == "connection refused"


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(errno.EHOSTUNREACH, "x"), "no route to host"),
        (OSError(errno.ENETUNREACH, "x"), "network is unreachable"),
        (OSError("odd"), "odd"),
        (None, "no answer within 0.05 s"),
    ],
)
async def test_reasons_are_those_of_the_network(
    monkeypatch: pytest.MonkeyPatch, error: OSError | None, reason: str
) -> None:
    async def connect(*_: object) -> socket.socket:
        if error is None:
            await asyncio.Event().wait()
        raise error or AssertionError

    monkeypatch.setattr(ask, "connect", connect)
    assert await probe("192.0.2.1", 1, SERVICE, timeout=0.05) == reason


async def test_a_name_that_does_not_resolve_is_a_reason() -> None:
    assert "does not resolve here" in await probe("no-such-host.invalid", 1, SERVICE, timeout=DEADLINE)


async def test_without_a_service_a_connection_is_enough(server: Server) -> None:
    assert await probe("127.0.0.1", server.port, "", timeout=DEADLINE) == ""
    assert await (await server.accept()).ended()


async def test_the_last_file_descriptors_are_not_taken(server: Server) -> None:
    with descriptors_left(limits.DESCRIPTORS_RESERVED):
        problem = await probe("127.0.0.1", server.port, SERVICE, timeout=DEADLINE)
    assert problem == "no file descriptor is left for the attempt; `rmpa doctor` says what to do"
