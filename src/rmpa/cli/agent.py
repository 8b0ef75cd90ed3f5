"""``rmpa up``: the agent of this machine."""

from __future__ import annotations

import asyncio
import gc
import importlib.util
import logging
import os
import signal
import socket
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rmpa.cli.options import agent_option, config_option, json_option, setting_options
from rmpa.cli.output import Column, print_json, print_line, print_table, printable, warn
from rmpa.cli.peer import connect
from rmpa.config.module_name import (
    GATEWAY_SUFFIX,
    NameSource,
    choose_name,
    json_value,
    keep_name,
    schema_text,
    state_dir,
    toml_value,
)
from rmpa.config.read import load_settings
from rmpa.config.settings import SETTINGS, WebSettings
from rmpa.config.values import HOST, BadValue
from rmpa.core.counters import configure_logging
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.core.identity import peer_name_problem
from rmpa.observe.control import ReloadReply
from rmpa.observe.control_client import ControlClient, find_agents, with_running
from rmpa.runtime.process import LogWriter
from rmpa.trust.joining import TrustStatus

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.config.module_name import ModuleName, NameFacts
    from rmpa.config.read import Loaded
    from rmpa.config.schema import Setting
    from rmpa.config.settings import Settings
    from rmpa.web.server.process import Address, WebSetup


# ``rmpa core``: the ROS core alone, in place of ``roscore``.


def _default_port() -> int:
    """The port of ``ROS_MASTER_URI`` if its host is this machine, as for roscore; else 11311."""
    from rmpa.ros.core.embedded import DEFAULT_PORT
    from rmpa.ros.http.rpc import is_own_name, split_uri

    try:
        host, port, _ = split_uri(os.environ.get("ROS_MASTER_URI", ""))
    except UnreachableError:
        return DEFAULT_PORT
    return port if is_own_name(host) or host.startswith("127.") else DEFAULT_PORT


@click.command()
@click.option(
    "-p",
    "--port",
    type=click.IntRange(0, 65535),
    default=None,
    help="Port to listen at; 0 lets the system choose. [default: the port of ROS_MASTER_URI, or 11311]",
)
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Address to listen at; 0.0.0.0 opens it to the network."
)
@click.option("--advertise", default="", metavar="NAME", help="Host name or address that nodes get, if not --host.")
@click.option(
    "--keep",
    type=click.Choice(["auto", "always", "never"]),
    default="auto",
    show_default=True,
    help="Take up nodes and parameters of the run before: auto, if a node of it still runs or the core died.",
)
@click.option("-v", "--verbose", is_flag=True, help="Log every registration.")
@click.option("--debug", is_flag=True, help="Log every call.")
def core(port: int | None, host: str, advertise: str, keep: str, verbose: bool, debug: bool) -> None:
    """Run a ROS core: master, parameter server and /rosout, as roscore does."""
    from rmpa.runtime.accept import raise_file_limit

    level = logging.DEBUG if debug else logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)-7s %(name)s %(message)s")
    raise_file_limit()
    asyncio.run(_run(host, _default_port() if port is None else port, advertise, keep=keep))


async def _run(host: str, port: int, advertise: str, *, keep: str) -> None:
    from rmpa import __version__
    from rmpa.config.module_name import core_file
    from rmpa.ros.core.embedded import ROS_VERSION, RosCore

    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    core = RosCore(
        host,
        port,
        advertised_host=advertise,
        on_shutdown=lambda _: ended.set(),
        state=core_file(os.environ, port),
        keep=keep,
    )
    await core.start()
    click.echo(f"rmpa core {__version__}, in place of ros_comm {ROS_VERSION.strip()}")
    click.echo(f"ROS_MASTER_URI={core.uri}")
    click.echo(f"setting /run_id to {core.call('getParam', '/rmpa_core', '/run_id').value}")
    click.echo("started core service [/rosout]")
    if core.stored is not None and (text := core.stored.restored()):
        click.echo(text)
    sys.stdout.flush()
    await ended.wait()
    click.echo("shutting down")
    await core.close()


# ``rmpa reload``: let the agent read its settings again.


RELOAD_EPILOG = """\
\b
What takes effect at once: [bridge], [[contract]], [[peer]], [services], [[service]], [params], [[param]], [time]
and log.level. All else needs a restart, and is named. Variables and flags are those that the agent was started with.

\b
Examples:
  rmpa reload --check       would it be taken?
  rmpa reload               let it hold
  kill -HUP PID             the same, answered in the log
"""


@click.command("reload", epilog=RELOAD_EPILOG)
@click.option("--check", is_flag=True, help="Change nothing; only say what would come of it.")
@json_option
@agent_option
def reload(check: bool, as_json: bool, agent: str | None) -> int:
    """Make the agent read its rmpa.toml again; what the changes do not touch is not interrupted.

    Exit code 2 if the settings cannot be used; then nothing has changed.
    """
    with connect(agent) as client:
        reply = client.call("reload", ReloadReply, check=check)
    if as_json:
        print_json(reply)
    elif reply.problem:
        click.echo(f"rmpa: {printable(reply.problem)}", err=True)
    else:
        print_line(_summary(reply, check=check))
        for note in reply.notes:
            warn(note)
        for key in reply.restart:
            warn(f"{key} {'needs' if check else 'waits for'} a restart")
    return 2 if reply.problem else 0


def _summary(reply: ReloadReply, *, check: bool) -> str:
    where = reply.file or "no file"
    if not reply.changed:
        return f"{where}: nothing {'would change' if check else 'has changed'}"
    return f"{where}: {', '.join(reply.changed)} {'would take effect' if check else 'in effect'}"


# ``rmpa config``: the settings that hold and where each comes from; their JSON Schema for editors.


CONFIG_EPILOG = """\
\b
Examples:
  rmpa config show                        what `rmpa up` would take, and from where
  rmpa config show --config new.toml      is this file right?
  rmpa config schema > rmpa.schema.json   for editors: see docs/settings.md
"""


@click.group(epilog=CONFIG_EPILOG)
def config() -> None:
    """Show the settings and where each comes from; print their JSON Schema."""


@config.command()
@click.option("--config", "file", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")
@json_option
def show(file: str | None, as_json: bool) -> None:
    """Print each setting that `rmpa up` would take here, and where it comes from.

    A running agent may have others: options of its command line, or a file that was changed later (see rmpa reload).
    """
    host_name = socket.gethostname()
    loaded = load_settings({"config": file}, dict(os.environ), host_name=host_name)
    rows = []
    for setting in SETTINGS:
        given = loaded.given.get(setting.name)
        origin = str(given) if given else "the host's name" if setting.name == "name" else "default"
        rows.append((setting, setting.value_in(loaded.settings), origin))
    if as_json:
        print_json(
            {
                "file": str(loaded.settings.config_file or ""),
                "settings": [
                    {"name": s.title, "value": json_value(value), "from": origin} for s, value, origin in rows
                ],
                "notes": loaded.notes,
            }
        )
        return
    table = [(setting.title, _shown(setting, value), origin) for setting, value, origin in rows]
    print_table([Column("SETTING"), Column("VALUE"), Column("FROM")], [tuple(map(printable, row)) for row in table])
    for note in loaded.notes:
        warn(printable(note))


def _shown(setting: Setting, value: object) -> str:
    if setting.is_list_of_tables and isinstance(value, tuple):
        return f"{len(value)} table{'' if len(value) == 1 else 's'}" if value else "none"
    return toml_value(value)


@config.command()
def schema() -> None:
    """Print the JSON Schema of rmpa.toml: editors check and complete the file with it."""
    click.echo(schema_text(), nl=False)


# The module that a command beside an agent is about: its name, settings and files, and its agent if that runs.


_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FoundName:
    """The name of a module of this machine.

    Attributes:
        chosen: Its name, and why it was chosen.
        loaded: The settings, with that name.
        socket: The control socket of its agent; ``None``: none runs.
    """

    chosen: ModuleName
    loaded: Loaded
    socket: Path | None


@dataclass(frozen=True, slots=True)
class Module:
    """One module of this machine.

    Attributes:
        chosen: Its name, and why it was chosen.
        loaded: The settings, with that name.
        state: Its state directory; ``None``: there is none.
        socket: The control socket of its agent; ``None``: none runs.
        trust: What its agent says of trust; ``None``: none runs.
        config_file: The settings of its agent; empty: it has none, or none runs.
    """

    chosen: ModuleName
    loaded: Loaded
    state: Path | None
    socket: Path | None = None
    trust: TrustStatus | None = None
    config_file: str = ""

    @property
    def name(self) -> str:
        """Its name."""
        return self.chosen.name

    @property
    def secured(self) -> bool:
        """Whether its agent runs as a member of a secured mesh."""
        return self.trust is not None and self.trust.agent == "secured"


def find_name(
    name: str | None, options: Mapping[str, object], environ: Mapping[str, str], option: str = "--name"
) -> FoundName:
    """The name of the module that a command beside an agent is about.

    Args:
        name: As the command's option names it.
        options: As for ``load_settings``.
        environ: The environment's variables.
        option: The command's option, for errors.

    Raises:
        ConfigError: The name cannot be one, or a setting cannot be used.
        RmpaError: Several agents run, and none is meant.
    """
    for source, text in ((option, name), ("RMPA_AGENT", environ.get("RMPA_AGENT"))):
        if text and (problem := peer_name_problem(text)):
            raise ConfigError(source, problem)
    loaded = load_settings(options, environ, host_name=socket.gethostname())
    agents = find_agents(environ)
    facts = replace(loaded.name_facts, agent_variable=environ.get("RMPA_AGENT", ""))
    if name:
        facts = replace(facts, option=name)
    chosen = choose_name(with_running(facts, agents, environ))
    loaded = replace(loaded, settings=replace(loaded.settings, name=chosen.name))
    return FoundName(chosen, loaded, next((agent.path for agent in agents if agent.name == chosen.name), None))


def find_module(
    name: str | None, options: Mapping[str, object], environ: Mapping[str, str], option: str = "--name"
) -> Module:
    """The module that a command beside an agent is about, as its agent knows it if that runs.

    Args and errors as for ``find_name``; also ``RmpaError``: the agent does not answer.
    """
    found = find_name(name, options, environ, option)
    chosen, loaded, path = found.chosen, found.loaded, found.socket
    if path is None:
        return Module(chosen, loaded, state_dir(environ, loaded.settings.state_dir))
    with ControlClient(path) as client:
        trust, config_file = client.call("trust", TrustStatus, what="status"), client.agent().config_file
    # The agent may have been started with another state directory than this shell has.
    state = Path(trust.folder).parent.parent if trust.folder else None
    return Module(chosen, loaded, state, path, trust, config_file)


def keep_first_name(settings: Settings, facts: NameFacts) -> None:
    """Keep a name that was given by ``--name`` at the first start of a module, for the starts and commands to come.

    One that starts beside another agent is a second module of this machine, and a gateway is none.
    """
    directory = state_dir(os.environ, settings.state_dir)
    name = facts.option
    if not name or directory is None or facts.kept or name.endswith(GATEWAY_SUFFIX):
        return
    try:
        if any(agent.name != name for agent in find_agents(os.environ)):
            return
        keep_name(directory, name)
    except RmpaError as error:
        _log.warning("! the name %s is not kept: %s", name, error)


_up_log = logging.getLogger("rmpa.up")
UP_EPILOG = """\
\b
Settings, each stronger than the last: the ROS environment (ROS_MASTER_URI's port, ROS_DOMAIN_ID,
ROS_STATIC_PEERS, ROS_AUTOMATIC_DISCOVERY_RANGE), rmpa.toml, RMPA_* variables, options.
`rmpa config show` prints those that hold, each with its source.
The name that the first --name gave is kept in the state directory (the file module-name), and holds where no other
one is given.

\b
Examples:
  rmpa up                                 all defaults; the name is that of the first start, else the host's
  rmpa up --name base --interface wlan0   on one interface only
  rmpa up --seed 10.8.0.5:40001           greet an agent that multicast does not reach
  rmpa up --name b2 --core-port 11312     a second agent on this machine
  rmpa up --keep never                    forget what the core kept of the run before
  rmpa up --prefix-peers                  beside robots of the same kind: their names stay apart
  rmpa up --core external                 join the graph of a roscore that runs already
  rmpa up --realtime                      punctual on a busy machine; the log says what was not granted
"""


@click.command(epilog=UP_EPILOG)
@setting_options("up")
@config_option
def up(**options: object) -> int:
    """Run this machine's agent: ROS core, discovery, mesh and bridge."""
    load = partial(load_settings, options, dict(os.environ), host_name=socket.gethostname())
    loaded = load()
    writer = LogWriter(sys.stderr.fileno())
    configure_logging(loaded.settings.log_level, writer, as_json=loaded.settings.log_json)
    for note in loaded.notes:
        _up_log.warning("%s", note)
    chosen = choose_name(loaded.name_facts)
    if chosen.source is NameSource.KEPT:
        _up_log.info("= the module is %s, as at its first start (%s)", chosen.name, loaded.given["name"])
    # Imports leave no garbage: without collection the start takes a third less time. The agent turns it on again.
    gc.disable()
    from rmpa.agent.agent import run

    try:
        return run(loaded.settings, load, partial(keep_first_name, loaded.settings, loaded.name_facts))
    finally:
        writer.close()


# ``rmpa web``: this module's state for browsers and programs, over HTTP.


_web_log = logging.getLogger("rmpa.web")
_LIBRARIES = ("aiohttp", "cbor2", "prometheus_client")
_DEFAULTS = WebSettings()
WEB_EPILOG = """\
\b
[web] of rmpa.toml and the variables RMPA_WEB_* give the same; options are stronger.
It is as secure as the agent: beside one in a secured mesh it serves HTTPS with the certificate of that module, by its
[[permission]], and begins anew where the agent comes back secured.

\b
Examples:
  rmpa web                        for this machine: http://127.0.0.1:8480/, https:// in a secured mesh
  rmpa web --listen 0.0.0.0       for the network; prints the URL with its token once
  rmpa up --web                   the agent starts it, and again if it ends
  curl -s localhost:8480/api/v1/peers | jq '.[].name'
"""


@click.command(epilog=WEB_EPILOG)
@click.option("--port", type=click.IntRange(1, 65535), help=f"Port to listen at. [default: {_DEFAULTS.port}]")
@click.option(
    "--listen",
    metavar="ADDRESS",
    help=f"Address to listen at; beyond this machine a token is needed. [default: {_DEFAULTS.listen}]",
)
@click.option(
    "--token-file",
    metavar="FILE",
    help="Ask clients for the token of this file; made if it is not there. [default: in the state directory]",
)
@click.option(
    "--host", "hosts", metavar="NAME", multiple=True, help="A further name of this server in URLs; repeatable."
)
@click.option(
    "--control",
    is_flag=True,
    help="Let clients publish, call and offer services, and set parameters; they then need the token.",
)
@click.option(
    "--cert",
    metavar="FILE",
    help="HTTPS with this certificate (PEM). [default: the module's, if secured]",
)
@click.option("--key", metavar="FILE", help="Its private key (PEM). [default: in the certificate's file]")
@click.option("--drive", is_flag=True, help="Let the joystick of its pages command a robot; they need the token.")
@click.option("--config", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")
@click.option("--with-agent", is_flag=True, hidden=True, help="End when standard input ends.")
@click.option("--insecure", is_flag=True, help="Start without an agent although other modules here have keys.")
@agent_option
@json_option
def web(
    port: int | None,
    listen: str | None,
    token_file: str | None,
    hosts: tuple[str, ...],
    control: bool,
    cert: str | None,
    key: str | None,
    drive: bool,
    config: str | None,
    with_agent: bool,
    insecure: bool,
    agent: str | None,
    as_json: bool,
) -> int:
    """Show the mesh in a browser; serve rosbridge and Foxglove clients, /metrics for Prometheus, /api/v1 as JSON.

    It is a process of its own: the agent does not depend on it. It starts without an agent too, and finds it later.
    """
    _check_libraries()

    def with_options(given: WebSettings) -> WebSettings:
        return replace(
            given,
            port=given.port if port is None else port,
            listen=given.listen if listen is None else _host("--listen", listen),
            token_file=given.token_file if token_file is None else token_file,
            control=given.control or control,
            cert=given.cert if cert is None else cert,
            key=given.key if key is None else key,
            drive=given.drive or drive,
            hosts=(*given.hosts, *(_host("--host", name) for name in hosts)),
        )

    def make() -> tuple[Module, WebSetup]:
        module = find_module(agent, {"config": config}, os.environ, "--agent")
        settings = module.loaded.settings
        settings = replace(settings, web=with_options(settings.web))
        if insecure:
            settings = replace(settings, trust=replace(settings.trust, insecure=True))
        return module, _setup(module, settings)

    module, setup = make()
    log = setup.settings
    configure_logging(log.log_level, sys.stderr, as_json=log.log_json)
    for note in module.loaded.notes:
        _web_log.warning("%s", note)
    from rmpa.web.server.process import serve

    def announce(address: Address) -> None:
        _announce(address, as_json=as_json)

    def load() -> WebSetup:
        return make()[1]

    while True:
        pinned = module.name if module.chosen.source.said else None
        if not asyncio.run(serve(setup, pinned, announce, with_agent=with_agent, load=load)):
            return 0
        module, setup = make()


def _setup(module: Module, settings: Settings) -> WebSetup:
    """What the server of a module is made of; it is as secure as the module's agent.

    Raises:
        RmpaError: A file cannot be used; or no agent runs, the module has no keys, and others have some.
    """
    from rmpa.trust.store import TrustStore, check_open
    from rmpa.web.server.process import WebSetup, access_of, certificate_files

    store = TrustStore(module.state, module.name) if module.state is not None else None
    trusted = module.secured or (store is not None and store.exists)
    if not trusted and module.socket is None:
        check_open(settings.trust, module.state, module.name, os.environ, "--agent")
    own_file = str(settings.config_file.absolute()) if settings.config_file is not None else ""
    if trusted and module.config_file not in ("", own_file):  # the permissions are those that its agent reads
        theirs = load_settings({"config": module.config_file}, os.environ, host_name=socket.gethostname())
        settings = replace(settings, trust=theirs.settings.trust)
    files = certificate_files(settings.web.cert, settings.web.key, store if trusted else None)
    access = access_of(settings.web, module.name, os.environ, settings.state_dir)
    folder = str(store.folder) if store is not None else ""
    return WebSetup(settings, access, files, trusted, module.name, folder)


def _check_libraries() -> None:
    missing = [name for name in _LIBRARIES if not _is_there(name)]
    if missing:
        raise ConfigError("rmpa web", f"{' and '.join(missing)} not installed", "run pip install 'rmpa[web]'")


def _is_there(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # it was taken out of sys.modules
        return False


def _host(option: str, text: str) -> str:
    try:
        return HOST.read(text)
    except BadValue as error:
        raise ConfigError(option, error.problem, error.remedy) from None


def _announce(address: Address, *, as_json: bool) -> None:
    if as_json:
        from rmpa.cli.output import print_json

        print_json({"url": address.url, "token_file": address.token_file})
    else:
        click.echo(address.url)
        if address.is_new:
            click.echo(f"the token is kept in {address.token_file}; it is not printed again")
        elif address.token_file:
            click.echo(f"clients need the token of {address.token_file}")
    sys.stdout.flush()
