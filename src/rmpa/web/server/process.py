"""The process ``rmpa web``: its start, its certificate, and the hub, whose node joins the core of the agent."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import ssl
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rmpa.config.module_name import module_dir, state_dir
from rmpa.core.errors import ConfigError, RmpaError, StartError, UnreachableError
from rmpa.discovery.network import choose, list_interfaces, pick_address
from rmpa.ros.node.node import Node
from rmpa.runtime.plugins import WEB_PROTOCOLS, load_plugins, plugin_error
from rmpa.runtime.systemd import feed_watchdog, notify_service_manager
from rmpa.runtime.tasks import end_tasks, keep_task, start_task
from rmpa.trust.permissions import Permissions, TrustStatus, server_names
from rmpa.trust.store import CERTIFICATE, KEY, TrustStore
from rmpa.web import limits
from rmpa.web.clients import WebSocketClients
from rmpa.web.hub.connection import Session
from rmpa.web.hub.hub import Hub
from rmpa.web.hub.node_link import EVERYTHING, READ_ONLY, NodeRules, Rights
from rmpa.web.monitor.monitor import Monitor
from rmpa.web.server.access import TOKEN_PARAMETER, AccessPolicy, is_loopback, own_names, token_from
from rmpa.web.server.agent_watch import AgentFollower, AgentWatch, ControlReader
from rmpa.web.server.app import WebServer
from rmpa.web.server.recordings import RecordingFiles
from rmpa.web.server.video import VideoStreams

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping

    from rmpa.config.settings import Settings, WebSettings
    from rmpa.core.contract import Contracts
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_log = logging.getLogger(__name__)
_DEFAULT_PORT: Final = 8480


def make_hub(watch: AgentWatch, port: int, rules: NodeRules = EVERYTHING, contracts: Contracts | None = None) -> Hub:
    """A hub whose master is the agent's.

    Args:
        watch: Gives the agent's snapshot.
        port: The server's; each server of one core has a node of its own.
        rules: What the node may do.
        contracts: Of topics.
    """
    name = "rmpa_web" if port == _DEFAULT_PORT else f"rmpa_web_{port}"

    async def where() -> str:
        reading = await watch.reading()
        if reading.snapshot is None:
            raise UnreachableError("agent", "its control socket", reading.problem)
        return reading.snapshot.agent.core_uri

    def make_node(uri: str, updated: Callable[[str, XmlRpcValue], None]) -> Node:
        return Node(name, master_uri=uri, on_param_update=updated)

    return Hub(where, make_node, rules=rules, contracts=contracts)


class CertificateFiles(NamedTuple):
    """Where a server's certificate is.

    Attributes:
        cert: A PEM file: the certificate, and the intermediate ones behind it; empty for none: plain HTTP.
        key: A PEM file with the private key, not encrypted; empty: it is in ``cert``.
    """

    cert: str = ""
    key: str = ""


def certificate_files(cert: str, key: str, store: TrustStore | None) -> CertificateFiles:
    """The files of a server: those of the user, else the module's own if it is in a secured mesh, else none.

    Args:
        cert: As ``[web]`` names it.
        key: Likewise.
        store: The module's files of trust; ``None``: it is in no secured mesh.

    Raises:
        ConfigError: There is a key without a certificate.
        StartError: The module is in a secured mesh, and its files cannot be used: they are missing, broken, or of
            another user.
    """
    if cert:
        return CertificateFiles(cert, key)
    if key:
        raise ConfigError("web.key", "there is a key without a certificate", "name the certificate with --cert")
    if store is None:
        return CertificateFiles()
    try:
        store.load()
    except StartError as error:
        _log.warning(
            "! rmpa web serves HTTPS in a secured mesh: run it as the agent's user, or name a --cert [keys-unusable]"
        )
        raise error from None
    return CertificateFiles(str(store.path(CERTIFICATE)), str(store.path(KEY)))


def tls_context(files: CertificateFiles) -> ssl.SSLContext | None:
    """The context of a server; ``None`` without a certificate.

    Raises:
        StartError: The files cannot be read, or do not belong together.
    """
    if not files.cert:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(files.cert, files.key or None, password=_no_password)
    except FileNotFoundError as error:
        what, remedy = error.filename or files.cert, "see cert and key of [web]"
        raise StartError(what, "there is no such file", remedy, code="web-certificate") from None
    except (OSError, ValueError) as error:  # an SSLError is an OSError
        text = getattr(error, "reason", None) or getattr(error, "strerror", None) or str(error)
        remedy = "the certificate and its unencrypted private key are wanted, as PEM"
        raise StartError(files.cert, f"cannot be used with its key: {text}", remedy, code="web-certificate") from None
    return context


class ServerCertificate:
    """The context of a server, into which a renewed certificate is loaded as soon as its files have changed.

    New connections get the new certificate; those that are open keep theirs. Files that do not belong together (one
    is written already, the other is not) are tried again.

    Args:
        files: The files; with none the server speaks HTTP, and nothing is watched.

    Raises:
        StartError: They cannot be used.
    """

    def __init__(self, files: CertificateFiles) -> None:
        self._files = files
        self._stamps = self._look()
        self.context = tls_context(files)
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to look at the files, in a task."""
        if self.context is not None:
            self._task = keep_task(self._watch, "watch the certificate")

    async def close(self) -> None:
        """End."""
        await end_tasks(self._task)

    def renew(self) -> bool:
        """Load the files if they have changed; return whether new connections get another certificate. It blocks."""
        stamps = self._look()
        if stamps == self._stamps or self.context is None:
            return False
        try:
            tls_context(self._files)  # a context that fails half-way has the new one in part
            self.context.load_cert_chain(self._files.cert, self._files.key or None, password=_no_password)
        except (StartError, OSError, ValueError) as error:
            _log.warning("! the changed certificate is not used yet: %s [web-certificate]", error)
            return False
        self._stamps = stamps
        _log.info("= HTTPS has the renewed certificate of %s", self._files.cert)
        return True

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(limits.CERTIFICATE_LOOK_PERIOD)
            await asyncio.to_thread(self.renew)

    def _look(self) -> list[tuple[int, int] | None]:
        """What changes when the files do."""
        stamps: list[tuple[int, int] | None] = []
        for name in filter(None, self._files):
            try:
                info = Path(name).stat()
            except OSError:
                stamps.append(None)
            else:
                stamps.append((info.st_ino, info.st_mtime_ns))
        return stamps


def _no_password() -> str:
    """OpenSSL would ask for one at the terminal."""
    raise ValueError("the key is encrypted")


@dataclass(frozen=True, slots=True)
class TokenAccess:
    """The token of a server, where it is, and whether it was made now."""

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
    def policy(self) -> AccessPolicy:
        """Which requests are served."""
        web = self.settings.web
        hosts = own_names((socket.gethostname(), *web.hosts)) | {web.listen.lower()}
        if self.trusted:
            hosts |= frozenset(server_names(self.module))
        origins = frozenset(origin.lower().rstrip("/") for origin in web.origins)
        return AccessPolicy(web.port, hosts, self.access.token, origins)

    @property
    def rights(self) -> Rights:
        """What clients may do: without a token they do not read parameters and files either."""
        web = self.settings.web
        if not self.access.token:
            return READ_ONLY
        return Rights(view=True, control=web.control, drive=web.drive, command_age=web.command_age_ms / 1000)

    @property
    def rules(self) -> NodeRules:
        """What the server's node may do: in a secured mesh what ``[trust]`` lets the module ``web`` do."""
        return NodeRules(Permissions(self.settings.trust)) if self.trusted else EVERYTHING

    def serves_as(self, other: WebSetup) -> bool:
        """Whether a server made of the other one would let clients do the same under the same token."""
        mine, theirs = self.settings, other.settings
        same = (mine.web, mine.trust, mine.resources) == (theirs.web, theirs.trust, theirs.resources)
        return same and (self.trusted, self.access.token) == (other.trusted, other.access.token)


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
    if is_loopback(web.listen) and not (web.token_file or web.control or web.drive):
        return TokenAccess()
    place = state_dir(environ, state or None)
    folder = module_dir(place, module) if place is not None else None
    if not web.token_file and folder is None:
        problem = "there is no state directory for the token"
        raise StartError("rmpa web", problem, "choose a --token-file", code="no-state-directory")
    file = Path(web.token_file) if web.token_file or folder is None else folder / "web-token"
    token, is_new = token_from(file)
    return TokenAccess(token, file, is_new)


def url_of(
    web: WebSettings, access: TokenAccess, port: int, *, is_https: bool = False, interfaces: tuple[str, ...] = ()
) -> str:
    """The URL of a server's first page, as another computer can open it; with the token if that was made now.

    Where the server listens at all addresses: the name that ``--host`` gives, else the address at which other modules
    find this one. The name of this machine is often known to itself alone.

    Args:
        web: The settings.
        access: The token.
        port: Where it listens.
        is_https: Whether it has a certificate.
        interfaces: The names of those that ``[discovery]`` allows; none: all.
    """
    host = web.listen
    if host == "0.0.0.0":  # noqa: S104 - compared
        host = next(iter(web.hosts), "") or str(pick_address(choose(list_interfaces(), interfaces)))
    query = f"?{TOKEN_PARAMETER}={access.token}" if access.is_new else ""
    return f"{'https' if is_https else 'http'}://{host}:{port}/{query}"


async def serve(
    setup: WebSetup,
    agent: str | None,
    announce: Callable[[str, TokenAccess], None],
    load: Callable[[], WebSetup],
) -> bool:
    """Serve until SIGINT or SIGTERM; at SIGHUP the settings are read again.

    Returns:
        Whether another setup is to be served: the settings have changed, or the agent is secured in another way.

    Args:
        setup: The settings, token and certificate.
        agent: The agent's name; ``None``: the one that runs.
        announce: Called with the URL and the token when the server listens.
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
    follower = AgentFollower(os.environ, agent, setup.fits)
    reader = ControlReader(os.environ, agent, follower.check)
    watch = AgentWatch(reader, read_whole=reader.read_whole)
    hub = make_hub(watch, web.port, setup.rules, setup.settings.make_contracts())
    monitor = Monitor(hub, watch, agent=agent, folder=setup.settings.resources.folder)
    name = f"RMPA {setup.module or socket.gethostname()}"
    sockets = WebSocketClients(hub, name, setup.rights, monitor, other_protocols())
    certificate = ServerCertificate(setup.files)
    video = VideoStreams(hub)
    place = state_dir(os.environ, setup.settings.state_dir or None)
    files = module_dir(place, setup.module) / f"web-{web.port}" if place is not None else None
    recordings = RecordingFiles(setup.rules, files, lambda: monitor.agent, view=setup.rights.view)
    server = WebServer(watch, setup.policy, web.listen, sockets, web.ports, certificate.context, video, recordings)
    try:
        async with hub:
            await server.start()
            await recordings.clear()
            certificate.start()
            monitor.start()
            follower.start(hub.graph)
            is_https, interfaces = certificate.context is not None, setup.settings.interfaces
            url = url_of(web, setup.access, server.port, is_https=is_https, interfaces=interfaces)
            announce(url, setup.access)
            notify_service_manager("READY=1")
            feed_watchdog(loop)
            await _first_of(stop.wait(), follower.misfit.wait(), _changed(setup, load, reload))
            _log.info("= ending" if stop.is_set() else "= starting again with other settings")
            await sockets.close()
            await follower.close()
            await monitor.close()
    finally:
        await follower.close()
        await certificate.close()
        await server.close()
        reader.close()
    return not stop.is_set()


def other_protocols() -> list[type[Session]]:
    """The protocols of other packages."""
    found = []
    for entry, kind in load_plugins(WEB_PROTOCOLS):
        if isinstance(kind, type) and issubclass(kind, Session):
            found.append(kind)
        else:
            _log.warning("! %s [plugin-broken]", plugin_error(entry, TypeError(f"{entry.value} is no Session")))
    return found


async def _first_of(*awaited: Coroutine[Any, Any, object]) -> None:
    """Wait for one of several; the others are cancelled."""
    waits = [start_task(each, "what ends the web server") for each in awaited]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        await end_tasks(*waits)


async def _changed(setup: WebSetup, load: Callable[[], WebSetup], asked: asyncio.Event) -> None:
    """Wait until the settings, read again whenever it is ``asked``, have the server serve in another way."""
    while True:
        await asked.wait()
        asked.clear()
        try:
            new = await asyncio.to_thread(load)
        except RmpaError as error:
            _log.error("! rmpa web keeps its settings: %s [%s]", error, error.code)
            continue
        if setup.trusted and not new.trusted:  # the agent is away, and another module was found meanwhile
            _log.error("! rmpa web keeps its settings: the module with keys is not found now [keys-unusable]")
        elif not setup.serves_as(new):
            return
