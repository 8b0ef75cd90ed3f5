"""The process ``rmpa web``: makes the server of the settings, says where it is, and runs it until a signal."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rmpa.core.contract import Contracts
from rmpa.core.errors import StartError
from rmpa.runtime.state_dir import module_dir, state_dir
from rmpa.web.gateways.gateways import Gateways
from rmpa.web.monitor.io.monitor import Monitor
from rmpa.web.server import auth
from rmpa.web.server.agent_watch import AgentWatch, ControlReader
from rmpa.web.server.graph_signal import GraphSignal
from rmpa.web.server.hub_setup import make_hub, priority_of, rights_of
from rmpa.web.server.server import WebServer
from rmpa.web.server.tls import tls_context
from rmpa.web.server.token_file import token_from

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.config.settings import WebSettings

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Address:
    """Where a server is.

    Attributes:
        url: Of its first page; with the token if that was made now.
        token_file: Where the token is; empty where none is needed.
        is_new: Whether the token was made now.
    """

    url: str
    token_file: str
    is_new: bool


@dataclass(frozen=True, slots=True)
class TokenAccess:
    """The token of a server, and where it is."""

    token: str = ""
    file: Path | None = None
    is_new: bool = False


def access_of(web: WebSettings, module: str, environ: Mapping[str, str], state: str = "") -> TokenAccess:
    """The token that the settings ask for: one beyond loopback, for control or driving, or where a file is given.

    Args:
        web: The settings.
        module: The module's name; its token is in its folder of the state directory.
        environ: As for ``state_dir``.
        state: ``Settings.state_dir``.

    Raises:
        StartError: The file cannot be used, or there is no place for one.
    """
    if auth.is_loopback(web.listen) and not (web.token_file or web.control or web.drive):
        return TokenAccess()
    if web.token_file:
        file = Path(web.token_file)
    else:
        place = state_dir(environ, state or None)
        if place is None:
            raise StartError("rmpa web", "there is no state directory for the token", "choose a --token-file")
        file = module_dir(place, module) / "web-token"
    token, is_new = token_from(file)
    return TokenAccess(token, file, is_new)


def address_of(web: WebSettings, access: TokenAccess, port: int) -> Address:
    """Where a server is, for the user."""
    host = socket.gethostname() if web.listen == "0.0.0.0" else web.listen  # noqa: S104 - compared
    query = f"?{auth.TOKEN_PARAMETER}={access.token}" if access.is_new else ""
    scheme = "https" if web.cert else "http"
    return Address(f"{scheme}://{host}:{port}/{query}", str(access.file or ""), access.is_new)


async def serve(
    web: WebSettings,
    access: TokenAccess,
    agent: str | None,
    announce: Callable[[Address], None],
    *,
    with_agent: bool,
    contracts: Contracts | None = None,
) -> None:
    """Serve until SIGINT or SIGTERM.

    Args:
        web: The settings.
        access: The token.
        agent: The agent's name; ``None``: the one that runs.
        announce: Called when the server listens.
        with_agent: Whether to end when standard input ends: it is a pipe that the agent holds open.
        contracts: Their priorities say whose messages go first to a slow client.

    Raises:
        StartError: The address cannot be used.
    """
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    reader = ControlReader(os.environ, agent)
    hosts = auth.own_names((socket.gethostname(), *web.hosts)) | {web.listen.lower()}
    origins = frozenset(origin.lower().rstrip("/") for origin in web.origins)
    policy = auth.AccessPolicy(web.port, hosts, access.token, origins)
    watch = AgentWatch(reader)
    hub = make_hub(watch, web.port)
    rights = rights_of(has_token=bool(access.token), control=web.control, drive=web.drive)

    def watched(is_open: bool) -> None:
        reader.figures = is_open

    monitor = Monitor(hub, watch, agent=agent, watched=watched)
    changes = GraphSignal(os.environ, lambda: agent or monitor.mesh.agent or None, hub.graph)
    gateways = Gateways(
        hub,
        f"RMPA {agent or socket.gethostname()}",
        lambda _: rights,
        priority_of(hub, contracts or Contracts()),
        monitor,
    )
    server = WebServer(watch, policy, web.listen, gateways, web.ports, tls_context(web.cert, web.key))
    try:
        async with hub:
            await server.start()
            monitor.start()
            changes.start()
            if with_agent:
                _stop_at_end_of_input(loop, stop)
            announce(address_of(web, access, server.port))
            await stop.wait()
            _log.info("= ending")
            await gateways.close()
            await changes.close()
            await monitor.close()
    finally:
        await server.close()
        reader.close()


def _stop_at_end_of_input(loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
    descriptor = sys.stdin.fileno()

    def readable() -> None:
        if not os.read(descriptor, 4096):  # the agent has ended, however it did
            loop.remove_reader(descriptor)
            stop.set()

    loop.add_reader(descriptor, readable)
