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
    """

    def __init__(self, watch: AgentWatch, policy: AccessPolicy, host: str) -> None:
        self._watch = watch
        self._host = host
        self._policy = policy
        self.counters = Counters()
        """Refusals, by reason."""
        self._table: ConnectionTable | None = None
        self._routes = Routes(watch, policy, read_pages(), self._connections, self.counters)
        self._runner: web.AppRunner | None = None
        self._server: asyncio.Server | None = None

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
        port = self._policy.port
        try:
            self._server = await loop.create_server(
                self._table.make, self._host, port, backlog=limits.WEB_BACKLOG, reuse_address=True
            )
        except OSError as error:
            await runner.cleanup()
            problem = f"cannot be listened at: {error.strerror or error}"
            raise StartError(f"{self._host}:{port}", problem, "choose another --port or --listen") from None
        self._runner = runner

    @property
    def port(self) -> int:
        """The port that it listens at."""
        if self._server is None:
            return self._policy.port
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    def _connections(self) -> tuple[int, int]:
        return (len(self._table), self._table.accepted) if self._table is not None else (0, 0)

    async def close(self) -> None:
        """End: responses under way have ``limits.WEB_SHUTDOWN_TIMEOUT``, then every connection is closed."""
        if self._server is not None:
            self._server.close()
        if self._runner is not None:
            await self._runner.cleanup()
        if self._table is not None:
            self._table.abort_all()
        await self._watch.close()
