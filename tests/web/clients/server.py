"""Both sockets at a port of this machine, and WebSocket clients of another library's making."""

from __future__ import annotations

import asyncio
import contextlib
import json
import ssl
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import aiohttp
from aiohttp import web

from rmpa.core.contract import Contracts
from rmpa.ros.core.embedded import RosCore
from rmpa.web.clients import MONITOR_PATH, WebSocketClients
from rmpa.web.hub.node_link import FULL, Rights
from rmpa.web.monitor.monitor import Monitor
from rmpa.web.server.agent_watch import AgentWatch
from tests.waiting import DEADLINE
from tests.web.hub.client import running_hub


class Client:
    """A WebSocket client of aiohttp."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket

    async def send(self, op: str, **values: Any) -> None:
        await self.socket.send_str(json.dumps({"op": op, **values}))

    async def next(self, op: str) -> dict[str, Any]:
        """The next text frame of this op; others are skipped."""
        while (values := json.loads(await self._next(aiohttp.WSMsgType.TEXT)))["op"] != op:
            pass
        found: dict[str, Any] = values
        return found

    async def next_bytes(self) -> bytes:
        """The next binary frame."""
        return bytes(await self._next(aiohttp.WSMsgType.BINARY))

    async def _next(self, kind: aiohttp.WSMsgType) -> Any:
        async with asyncio.timeout(DEADLINE):
            while (message := await self.socket.receive()).type != kind:
                assert message.type not in (aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.CLOSE), message
            return message.data


class Server:
    """The sockets, and their port."""

    def __init__(self, sockets: WebSocketClients, hub: Any, port: int, session: aiohttp.ClientSession) -> None:
        self.sockets = sockets
        self.hub = hub
        self.port = port
        self.session = session
        self.scheme = "ws"

    @contextlib.asynccontextmanager
    async def client(self, *protocols: str, path: str = "/") -> AsyncIterator[Client]:
        """A client that offers subprotocols."""
        url = f"{self.scheme}://127.0.0.1:{self.port}{path}"
        async with self.session.ws_connect(url, protocols=protocols, max_msg_size=0) as socket:
            yield Client(socket)


@contextlib.asynccontextmanager
async def running_server(
    core: RosCore,
    rights: Rights = FULL,
    *,
    contracts: Contracts | None = None,
    port: int = 0,
    watch: AgentWatch | None = None,
    tls: tuple[ssl.SSLContext, ssl.SSLContext] | None = None,
    static: Path | None = None,
) -> AsyncIterator[Server]:
    """The sockets; with ``watch``, which asks an agent, also the monitor; with ``tls`` by WSS.

    Args:
        static: The folder of the pages, which are at ``/pages``.
        tls: The contexts of the server and of its clients.
    """
    async with running_hub(core, contracts=contracts) as hub:
        monitor = Monitor(hub, watch, {}) if watch is not None else None
        if monitor is not None:
            monitor.start()
        sockets = WebSocketClients(hub, "test", rights, monitor)
        app = web.Application()
        for path in ("/", MONITOR_PATH):
            app.router.add_get(path, sockets.handle)
        if static is not None:

            async def index(_: web.Request) -> web.FileResponse:
                return web.FileResponse(static / "index.html")

            app.router.add_get("/pages", index)
            app.router.add_static("/static", static)
        runner = web.AppRunner(app, shutdown_timeout=1)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", port, ssl_context=tls[0] if tls else None)
        await site.start()
        port = runner.addresses[0][1]
        try:
            connector = aiohttp.TCPConnector(ssl=tls[1]) if tls else None
            async with aiohttp.ClientSession(connector=connector) as session:
                server = Server(sockets, hub, port, session)
                server.scheme = "wss" if tls else "ws"
                yield server
        finally:
            await sockets.close()
            await runner.cleanup()
            if monitor is not None:
                await monitor.close()
