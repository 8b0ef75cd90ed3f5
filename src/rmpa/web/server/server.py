"""Listens, and runs the application: the I/O of ``rmpa web``."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from aiohttp import web

from rmpa.core.counters import Counters
from rmpa.core.errors import StartError
from rmpa.web import limits
from rmpa.web.server.app import Routes
from rmpa.web.server.connections import ConnectionTable
from rmpa.web.server.pages import read_pages

if TYPE_CHECKING:
    import ssl
    from collections.abc import Sequence

    from rmpa.web.gateways.gateways import Gateways
    from rmpa.web.server.agent_watch import AgentWatch
    from rmpa.web.server.auth import AccessPolicy

_log = logging.getLogger(__name__)
_AIOHTTP: Final = logging.getLogger("rmpa.web.server.aiohttp")
"""What aiohttp says of broken requests; they are counted and logged by us, without tracebacks."""
_AIOHTTP.setLevel(logging.CRITICAL)


class WebServer:
    """One server at one address.

    Args:
        watch: Gives the agent's snapshot; closed with the server.
        policy: Which requests are served.
        host: The address to listen at.
        gateways: Serve WebSocket clients.
        ports: Further ports to listen at.
        tls: Serves HTTPS with its certificate; ``None``: HTTP.
    """

    def __init__(
        self,
        watch: AgentWatch,
        policy: AccessPolicy,
        host: str,
        gateways: Gateways | None = None,
        ports: Sequence[int] = (),
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._tls = tls
        self._gateways = gateways
        self._ports = ports
        self._watch = watch
        self._host = host
        self._policy = policy
        self.counters = Counters()
        """Refusals, by reason."""
        self._table: ConnectionTable | None = None
        self._routes = Routes(
            watch,
            policy,
            read_pages(),
            self._connections,
            self.counters,
            gateways,
        )
        self._runner: web.AppRunner | None = None
        self._servers: list[asyncio.Server] = []

    async def start(self) -> None:
        """Listen.

        Raises:
            StartError: The address cannot be used.
        """
        runner = web.AppRunner(
            self._routes.application(),
            access_log_class=self._routes.access_logger(),
            access_log=_AIOHTTP,
            logger=_AIOHTTP,
            shutdown_timeout=limits.WEB_SHUTDOWN_TIMEOUT,
            keepalive_timeout=limits.WEB_IDLE_TIMEOUT,
            max_line_size=limits.WEB_LINE_MAX,
            max_field_size=limits.WEB_FIELD_MAX,
            max_headers=limits.WEB_HEADERS_MAX,
            lingering_time=limits.WEB_LINGER,
        )
        await runner.setup()
        make = runner.server
        assert make is not None, "setup() makes it"  # noqa: S101 - for the type checker
        self._table = ConnectionTable(make, self.counters)
        loop = asyncio.get_running_loop()
        for port in dict.fromkeys((self._policy.port, *self._ports)):
            try:
                server = await loop.create_server(
                    self._table.make,
                    self._host,
                    port,
                    backlog=limits.WEB_BACKLOG,
                    reuse_address=True,
                    ssl=self._tls,
                    ssl_handshake_timeout=limits.WEB_REQUEST_TIMEOUT if self._tls is not None else None,
                )
            except OSError as error:
                for server in self._servers:
                    server.close()
                self._servers.clear()
                await runner.cleanup()
                problem = f"cannot be listened at: {error.strerror or error}"
                remedy = "choose another --port or --listen" if port == self._policy.port else "see ports of [web]"
                raise StartError(f"{self._host}:{port}", problem, remedy) from None
            self._servers.append(server)
        self._runner = runner

    @property
    def port(self) -> int:
        """The port that it listens at."""
        if not self._servers:
            return self._policy.port
        port: int = self._servers[0].sockets[0].getsockname()[1]
        return port

    def _connections(self) -> tuple[int, int]:
        return (len(self._table), self._table.accepted) if self._table is not None else (0, 0)

    async def close(self) -> None:
        """End: responses under way have ``limits.WEB_SHUTDOWN_TIMEOUT``, then every connection is closed."""
        for server in self._servers:
            server.close()
        if self._gateways is not None:
            await self._gateways.close()
        if self._runner is not None:
            await self._runner.cleanup()
        if self._table is not None:
            self._table.abort_all()
        await self._watch.close()
