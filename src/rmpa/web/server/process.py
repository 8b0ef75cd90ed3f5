"""The process ``rmpa web``: makes the server of the settings, says where it is, and runs it until a signal."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rmpa.config.state_dir import module_dir, state_dir
from rmpa.core.errors import RmpaError, StartError
from rmpa.trust.page_names import server_names
from rmpa.web.gateways.gateways import Gateways
from rmpa.web.monitor.io.monitor import Monitor
from rmpa.web.server import auth
from rmpa.web.server.agent_watch import AgentWatch, ControlReader
from rmpa.web.server.app import CLIENT
from rmpa.web.server.graph_signal import GraphSignal
from rmpa.web.server.hub_setup import make_hub, priority_of
from rmpa.web.server.roles import WebRoles
from rmpa.web.server.server import WebServer
from rmpa.web.server.tls import CertificateFiles, ServerCertificate
from rmpa.web.server.token_file import token_from
from rmpa.web.server.trust_watch import TrustWatch

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rmpa.config.settings import Settings, WebSettings
    from rmpa.config.web_tokens import WebToken
    from rmpa.trust.status import TrustStatus

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Address:
    """Where a server is.

    Attributes:
        url: Of its first page; with the token if that was made now.
        token_file: Where the token is; empty where none is needed.
        is_new: Whether the token was made now.
        clients: The names of clients with tokens of their own, and where those are.
    """

    url: str
    token_file: str
    is_new: bool
    clients: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class ClientToken:
    """The token of one ``[[web_token]]``, and where it is."""

    name: str
    token: str = field(repr=False)
    file: Path


@dataclass(frozen=True, slots=True)
class TokenAccess:
    """The tokens of a server, and where they are."""

    token: str = field(default="", repr=False)
    file: Path | None = None
    is_new: bool = False
    clients: tuple[ClientToken, ...] = ()


@dataclass(frozen=True, slots=True)
class WebSetup:
    """What a server is made of.

    Args:
        settings: All settings, with those of the command line.
        access: The tokens.
        files: The certificate of HTTPS.
        trusted: Whether this module is in a secured mesh.
        module: The module's name.
        trust_folder: Where its files of trust are.
    """

    settings: Settings
    access: TokenAccess
    files: CertificateFiles
    trusted: bool = False
    module: str = ""
    trust_folder: str = ""

    def fits(self, agent: TrustStatus | None) -> bool:
        """Whether a server made of this is as secure as an agent; ``None``: an agent without trust."""
        return agent is None or (self.trusted and agent.module == self.module and agent.folder == self.trust_folder)

    @property
    def policy(self) -> auth.AccessPolicy:
        """Which requests are served."""
        web = self.settings.web
        hosts = auth.own_names((socket.gethostname(), *web.hosts)) | {web.listen.lower()}
        if self.trusted:
            hosts |= frozenset(server_names(self.module))
        origins = frozenset(origin.lower().rstrip("/") for origin in web.origins)
        clients = tuple((each.name, each.token) for each in self.access.clients)
        return auth.AccessPolicy(web.port, hosts, self.access.token, origins, clients)

    @property
    def roles(self) -> WebRoles:
        """What clients may do."""
        return WebRoles(self.settings, has_token=bool(self.access.token), trusted=self.trusted)


def access_of(
    web: WebSettings, module: str, environ: Mapping[str, str], state: str = "", tokens: Sequence[WebToken] = ()
) -> TokenAccess:
    """The tokens that the settings ask for.

    The server's own is there beyond loopback, for control or driving, or where a file or another token is given.

    Args:
        web: The settings.
        module: The module's name; its tokens are in its folder of the state directory.
        environ: As for ``state_dir``.
        state: ``Settings.state_dir``.
        tokens: Those of ``[[web_token]]``.

    Raises:
        StartError: A file cannot be used, two have the same token, or there is no place for one.
    """
    if auth.is_loopback(web.listen) and not (web.token_file or web.control or web.drive or tokens):
        return TokenAccess()
    place = state_dir(environ, state or None)
    folder = module_dir(place, module) if place is not None else None

    def read(given: str, name: str) -> tuple[Path, str, bool]:
        if not given and folder is None:
            raise StartError("rmpa web", "there is no state directory for the token", "choose a --token-file")
        file = Path(given) if given or folder is None else folder / name
        return file, *token_from(file)

    file, token, is_new = read(web.token_file, "web-token")
    known, clients = {token: file}, []
    for each in tokens:
        path, its, _ = read(each.file, f"web-tokens/{each.name}")
        if its in known:
            raise StartError(str(path), f"has the same token as {known[its]}", "remove it, and rmpa web makes one")
        known[its] = path
        clients.append(ClientToken(each.name, its, path))
    return TokenAccess(token, file, is_new, tuple(clients))


def address_of(web: WebSettings, access: TokenAccess, port: int, *, is_https: bool = False) -> Address:
    """Where a server is, for the user."""
    host = socket.gethostname() if web.listen == "0.0.0.0" else web.listen  # noqa: S104 - compared
    query = f"?{auth.TOKEN_PARAMETER}={access.token}" if access.is_new else ""
    scheme = "https" if is_https else "http"
    clients = tuple((each.name, str(each.file)) for each in access.clients)
    return Address(f"{scheme}://{host}:{port}/{query}", str(access.file or ""), access.is_new, clients)


async def serve(
    setup: WebSetup,
    agent: str | None,
    announce: Callable[[Address], None],
    *,
    with_agent: bool,
    load: Callable[[], WebSetup] | None = None,
) -> bool:
    """Serve until SIGINT or SIGTERM; at SIGHUP tokens, roles and rules are read again.

    Returns:
        Whether the agent is secured in another way than this setup, so that another one is to be served.

    Args:
        setup: The settings, tokens and certificate.
        agent: The agent's name; ``None``: the one that runs.
        announce: Called when the server listens.
        with_agent: Whether to end when standard input ends: it is a pipe that the agent holds open.
        load: Reads all of ``setup`` again; it may block, and raise ``RmpaError``.

    Raises:
        StartError: The address or the certificate cannot be used.
    """
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    web = setup.settings.web
    trust = TrustWatch(os.environ, agent, setup.fits)
    reader = ControlReader(os.environ, agent, trust.check)
    watch = AgentWatch(reader, read_whole=reader.read_whole, read_named=reader.read_named)
    hub = make_hub(watch, web.port)

    def watched(is_open: bool) -> None:
        reader.figures = is_open

    monitor = Monitor(hub, watch, agent=agent, watched=watched)
    changes = GraphSignal(os.environ, lambda: agent or monitor.mesh.agent or None, hub.graph)
    reload = WebReload(setup, load)
    gateways = Gateways(
        hub,
        f"RMPA {setup.module or socket.gethostname()}",
        lambda request: reload.roles.of(request[CLIENT]),
        priority_of(hub, setup.settings.make_contracts()),
        monitor,
    )
    certificate = ServerCertificate(setup.files)
    server = WebServer(watch, setup.policy, web.listen, gateways, web.ports, certificate.context)
    loop.add_signal_handler(signal.SIGHUP, reload.request)
    try:
        async with hub:
            await server.start()
            certificate.start()
            monitor.start()
            changes.start()
            reload.start(server, gateways)
            trust.start()
            if with_agent:
                _stop_at_end_of_input(loop, stop)
            announce(address_of(web, setup.access, server.port, is_https=certificate.context is not None))
            await _first_of(stop, trust.misfit)
            _log.info("= ending" if stop.is_set() else "= the agent is secured: beginning anew with its certificate")
            await gateways.close()
            await changes.close()
            await monitor.close()
    finally:
        await trust.close()
        await reload.close()
        await certificate.close()
        await server.close()
        reader.close()
    return not stop.is_set()


async def _first_of(*events: asyncio.Event) -> None:
    """Wait for one of several events."""
    waits = [asyncio.ensure_future(event.wait()) for event in events]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
        await asyncio.wait(waits)


class WebReload:
    """Takes tokens, roles and rules that were changed while the server runs, and ends clients whose rights changed.

    Args:
        setup: What the server runs with.
        load: Reads it again; ``None``: nothing is read again.
    """

    def __init__(self, setup: WebSetup, load: Callable[[], WebSetup] | None) -> None:
        self._load = load
        self._asked = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._known = _rights_in(setup)
        self._trusted = setup.trusted
        self.roles = setup.roles
        """What clients may do now."""

    def request(self) -> None:
        """Read the settings again soon."""
        self._asked.set()

    def start(self, server: WebServer, gateways: Gateways) -> None:
        """Begin to wait for requests, in a task."""
        self._task = asyncio.get_running_loop().create_task(self._run(server, gateways), name="reload rmpa web")

    async def close(self) -> None:
        """End."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    async def _run(self, server: WebServer, gateways: Gateways) -> None:
        while True:
            await self._asked.wait()
            self._asked.clear()
            if self._load is None:
                continue
            try:
                setup = await asyncio.to_thread(self._load)
            except RmpaError as error:
                _log.error("! rmpa web keeps its tokens and rules: %s", error)
                continue
            if self._trusted and not setup.trusted:  # the agent is away, and another module was found meanwhile
                _log.error("! rmpa web keeps its tokens and rules: the module with keys is not found now")
                continue
            if _rights_in(setup) == self._known:
                continue
            self._known = _rights_in(setup)
            self.roles = setup.roles
            server.take(setup.policy)
            ended = await gateways.end_changed()
            _log.info("= tokens and rules are read again; %d clients with other rights connect again", ended)


def _rights_in(setup: WebSetup) -> object:
    """All of a setup that rights and tokens depend on."""
    web = setup.settings.web
    return (
        setup.settings.trust,
        setup.settings.web_tokens,
        setup.access.clients,
        web.control,
        web.drive,
        setup.trusted,
    )


def _stop_at_end_of_input(loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
    descriptor = sys.stdin.fileno()

    def readable() -> None:
        if not os.read(descriptor, 4096):  # the agent has ended, however it did
            loop.remove_reader(descriptor)
            stop.set()

    loop.add_reader(descriptor, readable)
