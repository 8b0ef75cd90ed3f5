from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator

import pytest

from rmpa.core.errors import RemoteProtocolError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.http.rpc import call, connect, split_uri
from rmpa.ros.wire.xmlrpc import serialize_response

OK = serialize_response([1, "", 5])


@contextlib.asynccontextmanager
async def answering(*parts: bytes, hang: bool = False) -> AsyncIterator[str]:
    """A server that answers each connection with the same bytes, in parts, and closes."""
    done = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            await reader.readuntil(b"</methodCall>\n")
            for part in parts:
                writer.write(part)
                await writer.drain()
            if hang:
                await done.wait()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/"
    done.set()
    server.close()
    await asyncio.sleep(0)


def http(body: bytes, status: bytes = b"200 OK", length: bytes = b"Content-length: %d\r\n") -> bytes:
    return (
        b"HTTP/1.1 "
        + status
        + b"\r\nServer: XMLRPC++ 0.7\r\n"
        + (length % len(body) if length else b"")
        + b"\r\n"
        + body
    )


@pytest.mark.trap(28)
@pytest.mark.parametrize("status", [b"200 OK", b"500 whatever", b"404 Not Found"])
async def test_the_status_is_not_believed(status: bytes) -> None:
    async with answering(http(OK, status)) as uri:
        assert await call(uri, "m") == [1, "", 5]


async def test_names_of_this_machine_need_no_resolver(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_resolver(*_: object) -> None:
        raise AssertionError("the resolver was asked")

    monkeypatch.setattr(socket, "getaddrinfo", no_resolver)
    async with answering(http(OK)) as uri:
        for name in ("localhost", socket.gethostname()):
            assert await call(uri.replace("127.0.0.1", name), "m") == [1, "", 5]


@pytest.mark.parametrize(
    "answer",
    [
        b"", b"garbage\r\n\r\n", http(b"<garbage/>"), http(OK)[:-5],
        b"HTTP/1.1 200 OK\r\nContent-length: 99999999\r\n\r\n" + b"x" * 100,
    ],
)  # fmt: skip
async def test_bad_answers_are_the_other_sides_fault(answer: bytes) -> None:
    async with answering(answer) as uri:
        with pytest.raises(RemoteProtocolError):
            await call(uri, "m")


async def test_too_large_an_answer_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "HTTP_BODY_MAX", 100)
    async with answering(http(b"x" * 200)) as uri:
        with pytest.raises(RemoteProtocolError, match="exceeds the limit of 100"):
            await call(uri, "m")


async def test_no_answer_in_time() -> None:
    async with answering(hang=True) as uri:
        with pytest.raises(UnreachableError, match=r"no answer to m in 0\.05 s"):
            await call(uri, "m", timeout=0.05)


async def test_nobody_listens() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
        with pytest.raises(UnreachableError, match="Connection refused; is that program running"):
            await call(f"http://127.0.0.1:{port}/", "m")
        with pytest.raises(ConnectionRefusedError):
            await connect("127.0.0.1", port)


@pytest.mark.trap(30)
@pytest.mark.parametrize(
    "uri", ["", "http://host/", "rosrpc://host:5", "http://:5/", "http://h:99999/", "http://[x:5/", "x"]
)
async def test_uris_need_a_host_and_a_port(uri: str) -> None:
    with pytest.raises(UnreachableError, match="looks like"):
        await call(uri, "m")


def test_uris_are_split() -> None:
    assert split_uri("http://host:5") == ("host", 5, "/")
    assert split_uri("http://host:5/RPC2") == ("host", 5, "/RPC2")


async def test_a_name_that_does_not_resolve(monkeypatch: pytest.MonkeyPatch) -> None:
    async def fails(*_: object, **__: object) -> None:
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", fails)
    with pytest.raises(UnreachableError, match="does not resolve here"):
        await call("http://robot-7:11311/", "m")
