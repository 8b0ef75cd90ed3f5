"""The control socket, served and called."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from typing import TYPE_CHECKING

import msgspec
import pytest

from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, StartError, UnreachableError
from rmpa.observe import limits
from rmpa.observe.control_client import (
    GATEWAY_ROLE,
    ROLE,
    ControlClient,
    ControlReply,
    choose_agent,
    find_agents,
    same_core,
)
from rmpa.observe.control_server import ControlServer, Handler
from rmpa.observe.snapshot import PingReply, Snapshot
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable
    from pathlib import Path

    Serve = Callable[..., Awaitable[ControlServer]]


async def slow_echo(args: dict[str, object]) -> object:
    await asyncio.sleep(0)
    return args


def fail(_: dict[str, object]) -> object:
    raise ValueError("a bug")


def refuse(_: dict[str, object]) -> object:
    raise UnreachableError("peer", "10.0.0.9", "is it on?")


HANDLERS: dict[str, Handler] = {
    "snapshot": lambda _: SNAPSHOT,
    "echo": slow_echo,
    "ping": lambda _: PingReply(times=(0.5, None), remote="x"),
    "fail": fail,
    "refuse": refuse,
    "object": lambda _: object(),
}


@pytest.fixture
async def serve(place: Path) -> AsyncIterator[Serve]:
    servers: list[ControlServer] = []

    async def serve(name: str = "base", handlers: dict[str, Handler] = HANDLERS) -> ControlServer:
        servers.append(ControlServer(place, name, handlers))
        await servers[-1].start()
        return servers[-1]

    yield serve
    for server in servers:
        await server.close()
    assert list(place.iterdir()) == []


@pytest.fixture
async def server(serve: Serve) -> ControlServer:
    return await serve()


@contextlib.asynccontextmanager
async def connected(path: Path) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_unix_connection(path, limit=limits.CONTROL_REPLY_MAX)
    try:
        yield reader, writer
    finally:
        writer.close()
        await asyncio.gather(writer.wait_closed(), return_exceptions=True)


async def call(path: Path, op: str, **args: object) -> object:
    def blocking() -> object:
        with ControlClient(path) as client:
            return client.call(op, object, **args)

    return await asyncio.to_thread(blocking)


def snapshot_of(path: Path) -> Snapshot:
    with ControlClient(path) as client:
        return client.snapshot()


async def raw(path: Path, data: bytes) -> list[ControlReply]:
    """Send bytes, and read all replies until the server hangs up."""
    async with connected(path) as (reader, writer):
        writer.write(data)
        writer.write_eof()
        return [ControlReply.parse(line) for line in (await reader.read()).splitlines()]


async def test_only_this_user_can_open_the_socket(server: ControlServer, place: Path) -> None:
    assert server.path.stat().st_mode & 0o777 == 0o600
    assert place.stat().st_mode & 0o777 == 0o700


async def test_calls(server: ControlServer) -> None:
    assert await call(server.path, "echo", a=1, b=[True, None]) == {"a": 1, "b": [True, None]}
    snapshot = await asyncio.to_thread(snapshot_of, server.path)
    assert snapshot == SNAPSHOT


async def test_many_requests_on_one_connection_byte_by_byte(server: ControlServer) -> None:
    async with connected(server.path) as (reader, writer):
        for byte in b'{"op":"echo","args":{"n":1}}\n{"op":"echo"}\n':
            writer.write(bytes([byte]))
            await writer.drain()
        assert await reader.readline() == b'{"ok":true,"value":{"n":1}}\n'
        assert await reader.readline() == b'{"ok":true,"value":{}}\n'


async def test_errors_reach_the_client_with_their_remedy(server: ControlServer) -> None:
    with pytest.raises(PeerRefused, match="no op 'snapshto'; did you mean snapshot"):
        await call(server.path, "snapshto")
    with pytest.raises(PeerRefused, match=r"agent base refused: no peer answers at 10.0.0.9; is it on\?"):
        await call(server.path, "refuse")


async def test_a_handlers_bug_is_logged_and_the_connection_goes_on(
    server: ControlServer, caplog: pytest.LogCaptureFixture
) -> None:
    replies = await raw(server.path, b'{"op":"fail"}\n{"op":"object"}\n{"op":"echo"}\n')
    assert [reply.ok for reply in replies] == [False, False, True]
    assert "its log says why" in replies[0].remedy
    assert "ValueError: a bug" in caplog.text
    assert server.counters["control.failed"] == 1


async def test_a_handlers_own_time_out_is_not_the_servers(serve: Serve, caplog: pytest.LogCaptureFixture) -> None:
    def fail(_: dict[str, object]) -> object:
        raise TimeoutError("of a lock")

    server = await serve(handlers={"fail": fail})
    (reply,) = await raw(server.path, b'{"op":"fail"}\n')
    assert reply.error == "the agent failed at fail"
    assert "TimeoutError: of a lock" in caplog.text


@pytest.mark.parametrize("data", [b"GET / HTTP/1.1\r\n\r\n", b"\x00\xff\n", b"{}\n", b"[" * 5000 + b"\n"])
async def test_garbage_is_answered_counted_and_closed(
    server: ControlServer, data: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    (reply,) = await raw(server.path, data + b'{"op":"echo"}\n')
    assert not reply.ok
    assert server.counters["control.refused"] == 1
    assert [record.levelno for record in caplog.records if record.levelno >= logging.WARNING] == [logging.WARNING]


async def test_half_a_request_is_no_error(server: ControlServer) -> None:
    assert await raw(server.path, b'{"op":"ec') == []
    assert server.counters.as_dict() == {}


async def test_too_large_a_request(server: ControlServer) -> None:
    async with connected(server.path) as (reader, writer):
        writer.write(b"x" * (limits.CONTROL_REQUEST_MAX + 2))
        assert not ControlReply.parse(await reader.readline()).ok
    assert server.counters["control.refused"] == 1


async def test_too_many_clients(server: ControlServer) -> None:
    async with contextlib.AsyncExitStack() as stack:
        for _ in range(limits.CONTROL_CLIENTS_MAX):
            reader, writer = await stack.enter_async_context(connected(server.path))
            writer.write(b'{"op":"echo"}\n')
            assert (await reader.readline()).startswith(b'{"ok":true')
        (reply,) = await raw(server.path, b"")
        assert "too many clients" in reply.error


async def test_an_idle_client_is_closed(server: ControlServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "CONTROL_IDLE_TIMEOUT", 0.05)
    async with connected(server.path) as (reader, _):
        assert await reader.read() == b""


async def test_a_handler_that_hangs_is_ended(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "CONTROL_HANDLER_TIMEOUT", 0.05)

    async def hang(_: dict[str, object]) -> object:
        return await asyncio.get_running_loop().create_future()

    (reply,) = await raw((await serve("base", {"hang": hang})).path, b'{"op":"hang"}\n')
    assert "took more than" in reply.error


async def test_closing_ends_clients(server: ControlServer) -> None:
    async with connected(server.path) as (reader, writer):
        writer.write(b'{"op":"echo"}\n')
        await reader.readline()
        await server.close()
        assert await reader.read() == b""


async def test_a_stale_socket_is_replaced(serve: Serve, place: Path) -> None:
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(place / "base.sock"))
    assert find_agents({"RMPA_RUNTIME_DIR": str(place)}) == []
    assert await call((await serve()).path, "echo") == {}


async def test_too_long_a_path_says_what_to_do(place: Path) -> None:
    with pytest.raises(StartError, match="set RMPA_RUNTIME_DIR to a shorter directory"):
        await ControlServer(place / ("x" * 100), "base", {}).start()


@pytest.mark.usefixtures("server")
async def test_choosing_an_agent(serve: Serve, place: Path) -> None:
    env = {"RMPA_RUNTIME_DIR": str(place)}

    async def choose(name: str | None = None, **more: str) -> str:
        return (await asyncio.to_thread(choose_agent, env | more, name)).name

    assert await choose() == "base"
    with pytest.raises(UnreachableError, match=r"no agent 'bse' answers at .*/bse\.sock; running here: base"):
        await choose("bse")
    moved = msgspec.structs.replace(
        SNAPSHOT, agent=msgspec.structs.replace(SNAPSHOT.agent, core_uri="http://127.0.0.1:11312/")
    )
    second = await serve("second", {"snapshot": lambda _: moved})
    with pytest.raises(RmpaError, match="several agents run on this machine: base, second; name one with --agent"):
        await choose()
    assert await choose("second") == "second"
    assert await choose(RMPA_AGENT="second") == "second"
    assert await choose(ROS_MASTER_URI="http://localhost:11312") == "second"
    await second.close()
    await serve("gate", {"snapshot": lambda _: moved, ROLE: lambda _: GATEWAY_ROLE})
    assert await choose() == "base", "a gateway beside the agent is asked only by its name"
    assert await choose("gate") == "gate"


def test_no_agent_at_all(place: Path) -> None:
    with pytest.raises(UnreachableError, match=f"no agent answers at {place}; start one with `rmpa up`"):
        choose_agent({"RMPA_RUNTIME_DIR": str(place)})
    with pytest.raises(UnreachableError, match="start it with `rmpa up --name base`"):
        choose_agent({"RMPA_RUNTIME_DIR": str(place), "RMPA_AGENT": "base"})


async def test_another_kind_of_answer(serve: Serve) -> None:
    server = await serve("base", {"snapshot": lambda _: 5})
    with pytest.raises(RemoteProtocolError, match="is it older"):
        await asyncio.to_thread(snapshot_of, server.path)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("http://127.0.0.1:11311/", "http://localhost:11311", True),
        ("http://127.0.0.1:11311/", "http://localhost:11312", False),
        ("http://10.0.0.1:1", "http://10.0.0.1:1/", True),
        ("http://10.0.0.1:1", "http://localhost:1/", False),
        ("http://127.0.0.1:1/", f"http://{socket.gethostname()}:1", True),
        ("http://localhost", "http://localhost", False),
        ("http://localhost:x", "http://localhost:1", False),
    ],
)
def test_same_core(one: str, other: str, same: bool) -> None:
    assert same_core(one, other) is same
