"""WebSocket clients at the whole server: who may connect, and what for."""

from __future__ import annotations

import asyncio
import functools
import json
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import aiohttp
import msgspec
import pytest

from rmpa.config.settings import Settings, WebSettings
from rmpa.core.contract import ContractRule, Contracts, Priority
from rmpa.web import limits
from rmpa.web.clients import WebSocketClients
from rmpa.web.hub.frame_writer import Opcode, frame_header
from rmpa.web.hub.node_link import EVERYTHING, NodeRules
from rmpa.web.server.access import AccessPolicy, own_names
from rmpa.web.server.agent_watch import AgentWatch
from rmpa.web.server.app import WebServer
from rmpa.web.server.process import CertificateFiles, TokenAccess, WebSetup, make_hub
from tests.waiting import DEADLINE, until
from tests.web.hub.client import local_core
from tests.web.snapshots import FULL as SNAPSHOT

TOKEN = "secret-" * 6


@asynccontextmanager
async def running(token: str = "", rules: NodeRules = EVERYTHING) -> AsyncIterator[tuple[WebServer, Any]]:
    """A server that may control where it has a token, and its core."""
    async with local_core() as core:
        agent = msgspec.structs.replace(SNAPSHOT.agent, core_uri=core.uri)
        watch = AgentWatch(lambda: msgspec.structs.replace(SNAPSHOT, agent=agent))
        hub = make_hub(watch, 8480, rules)
        settings = Settings(web=WebSettings(control=bool(token)))
        sockets = WebSocketClients(hub, "test", WebSetup(settings, TokenAccess(token), CertificateFiles()).rights)
        access = AccessPolicy(0, own_names(("base",)), token)
        server = WebServer(watch, access, "127.0.0.1", sockets, (0,))
        try:
            async with hub:
                await server.start()
                yield server, core
                await sockets.close()
        finally:
            await server.close()


@pytest.fixture
async def server() -> AsyncIterator[WebServer]:
    async with running() as (made, _):
        yield made


@pytest.fixture
async def session() -> AsyncIterator[aiohttp.ClientSession]:
    async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as made:
        yield made


@asynccontextmanager
async def handshake(server: WebServer, key: str) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """A connection that has asked for a WebSocket."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    request = "GET / HTTP/1.1", "Host: localhost", "Upgrade: websocket", "Connection: Upgrade"
    lines = (*request, "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {key}", "", "")
    writer.write("\r\n".join(lines).encode())
    async with asyncio.timeout(DEADLINE):
        yield reader, writer
    writer.close()


async def refused_for(session: aiohttp.ClientSession, server: WebServer, reason: str) -> bool:
    """Whether one is counted as refused for that reason."""
    async with session.get(f"http://127.0.0.1:{server.port}/metrics") as response:
        return f'rmpa_web_refused_total{{reason="{reason}"}} 1.0' in await response.text()


def connect(session: aiohttp.ClientSession, server: WebServer, path: str = "/", **headers: str) -> Any:
    return session.ws_connect(f"ws://127.0.0.1:{server.port}{path}", headers=headers)


async def test_a_token_in_the_url_opens_a_websocket(session: aiohttp.ClientSession) -> None:
    async with running(TOKEN) as (server, core):
        for path in ("/", "/rosbridge", "/foxglove"):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await connect(session, server, path)
            assert refused.value.status == 401
            async with connect(session, server, f"{path}?token={TOKEN}") as socket:
                topic = f"/cmd{path}".rstrip("/")
                await socket.send_json({"op": "advertise", "topic": topic, "type": "geometry_msgs/Twist"})
                await until(functools.partial(core.publishers, topic))


MASK = bytes(4)


@pytest.mark.parametrize(
    ("frame", "code", "reason"),
    [
        pytest.param(frame_header(Opcode.TEXT, 2) + b"{}", 1002, "message", id="without a mask"),
        pytest.param(b"\xf1\x80" + MASK, 1002, "message", id="reserved bits"),
        pytest.param(b"\x83\x80" + MASK, 1002, "message", id="an unknown opcode"),
        pytest.param(b"\x09\x80" + MASK, 1002, "message", id="a ping in pieces"),
        pytest.param(b"\x89\xfe\x00\x7e" + MASK + bytes(126), 1002, "message", id="a ping that is too long"),
        pytest.param(b"\x80\x80" + MASK, 1002, "message", id="the continuation of nothing"),
        pytest.param(b"\x81\x82" + MASK + b"\xff\xfe", 1007, "message", id="text that is no UTF-8"),
        pytest.param(b"\x81\xff" + struct.pack("!Q", 1 << 40) + MASK, 1009, "message_size", id="the header of 1 TiB"),
    ],
)
async def test_a_client_whose_frames_are_broken_is_disconnected(
    server: WebServer, session: aiohttp.ClientSession, frame: bytes, code: int, reason: str
) -> None:
    """RFC 6455, section 5: the server closes the connection, with the code that it says."""
    async with handshake(server, "dGhlIHNhbXBsZSBub25jZQ==") as (reader, writer):
        assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 101")
        writer.write(frame)
        received = await reader.read()
    assert received[2:4] == code.to_bytes(2, "big")
    assert b"status" not in received  # the frame itself was not answered
    assert await refused_for(session, server, reason)


async def test_a_client_beyond_the_bound_is_told_so_and_requests_are_served(
    server: WebServer, session: aiohttp.ClientSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "CLIENTS_MAX", 3)
    sockets = [await connect(session, server) for _ in range(3)]
    with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
        await connect(session, server)
    assert refused.value.status == 503
    assert await refused_for(session, server, "clients")
    for socket in sockets:
        await socket.close()


async def test_a_websocket_stays_whatever_else_connects(
    server: WebServer, session: aiohttp.ClientSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "WEB_CONNECTIONS_MAX", 2)
    async with connect(session, server) as client:
        silent = [await asyncio.open_connection("127.0.0.1", server.port) for _ in range(3)]
        async with asyncio.timeout(DEADLINE):
            assert await silent[0][0].read() == b"", "the idlest was not closed"
            await client.send_str('{"op": "call_service", "service": "/rosapi/get_time"}')
            assert json.loads((await client.receive()).data)["result"]
        for _, writer in silent:
            writer.close()


async def test_a_failed_handshake_is_counted_and_its_connection_keeps_its_limits(
    server: WebServer, session: aiohttp.ClientSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with handshake(server, "x") as (reader, writer):
        assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 400")
        monkeypatch.setattr(limits, "WEB_REQUEST_TIMEOUT", 0.1)
        writer.write(b"GET /heal")
        assert b"handshake" in await reader.read()  # and then it is closed
    for reason in ("handshake", "slow_request"):
        assert await refused_for(session, server, reason)


async def test_contracts_give_priorities() -> None:
    rules = (
        ContractRule(("/cmd_vel",), (), {"priority": Priority.HIGH}),
        ContractRule(("/image",), (), {"priority": Priority.LOW}),
    )
    hub = make_hub(AgentWatch(lambda: SNAPSHOT), 8480, contracts=Contracts(rules))
    assert [hub.priority(topic) for topic in ("/cmd_vel", "/odom", "/image")] == [1, 0, -1]


def fragment(opcode: int, payload: bytes, *, last: bool = False) -> bytes:
    """A client's frame, with a mask that changes nothing."""
    return bytes([0x80 * last | opcode, 0x80 | len(payload)]) + bytes(4) + payload


async def test_a_message_whose_fragments_never_end_disconnects_its_client_alone(
    server: WebServer, session: aiohttp.ClientSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "PING_INTERVAL", 0.1)
    monkeypatch.setattr(limits, "MESSAGE_TIMEOUT", 0.4)
    async with connect(session, server) as other, connect(session, server) as socket:
        reading = asyncio.ensure_future(other.receive())  # answers pings
        transport = socket._writer.transport
        transport.write(fragment(1, b"{"))

        async def go_on() -> None:
            while True:
                transport.write(fragment(0, b" ") + fragment(10, b"alive", last=True))
                await asyncio.sleep(0.05)

        going_on = asyncio.ensure_future(go_on())
        async with asyncio.timeout(DEADLINE):
            message = await socket.receive()
        going_on.cancel()
        assert (message.type, message.data) == (aiohttp.WSMsgType.CLOSE, 1008)
        assert server._clients is not None
        assert server._clients.counters["message"] == 1
        await other.send_json({"op": "call_service", "service": "/rosapi/get_time", "id": "1"})
        assert json.loads((await asyncio.wait_for(reading, DEADLINE)).data)["result"]
