from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import AsyncIterator
from typing import Final

import pytest

from rmpa.core.errors import StartError
from rmpa.ros import limits
from rmpa.ros.http.rpc import call
from rmpa.ros.http.server import XmlRpcServer
from rmpa.ros.wire.http import HTTP_HEADERS_MAX
from rmpa.ros.wire.xmlrpc import RosFault, XmlRpcValue, parse_response, serialize_response
from rmpa.runtime.accept import raise_file_limit
from tests.ros.documents import serialize_call

DEADLINE: Final = 10.0


class Echo:
    """A handler whose method ``wait`` answers when ``go`` is set."""

    def __init__(self) -> None:
        self.go = asyncio.Event()
        self.waiting = asyncio.Event()

    def __call__(self, method: str, params: tuple[XmlRpcValue, ...]) -> XmlRpcValue | asyncio.Task[XmlRpcValue]:
        match method:
            case "wait":
                return asyncio.get_running_loop().create_task(self._wait())
            case "fault":
                raise RosFault(7, "as asked")
            case "bug":
                raise KeyError("as asked")
            case "unsayable":
                return object()  # type: ignore[return-value]
        return [1, method, list(params)]

    async def _wait(self) -> XmlRpcValue:
        self.waiting.set()
        await self.go.wait()
        return "waited"


@pytest.fixture
async def echo() -> Echo:
    return Echo()


@pytest.fixture
async def server(echo: Echo) -> AsyncIterator[XmlRpcServer]:
    made = XmlRpcServer(echo)
    await made.start()
    yield made
    await made.close()


class Client:
    """Raw bytes to a server."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def response(self) -> tuple[bytes, bytes]:
        """The head and the body of one response."""
        async with asyncio.timeout(DEADLINE):
            head = await self.reader.readuntil(b"\r\n\r\n")
            length = next(line for line in head.split(b"\r\n") if line.lower().startswith(b"content-length: "))
            return head, await self.reader.readexactly(int(length.split(b" ")[1]))

    async def ended(self) -> bytes:
        """What comes until the server closes."""
        async with asyncio.timeout(DEADLINE):
            with contextlib.suppress(ConnectionError):
                return await self.reader.read()
            return b""


@contextlib.asynccontextmanager
async def client(server: XmlRpcServer) -> AsyncIterator[Client]:
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    try:
        yield Client(reader, writer)
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


def post(body: bytes, *headers: bytes) -> bytes:
    lines = [b"POST / HTTP/1.1", b"Host: x", b"Content-length: %d" % len(body), *headers]
    return b"\r\n".join(lines) + b"\r\n\r\n" + body


CALL: Final = serialize_call("echo", [1, "two"])


@pytest.mark.trap(28)
async def test_answers_in_one_response_that_xmlrpcpp_reads(server: XmlRpcServer) -> None:
    """One HTTP response, ``Content-length: N`` with one space, no chunks."""
    async with client(server) as c:
        c.writer.write(post(CALL))
        head, body = await c.response()
    assert head.startswith(b"HTTP/1.1 200 OK\r\n")
    assert b"\r\nContent-length: %d\r\n" % len(body) in head
    assert b"chunked" not in head.lower()
    assert parse_response(body) == [1, "echo", [1, "two"]]


async def test_kept_alive_pipelined_and_byte_by_byte(server: XmlRpcServer) -> None:
    async with client(server) as c:
        c.writer.write(post(CALL) * 3)
        for _ in range(3):
            await c.response()
        for byte in post(CALL):
            c.writer.write(bytes([byte]))
            await c.writer.drain()
        assert b" 200 " in (await c.response())[0]
    assert server.counters["xmlrpc.calls"] == 4


async def test_expect_continue_is_tolerated(server: XmlRpcServer) -> None:
    async with client(server) as c:
        head, _, body = post(CALL, b"Expect: 100-continue").partition(b"\r\n\r\n")
        c.writer.write(head + b"\r\n\r\n")
        async with asyncio.timeout(DEADLINE):
            assert b"100" in await c.reader.readuntil(b"\r\n\r\n")
        c.writer.write(body)
        assert b" 200 " in (await c.response())[0]


async def test_an_awaited_answer_holds_up_its_own_connection_only(server: XmlRpcServer, echo: Echo) -> None:
    async with client(server) as slow, client(server) as fast:
        slow.writer.write(post(serialize_call("wait", [])) + post(CALL))
        await echo.waiting.wait()
        fast.writer.write(post(CALL))
        await fast.response()
        echo.go.set()
        assert parse_response((await slow.response())[1]) == "waited"
        assert parse_response((await slow.response())[1]) == [1, "echo", [1, "two"]]


async def test_faults_bugs_and_unwritable_values(server: XmlRpcServer, caplog: pytest.LogCaptureFixture) -> None:
    uri = f"http://127.0.0.1:{server.port}/"
    for method, code, text in (("fault", 7, "as asked"), ("bug", 1, "KeyError"), ("unsayable", 1, "cannot be said")):
        with pytest.raises(RosFault, match=text) as caught:
            await call(uri, method)
        assert caught.value.number == code
    assert server.counters["xmlrpc.failed"] == 2
    assert "KeyError" in caplog.text


async def test_a_malformed_call_gets_a_fault_and_the_connection_lives(server: XmlRpcServer) -> None:
    async with client(server) as c:
        c.writer.write(post(b"<garbage>"))
        with pytest.raises(RosFault, match="malformed XML"):
            parse_response((await c.response())[1])
        c.writer.write(post(CALL))
        await c.response()
    assert server.counters["xmlrpc.malformed"] == 1


@pytest.mark.parametrize(
    ("request_bytes", "status", "counter"),
    [
        (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"405", "http.method"),
        (post(CALL, b"Content-Encoding: gzip"), b"415", "http.encoding"),
        (b"garbage\r\n\r\n", b"400", "http.malformed"),
        (b"POST / HTTP/1.1\r\nHost: x\r\nX: " + b"a" * (HTTP_HEADERS_MAX + 1), b"431", "http.malformed"),
    ],
)
async def test_refusals_are_answered_counted_and_closed(
    server: XmlRpcServer, request_bytes: bytes, status: bytes, counter: str
) -> None:
    async with client(server) as c:
        c.writer.write(request_bytes)
        assert (await c.ended()).startswith(b"HTTP/1.1 " + status)
    assert server.counters[counter] == 1


@pytest.mark.parametrize("chunked", [False, True])
async def test_oversized_call_is_read_whole_and_answered_with_a_fault(
    server: XmlRpcServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, *, chunked: bool
) -> None:
    """A client reads no answer before it has sent its call; rospy shows the text of a fault, and of nothing else."""
    monkeypatch.setattr(limits, "HTTP_BODY_MAX", 100_000)
    monkeypatch.setattr(limits, "HTTP_BODY_INLINE", 10_000)
    body = serialize_call("setParam", ["/loader", "/robot_description", "x" * 3_000_000])
    async with client(server) as c:
        if chunked:
            c.writer.write(b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n")
            for begin in range(0, len(body), 50_000):
                part = body[begin : begin + 50_000]
                c.writer.write(b"%x\r\n%s\r\n" % (len(part), part))
            c.writer.write(b"0\r\n\r\n")
        else:
            c.writer.write(post(body))
        await c.writer.drain()
        with pytest.raises(RosFault) as told:
            parse_response((await c.response())[1])
        for part_of_it in ("setParam /robot_description", str(len(body)), "100000", "one by one"):
            assert part_of_it in told.value.text
        c.writer.write(post(CALL))
        assert parse_response((await c.response())[1]), "the connection goes on"
    assert server.counters["http.too_large"] == 1
    assert [r.levelname for r in caplog.records if "/robot_description" in r.getMessage()] == ["WARNING"]


async def test_large_calls_have_a_bound_together_and_the_slow_one_gives_way(
    server: XmlRpcServer, echo: Echo, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "HTTP_BODY_INLINE", 1000)
    monkeypatch.setattr(limits, "HTTP_BODIES_MAX", 5000)
    large = post(serialize_call("wait", ["x" * 2500]))
    async with client(server) as stuck, client(server) as first, client(server) as second:
        first.writer.write(large)
        await echo.waiting.wait()  # its room is taken until it is answered
        second.writer.write(large)
        with pytest.raises(RosFault, match=r"wait: .* try again in a moment"):
            parse_response((await second.response())[1])
        echo.go.set()
        assert parse_response((await first.response())[1]) == "waited"
        stuck.writer.write(large[:1500])
        while not any(one.requests.reserved for one in server._connections):
            await asyncio.sleep(0)
        (slow,) = (one for one in server._connections if one.requests.reserved)
        slow.begun -= 60.0
        second.writer.write(large)
        assert parse_response((await second.response())[1]) == "waited"
        assert await stuck.ended() == b""
    assert server.counters["http.evicted.slow"] == 1
    assert not any(one.requests.reserved for one in server._connections)


@pytest.mark.parametrize("begin", [b"POST / HTTP/1.1\r\n", post(CALL)[:-30], post(b"x" * 5000)[:300]])
async def test_slow_connections_block_no_other_client(
    server: XmlRpcServer, monkeypatch: pytest.MonkeyPatch, begin: bytes
) -> None:
    """Seven hundred that send a byte a second took every place: nobody was answered for 10 s."""
    monkeypatch.setattr(limits, "HTTP_CONNECTIONS_MAX", 8)
    async with contextlib.AsyncExitStack() as stack:
        slow = [await stack.enter_async_context(client(server)) for _ in range(12)]
        for c in slow:
            c.writer.write(begin)
        while sum(one.requests.receiving for one in server._connections) < 8:
            await asyncio.sleep(0)
        for one in server._connections:
            one.begun -= 5.0
        fast = await stack.enter_async_context(client(server))
        for _ in range(3):
            fast.writer.write(post(CALL))
            assert parse_response((await fast.response())[1])
            further = await stack.enter_async_context(client(server))
            further.writer.write(post(CALL)[:40])
            await asyncio.sleep(0.01)
        assert len(server._connections) <= 8
        assert server.counters["http.refused.connections"] == 0
        assert server.counters["http.evicted.slow"] + server.counters["http.evicted"] >= 5


async def test_two_thousand_half_sent_calls_give_way_to_none(server: XmlRpcServer) -> None:
    """Clients that reconnect whenever they have given way kept the callers out, for seconds."""
    if raise_file_limit() < 5000:
        pytest.skip("this process may not have 5000 open files")
    loop = asyncio.get_running_loop()
    with contextlib.ExitStack() as stack:
        for _ in range(2000):
            sock = stack.enter_context(socket.socket())
            sock.setblocking(False)
            await loop.sock_connect(sock, ("127.0.0.1", server.port))
            await loop.sock_sendall(sock, b"POST / HTTP/1.1\r\n")
        assert await call(f"http://127.0.0.1:{server.port}/", "echo", 1) == [1, "echo", [1]]
        assert len(server._connections) >= 2000
        assert server.counters.as_dict() == {"xmlrpc.calls": 1}


async def test_unread_answers_block_no_other_client(server: XmlRpcServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "HTTP_CONNECTIONS_MAX", 2)
    async with client(server) as one, client(server) as other:
        for c in (one, other):
            c.writer.write(post(serialize_call("echo", ["x" * 8_000_000])))

        def unread() -> list[int]:
            return [one._transport.get_write_buffer_size() for one in server._connections]

        while server.counters["xmlrpc.calls"] < 2 or not all(unread()):
            await asyncio.sleep(0.001)
        assert await call(f"http://127.0.0.1:{server.port}/", "echo", 1) == [1, "echo", [1]]
    assert server.counters["http.evicted.slow"] == 1


async def test_calls_in_one_go_are_answered_in_turn_with_those_of_others(server: XmlRpcServer) -> None:
    async with client(server) as greedy, client(server) as other:
        greedy.writer.write(post(CALL) * 200)
        other.writer.write(post(CALL))
        await other.response()
        assert server.counters["xmlrpc.calls"] < 100
        for _ in range(200):
            assert parse_response((await greedy.response())[1])


@pytest.mark.parametrize("start", [b"", b"POST / HT", post(CALL)[:-1]])
async def test_unfinished_requests_time_out(
    server: XmlRpcServer, monkeypatch: pytest.MonkeyPatch, start: bytes
) -> None:
    monkeypatch.setattr(limits, "HTTP_REQUEST_TIMEOUT", 0.05)
    async with client(server) as c:
        c.writer.write(start)
        assert await c.ended() == b""


async def test_idle_connections_time_out(server: XmlRpcServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "HTTP_IDLE_TIMEOUT", 0.05)
    async with client(server) as c:
        c.writer.write(post(CALL))
        await c.response()
        assert await c.ended() == b""
    assert server.counters["http.timeout"] == 0


async def test_the_longest_idle_makes_room_and_busy_ones_do_not(
    server: XmlRpcServer, echo: Echo, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "HTTP_CONNECTIONS_MAX", 2)
    async with client(server) as first, client(server) as second, contextlib.AsyncExitStack() as stack:
        for c in (first, second):
            c.writer.write(post(CALL))
            await c.response()
        third = await stack.enter_async_context(client(server))
        assert await first.ended() == b""
        for c in (second, third):
            c.writer.write(post(serialize_call("wait", [])))
        while echo.waiting.is_set() is False or server.counters["xmlrpc.calls"] < 4:
            await asyncio.sleep(0)
        fourth = await stack.enter_async_context(client(server))
        assert await fourth.ended() == b""
        echo.go.set()
        for c in (second, third):
            assert parse_response((await c.response())[1]) == "waited"
    assert server.counters["http.evicted"] == 1
    assert server.counters["http.refused.connections"] == 1


async def test_closing_lets_an_answer_leave(server: XmlRpcServer, echo: Echo) -> None:
    async with client(server) as busy, client(server) as idle:
        busy.writer.write(post(serialize_call("wait", [])))
        await echo.waiting.wait()
        closing = asyncio.create_task(server.close())
        assert await idle.ended() == b""
        echo.go.set()
        assert parse_response((await busy.response())[1]) == "waited"
        await closing
    assert len(server._connections) == 0


async def test_port_in_use_has_a_remedy(echo: Echo) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(
            StartError, match=rf"port {port} is already in use by .+ \(pid {os.getpid()}\); end that program"
        ):
            await XmlRpcServer(echo, port=port).start()
    with pytest.raises(StartError, match="does not have that address"):
        await XmlRpcServer(echo, host="192.0.2.1").start()


async def test_a_client_that_half_closes_behind_a_plain_request_is_answered(server: XmlRpcServer, echo: Echo) -> None:
    for method, wanted in (("echo", [1, "echo", []]), ("wait", "waited")):
        async with client(server) as c:
            c.writer.write(post(serialize_call(method, [])))
            c.writer.write_eof()
            echo.go.set()
            assert (await c.ended()).endswith(serialize_response(wanted))  # type: ignore[arg-type]


@pytest.mark.parametrize("cut", [5, 40, 60])
async def test_a_client_that_ends_within_a_plain_request_is_closed(server: XmlRpcServer, cut: int) -> None:
    async with client(server) as c:
        c.writer.write(post(serialize_call("echo", []))[:cut])
        c.writer.write_eof()
        await c.ended()
    while len(server._connections):
        await asyncio.sleep(0.005)
