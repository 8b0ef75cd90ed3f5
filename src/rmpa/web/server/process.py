"""The process ``rmpa web``: makes the server of the settings, says where it is, and runs it until a signal."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rmpa.config.module_name import module_dir, state_dir
from rmpa.config.peer_rules import Effect
from rmpa.core.errors import RmpaError, StartError
from rmpa.trust.certificates import server_names
from rmpa.trust.documents import Permissions
from rmpa.web.gateways.gateways import Gateways
from rmpa.web.hub.rights import EVERYTHING, READ_ONLY, NodeRules, Rights
from rmpa.web.monitor.io.monitor import Monitor
from rmpa.web.server import auth
from rmpa.web.server.agent_watch import AgentWatch, ControlReader
from rmpa.web.server.graph_signal import GraphSignal
from rmpa.web.server.hub_setup import make_hub, priority_of
from rmpa.web.server.server import WebServer
from rmpa.web.server.tls import CertificateFiles, ServerCertificate
from rmpa.web.server.token_file import token_from
from rmpa.web.server.trust_watch import TrustWatch

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.config.settings import Settings, WebSettings
    from rmpa.trust.joining import TrustStatus

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

    token: str = field(default="", repr=False)
    file: Path | None = None
    is_new: bool = False


@dataclass(frozen=True, slots=True)
class WebSetup:
    """What a server is made of.

    Args:
        settings: All settings, with those of the command line.
        access: The token.
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
        return auth.AccessPolicy(web.port, hosts, self.access.token, origins)

    @property
    def rights(self) -> Rights:
        """What clients may do: without a token they do not read parameters and files either."""
        web = self.settings.web
        if not self.access.token:
            return READ_ONLY
        return Rights(view=True, control=web.control, drive=web.drive, command_age=web.command_age_ms / 1000)

    @property
    def rules(self) -> NodeRules:
        """What the server's node may do: in a secured mesh nothing that a ``[[permission]]`` denies."""
        if not self.trusted:
            return EVERYTHING
        return NodeRules(Permissions(replace(self.settings.trust, default=Effect.ALLOW.value)))

    def serves_as(self, other: WebSetup) -> bool:
        """Whether a server made of the other one would let clients do the same under the same token."""
        mine, theirs = self.settings, other.settings
        return (mine.web, mine.trust, self.trusted, self.access.token) == (
            theirs.web,
            theirs.trust,
            other.trusted,
            other.access.token,
        )


def access_of(web: WebSettings, module: str, environ: Mapping[str, str], state: str = "") -> TokenAccess:
    """The token that the settings ask for: beyond loopback, for control or driving, or where a file is given.

    Args:
        web: The settings.
        module: The module's name; the token is in its folder of the state directory.
        environ: As for ``state_dir``.
        state: ``Settings.state_dir``.

    Raises:
        StartError: The file cannot be used, or there is no place for one.
    """
    if auth.is_loopback(web.listen) and not (web.token_file or web.control or web.drive):
        return TokenAccess()
    place = state_dir(environ, state or None)
    folder = module_dir(place, module) if place is not None else None
    if not web.token_file and folder is None:
        raise StartError("rmpa web", "there is no state directory for the token", "choose a --token-file")
    file = Path(web.token_file) if web.token_file or folder is None else folder / "web-token"
    token, is_new = token_from(file)
    return TokenAccess(token, file, is_new)


def address_of(web: WebSettings, access: TokenAccess, port: int, *, is_https: bool = False) -> Address:
    """Where a server is, for the user."""
    host = socket.gethostname() if web.listen == "0.0.0.0" else web.listen  # noqa: S104 - compared
    query = f"?{auth.TOKEN_PARAMETER}={access.token}" if access.is_new else ""
    scheme = "https" if is_https else "http"
    return Address(f"{scheme}://{host}:{port}/{query}", str(access.file or ""), access.is_new)


async def serve(
    setup: WebSetup,
    agent: str | None,
    announce: Callable[[Address], None],
    *,
    with_agent: bool,
    load: Callable[[], WebSetup],
) -> bool:
    """Serve until SIGINT or SIGTERM; at SIGHUP the settings are read again.

    Returns:
        Whether another setup is to be served: the settings have changed, or the agent is secured in another way.

    Args:
        setup: The settings, token and certificate.
        agent: The agent's name; ``None``: the one that runs.
        announce: Called when the server listens.
        with_agent: Whether to end when standard input ends: it is a pipe that the agent holds open.
        load: Reads all of ``setup`` again; it may block, and raise ``RmpaError``.

    Raises:
        StartError: The address or the certificate cannot be used.
    """
    stop, reload = asyncio.Event(), asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGHUP, reload.set)
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    web = setup.settings.web
    trust = TrustWatch(os.environ, agent, setup.fits)
    reader = ControlReader(os.environ, agent, trust.check)
    watch = AgentWatch(reader, read_whole=reader.read_whole)
    hub = make_hub(watch, web.port, setup.rules)

    monitor = Monitor(hub, watch, agent=agent)
    changes = GraphSignal(os.environ, lambda: agent or monitor.mesh.agent or None, hub.graph)
    gateways = Gateways(
        hub,
        f"RMPA {setup.module or socket.gethostname()}",
        setup.rights,
        priority_of(hub, setup.settings.make_contracts()),
        monitor,
    )
    certificate = ServerCertificate(setup.files)
    server = WebServer(watch, setup.policy, web.listen, gateways, web.ports, certificate.context)
    try:
        async with hub:
            await server.start()
            certificate.start()
            monitor.start()
            changes.start()
            trust.start()
            if with_agent:
                _stop_at_end_of_input(loop, stop)
            announce(address_of(web, setup.access, server.port, is_https=certificate.context is not None))
            await _first_of(stop.wait(), trust.misfit.wait(), _changed(setup, load, reload))
            _log.info("= ending" if stop.is_set() else "= beginning anew with other settings")
            await gateways.close()
            await changes.close()
            await monitor.close()
    finally:
        await trust.close()
        await certificate.close()
        await server.close()
        reader.close()
    return not stop.is_set()


async def _first_of(*awaited: Awaitable[object]) -> None:
    """Wait for one of several; the others are cancelled."""
    waits = [asyncio.ensure_future(each) for each in awaited]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
        await asyncio.wait(waits)


async def _changed(setup: WebSetup, load: Callable[[], WebSetup], asked: asyncio.Event) -> None:
    """Wait until the settings, read again whenever it is ``asked``, have the server serve in another way."""
    while True:
        await asked.wait()
        asked.clear()
        try:
            new = await asyncio.to_thread(load)
        except RmpaError as error:
            _log.error("! rmpa web keeps its settings: %s", error)
            continue
        if setup.trusted and not new.trusted:  # the agent is away, and another module was found meanwhile
            _log.error("! rmpa web keeps its settings: the module with keys is not found now")
        elif not setup.serves_as(new):
            return


def _stop_at_end_of_input(loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
    descriptor = sys.stdin.fileno()

    def readable() -> None:
        if not os.read(descriptor, 4096):  # the agent has ended, however it did
            loop.remove_reader(descriptor)
            stop.set()

    loop.add_reader(descriptor, readable)
