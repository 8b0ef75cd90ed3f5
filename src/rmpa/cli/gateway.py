"""Programs beside the agent: ``rmpa gateway`` (with ``zenoh-config``), ``rmpa web`` and ``rmpa core``."""

from __future__ import annotations

import asyncio
import gc
import importlib.util
import logging
import os
import signal
import socket
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.main import LazyGroup
from rmpa.cli.options import Options, agent_verb, config_option, flag, setting_options, verb
from rmpa.cli.output import print_text, warn
from rmpa.cli.trust import agent_settings, find_module
from rmpa.config.module_name import GATEWAY_SUFFIX
from rmpa.config.read import INSECURE, load_settings
from rmpa.config.settings import WebSettings
from rmpa.config.values import HOST, BadValue
from rmpa.core.errors import ConfigError, StartError, UnreachableError, missing_extra
from rmpa.core.identity import peer_name_from
from rmpa.core.log import configure_logging
from rmpa.observe.control_client import ControlClient, find_agents
from rmpa.runtime.log_writer import LogWriter
from rmpa.runtime.systemd import in_journal
from rmpa.trust.permissions import Permissions, TrustStatus

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.cli.trust import Module
    from rmpa.config.read import Given, Loaded
    from rmpa.config.settings import Settings
    from rmpa.web.server.process import TokenAccess, WebSetup

_log = logging.getLogger("rmpa.gateway")
_web_log = logging.getLogger("rmpa.web")
# Settings whose options a gateway has not: its core is its own, and only for its proxies; it has an --insecure.
_OF_THE_AGENT: Final = ("core_mode", "core_master", "core_keep", "web.enabled", "trust.insecure")
# Settings of a gateway that a router has no use for.
_OF_THE_PROCESS: Final = (
    *("gateway.rank", "gateway.router", "gateway.site"),
    *("gateway.ros2.distribution", "gateway.ros2.mapping"),
)
_DEFAULTS: Final = WebSettings()


@click.group(cls=LazyGroup, path="gateway", invoke_without_command=True)
@setting_options(
    "gateway",
    "up",
    without=_OF_THE_AGENT,
    defaults={"name": "the module's name, then _gateway", "core_port": "any free one"},
)
@config_option
@click.pass_context
def gateway(context: click.Context, /, **options: object) -> int:
    """Join this network's modules with other sites over Zenoh, and with ROS 2.

    Topics, services, actions and parameters cross once a node at the other side asks for them.

    ---
    The gateway is a peer of the mesh with a core of its own, beside this machine's agent. It reads the same rmpa.toml
    and RMPA_* variables, but its name, its core's address and the mesh's port only from its own options.
    What may cross: [[gateway.rule]] (docs/guides/sites.md), mapping files of ROS 2 (docs/guides/ros2.md).

    Exit codes: 0 it was ended; 1 it cannot start; 2 a wrong option or setting, or a library that is not installed.

    Examples:
      rmpa gateway --site warehouse --connect tls/fleet.example:7447     one site of a fleet
      rmpa gateway --router --listen tls/0.0.0.0:7447                    the router that the sites connect to
      rmpa gateway --site b --rank 200 --connect tls/fleet.example:7447  standby for the one with rank 100
      rmpa gateway --ros2                                                ROS 2 with any RMW, once it is sourced
      rmpa gateway --ros2 --connect tcp/localhost:7447                   ROS 2 nodes beside rmw_zenohd
      rmpa gateway zenoh-config --listen tls/0.0.0.0:7447 > zenohd.json5  a router with zenohd instead
    """
    if context.invoked_subcommand is not None:
        given = [name for name, value in options.items() if value not in (None, ())]
        if given:
            option = f"--{given[0].replace('_', '-')}"
            raise ConfigError(option, f"must come after {context.invoked_subcommand}", "write it after that")
        return 0
    beside = ""
    if not options["name"]:
        beside = find_module(None, {"config": options.get("config")}, _own(os.environ)).name

    def load() -> Loaded:
        loaded = load_gateway(options, dict(os.environ), socket.gethostname(), beside)
        _check_settings(loaded.settings)
        return loaded

    loaded = load()
    _check_gateway_libraries(loaded.settings)
    _check_agents(loaded.settings)
    writer = LogWriter(sys.stderr.fileno())
    journal = in_journal(os.environ, sys.stderr.fileno())
    configure_logging(loaded.settings.log_level, writer, as_json=loaded.settings.log_json, in_journal=journal)
    for note in loaded.notes:
        _log.warning("! %s [doubtful-setting]", note)
    gc.disable()  # as in rmpa up: the start takes a third less time; the agent turns it on again
    from rmpa.gateway.gateway import run

    try:
        return run(loaded.settings, load, lambda: _check_agents(loaded.settings))
    finally:
        writer.close()


def load_gateway(
    options: Mapping[str, object], environ: Mapping[str, str], host_name: str, beside: str = ""
) -> Loaded:
    """The settings of a gateway: those of this machine's agent, without what belongs to that process alone.

    Args:
        options: As for ``load_settings``.
        environ: The environment's variables; ROS_MASTER_URI means the agent's core, and is left out.
        host_name: This machine's.
        beside: The module that it stands beside; empty: as ``load_settings`` has it.

    Raises:
        ConfigError: As ``load_settings``.
    """
    loaded = load_settings(options, _own(environ), host_name=host_name)
    settings, given = loaded.settings, loaded.given
    defaults = type(settings)()
    module = beside or settings.name
    # Where a gateway has a state directory of its own, its name may be kept there.
    name = module if module.endswith(GATEWAY_SUFFIX) else peer_name_from(module + GATEWAY_SUFFIX)
    settings = replace(
        settings,
        name=settings.name if _is_option(given, "name") else name,
        core_mode=defaults.core_mode,
        core_master=defaults.core_master,
        core_keep="never",
        core_host=settings.core_host if _is_option(given, "core_host") else defaults.core_host,
        core_port=settings.core_port if _is_option(given, "core_port") else 0,
        port=settings.port if _is_option(given, "port") else 0,
        web=WebSettings(),
        relay=True,
    )
    return replace(loaded, settings=settings)


def _own(environ: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in environ.items() if name != "ROS_MASTER_URI"}


def _is_option(given: Mapping[str, Given], name: str) -> bool:
    return name in given and given[name].source.startswith("--")


def _check_agents(settings: Settings) -> None:
    """Check that a gateway is no less secure than the agents of this machine.

    Raises:
        StartError: One is a member of a secured mesh, the gateway is not, and ``trust.insecure`` is not set.
        RmpaError: One does not answer whether it is.
    """
    from rmpa.agent.trust import trust_store

    store = trust_store(settings)
    if settings.trust.insecure or (store is not None and store.exists):
        return
    for agent in find_agents(os.environ):
        with ControlClient(agent.path) as client:
            secured = client.call("trust", TrustStatus, what="status").agent == "secured"
        if secured:
            problem = f"has no keys, beside the agent {agent.name} in a secured mesh"
            remedy = f"let it join: rmpa trust join TOKEN --name {settings.name}; or say --insecure"
            raise StartError(f"the gateway {settings.name}", problem, remedy)


def _check_settings(settings: Settings) -> None:
    """Check that there is something to join, and a way to it.

    Raises:
        ConfigError: There is not.
    """
    it = settings.gateway
    if not (it.site or it.ros2.enabled or it.router):
        raise ConfigError("rmpa gateway", "there is nothing to join", "say --site NAME for other sites, or --ros2")
    if it.router and not it.listen:
        raise ConfigError("gateway.router", "a router that listens nowhere", "add --listen tls/0.0.0.0:7447")
    if not (it.connect or it.listen) and (it.site or it.router or not it.via_rclpy):
        example = "tcp/localhost:7447 for rmw_zenohd here" if it.ros2.enabled else "tls/fleet.example:7447"
        raise ConfigError(
            "rmpa gateway", "there is no connection to other sites", f"add --connect, such as {example}"
        )


def check_gateway(settings: Settings) -> None:
    """Check that a gateway with these settings has its libraries, something to join, and a way to it.

    Raises:
        ConfigError: It has not.
    """
    _check_gateway_libraries(settings)
    _check_settings(settings)


def _check_gateway_libraries(settings: Settings) -> None:
    it = settings.gateway
    zenoh = {"zenoh": "eclipse-zenoh"} if it.site or it.router or not it.via_rclpy else {}
    _check_libraries("rmpa gateway", "zenoh", {**zenoh, "xxhash": "xxhash"})


def check_web() -> None:
    """Check that ``rmpa web`` has its libraries.

    Raises:
        ConfigError: It has not.
    """
    _check_libraries("rmpa web", "web", {name: name for name in ("aiohttp", "cbor2")})


def _check_libraries(program: str, extra: str, libraries: Mapping[str, str]) -> None:
    """Check that the libraries of an extra are there.

    Args:
        program: The command.
        extra: The extra of rmpa that has them.
        libraries: The name in Python, and that of the package.

    Raises:
        ConfigError: One is missing.
    """
    missing = [package for name, package in libraries.items() if not _is_there(name)]
    if missing:
        raise ConfigError(
            program, f"{' and '.join(missing)} not installed", f"run {missing_extra(extra)}", code="extra-missing"
        )


def _is_there(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # it was taken out of sys.modules
        return False


@agent_verb(
    click.option("--port", type=click.IntRange(1, 65535), help=f"Port to listen at. [default: {_DEFAULTS.port}]"),
    click.option(
        "--listen",
        metavar="ADDRESS",
        help=f"Address to listen at; beyond this machine a token is needed. [default: {_DEFAULTS.listen}]",
    ),
    click.option(
        "--token-file",
        metavar="FILE",
        help="Ask clients for the token of this file; made if it is missing. [default: in the state directory]",
    ),
    click.option(
        "--host", "hosts", metavar="NAME", multiple=True, help="A further name of this server in URLs; repeatable."
    ),
    flag(
        "--control",
        help="Let clients publish, call and offer services, and set parameters; they then need the token.",
    ),
    click.option(
        "--cert", metavar="FILE", help="HTTPS with this certificate (PEM). [default: the module's, if secured]"
    ),
    click.option("--key", metavar="FILE", help="Its private key (PEM). [default: in the certificate's file]"),
    flag("--drive", help="Let the joystick of its pages command a robot; they need the token."),
    config_option,
    flag("--insecure", help="Start without an agent although other modules here have keys."),
    flag("--check", help="Only check that it could start with these settings."),
)
def web(config: str | None, insecure: bool, check: bool, options: Options, **given: Any) -> int:
    """Show the mesh in a browser; serve rosbridge and Foxglove clients, /metrics for Prometheus, /api/v1 as JSON.

    It is a process of its own: the agent does not depend on it. It starts without an agent too, and finds it later.

    ---
    [web] of rmpa.toml and the variables RMPA_WEB_* set the same; options override them.
    It is as secure as the agent: if the module is in a secured mesh, it serves HTTPS with the module's certificate
    and by its [[permission]] rules. If the agent restarts as a member, it starts again too.

    Examples:
      rmpa web                        for this machine: http://127.0.0.1:8480/, https:// in a secured mesh
      rmpa web --listen 0.0.0.0       for the network; prints the URL with its token once
      rmpa up --web                   the agent starts it, and again if it ends
      curl -s localhost:8480/api/v1/peers | jq '.[].name'
    """
    check_web()

    def make() -> tuple[Module, WebSetup]:
        module = find_module(options.agent, {"config": config}, os.environ, "--agent")
        settings = module.loaded.settings
        said = {name: value for name, value in given.items() if value not in (None, False, ())}
        if "listen" in said:
            said["listen"] = _host("--listen", said["listen"])
        said["hosts"] = (*settings.web.hosts, *(_host("--host", name) for name in given["hosts"]))
        settings = replace(settings, web=replace(settings.web, **said))
        if insecure:
            settings = replace(settings, trust=replace(settings.trust, insecure=True))
        return module, _setup(module, settings)

    module, setup = make()
    if check:
        options.show({}, "the settings can be used")
        return 0
    journal = in_journal(os.environ, sys.stderr.fileno())
    configure_logging(setup.settings.log_level, sys.stderr, as_json=setup.settings.log_json, in_journal=journal)
    said = [f"--insecure: {INSECURE['trust.insecure']}"] if insecure else []
    for note in (*module.loaded.notes, *said):
        _web_log.warning("! %s [doubtful-setting]", note)
    from rmpa.web.server.process import serve

    def announce(url: str, access: TokenAccess) -> None:
        lines = [url]
        if access.is_new:
            lines.append(f"the token is kept in {access.file}; it is not printed again")
        elif access.file:
            lines.append(f"clients need the token of {access.file}")
        options.show({"url": url, "token_file": str(access.file or "")}, lines)
        sys.stdout.flush()

    while True:
        if setup.trusted and not Permissions(setup.settings.trust).knows("web"):
            _web_log.warning("! no [[permission]] lets web do anything: its clients see names alone [not-permitted]")
        pinned = module.name if module.chosen.source.said else None
        if not asyncio.run(serve(setup, pinned, announce, load=lambda: make()[1])):
            return 0
        module, setup = make()


def _setup(module: Module, settings: Settings) -> WebSetup:
    """What the server of a module is made of; it is as secure as the module's agent.

    Raises:
        RmpaError: A file cannot be used; or no agent runs, the module has no keys, and others have some.
    """
    from rmpa.trust.store import check_open
    from rmpa.web.server.process import WebSetup, access_of, certificate_files, tls_context

    store = module.store if module.state is not None else None
    trusted = module.agent == "secured" or (store is not None and store.exists)
    if not trusted and module.socket is None:
        check_open(settings.trust, module.state, module.name, os.environ, "--agent")
    if trusted:
        settings = replace(settings, trust=agent_settings(module).settings.trust)
    files = certificate_files(settings.web.cert, settings.web.key, store if trusted else None)
    tls_context(files)  # a changed certificate that cannot be used must not end a server that runs
    access = access_of(settings.web, module.name, os.environ, settings.state_dir)
    folder = str(store.folder) if store is not None else ""
    return WebSetup(settings, access, files, trusted, module.name, folder)


def _host(option: str, text: str) -> str:
    try:
        return HOST.read(text)
    except BadValue as error:
        raise ConfigError(option, error.problem, error.remedy) from None


def _default_port() -> int:
    """The port of ``ROS_MASTER_URI`` if its host is this machine, as for roscore; else 11311."""
    from rmpa.ros.core.embedded import DEFAULT_PORT
    from rmpa.ros.http.rpc import is_own_name, split_uri

    try:
        host, port, _ = split_uri(os.environ.get("ROS_MASTER_URI", ""))
    except UnreachableError:
        return DEFAULT_PORT
    return port if is_own_name(host) or host.startswith("127.") else DEFAULT_PORT


@verb(
    click.option(
        "-p",
        "--port",
        type=click.IntRange(0, 65535),
        help="Port to listen at; 0 lets the system choose. [default: the port of ROS_MASTER_URI, or 11311]",
    ),
    click.option(
        "--host",
        default="127.0.0.1",
        show_default=True,
        help="Address to listen at; 0.0.0.0 opens it to the network.",
    ),
    click.option(
        "--advertise", default="", metavar="NAME", help="Host name or address that nodes are given, if not --host."
    ),
    click.option(
        "--keep",
        type=click.Choice(["auto", "always", "never"]),
        default="auto",
        show_default=True,
        help="Restore nodes and parameters of the last run: auto, if one of its nodes runs or the core crashed.",
    ),
    flag("-v", "--verbose", help="Log every registration."),
    flag("--debug", help="Log every call."),
)
def core(port: int | None, host: str, advertise: str, keep: str, verbose: bool, debug: bool) -> None:
    """Run a ROS core: master, parameter server and /rosout, as roscore does."""
    from rmpa.runtime.accept import raise_file_limit

    level = logging.DEBUG if debug else logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)-7s %(name)s %(message)s")
    raise_file_limit()
    asyncio.run(_run_core(host, _default_port() if port is None else port, advertise, keep))


async def _run_core(host: str, port: int, advertised: str, keep: str) -> None:
    from rmpa import __version__
    from rmpa.config.module_name import core_file
    from rmpa.ros.core.embedded import ROS_VERSION, RosCore
    from rmpa.ros.environment import shown_uri

    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    state = core_file(os.environ, port)
    core = RosCore(host, port, advertised_host=advertised, on_shutdown=lambda _: ended.set(), state=state, keep=keep)
    await core.start()
    print_text(
        f"rmpa core {__version__}, in place of ros_comm {ROS_VERSION.strip()}",
        f"ROS_MASTER_URI={shown_uri(core.uri)}",
        f"setting /run_id to {core.call('getParam', '/rmpa_core', '/run_id').value}",
        "started core service [/rosout]",
        [text] if core.stored is not None and (text := core.stored.restored()) else [],
    )
    sys.stdout.flush()
    await ended.wait()
    print_text("shutting down")
    await core.close()


@verb(
    setting_options("gateway", without=_OF_THE_PROCESS),
    click.option(
        "--name",
        metavar="NAME",
        help="The gateway whose certificate it has. [default: the module's name, then _gateway]",
    ),
    config_option,
)
def gateway_zenoh_config(**options: object) -> None:
    """Print a configuration for zenohd, Zenoh's own router: endpoints, certificates, rules of access.

    ---
    The certificate is that of the gateway's name in the secured mesh (--name); the rules of access are made from
    [[permission]] and [trust] of rmpa.toml. Print it again and restart zenohd when a rule has changed.

    Examples:
      rmpa gateway zenoh-config --name fleet > zenohd.json5
      zenohd -c zenohd.json5
      rmpa gateway zenoh-config --listen tcp/0.0.0.0:7447 --insecure     in a network of your own
    """
    loaded = load_gateway(options, dict(os.environ), socket.gethostname())
    for note in loaded.notes:
        warn(note, "doubtful-setting")
    from rmpa.gateway.zenoh.config import zenohd_config

    click.echo(zenohd_config(loaded.settings), nl=False)
