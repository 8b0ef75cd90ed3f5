"""``rmpa gateway``: joins this network's modules with other sites and with ROS 2, over Zenoh."""

from __future__ import annotations

import contextlib
import gc
import importlib.util
import logging
import os
import socket
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

import click
import msgspec

from rmpa.cli.agent import find_name
from rmpa.cli.main import LazyGroup
from rmpa.cli.options import agent_option, config_option, json_option, setting_options
from rmpa.cli.output import Column, duration, print_json, print_line, print_table, printable, warn
from rmpa.config.module_name import GATEWAY_SUFFIX
from rmpa.config.read import load_settings
from rmpa.config.settings import WebSettings
from rmpa.config.values import did_you_mean
from rmpa.core.counters import configure_logging
from rmpa.core.errors import ConfigError, PeerRefused, RemoteProtocolError, RmpaError, StartError
from rmpa.core.identity import peer_name_from
from rmpa.observe import limits
from rmpa.observe.control import GATEWAY_REPORT
from rmpa.observe.control_client import INFO, REPORT, ControlClient, choose_agent, find_agents
from rmpa.observe.peer_info import SitesReport
from rmpa.runtime.process import LogWriter
from rmpa.trust.joining import TrustStatus

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.config.read import Given, Loaded
    from rmpa.config.settings import Settings
    from rmpa.observe.peer_info import SiteInfo

_log = logging.getLogger("rmpa.gateway")
_LIBRARIES: Final = {"zenoh": "eclipse-zenoh", "xxhash": "xxhash"}
"""What the extra installs: the name in Python, and that of the package."""
_OF_THE_AGENT: Final = ("core_mode", "core_master", "core_keep", "web.enabled", "trust.insecure")
"""Settings whose options a gateway has not: its core is its own, and only for its proxies; it has an --insecure."""
COMMANDS: Final = {
    "zenoh-config": ("rmpa.cli.gateway", "Print a configuration for zenohd, Zenoh's own router."),
}
EPILOG = """\
\b
The gateway is a peer of the mesh with a core of its own, beside this machine's agent. It reads the same rmpa.toml and
RMPA_* variables, but its name, its core's address and the mesh's port only from its own options.
What may cross: [[gateway.rule]] (docs/sites.md), mapping files of ROS 2 (docs/ros2.md).
\b
Exit codes: 0 it was ended; 1 it cannot start; 2 a wrong option or setting, or a library that is not installed.

\b
Examples:
  rmpa gateway --site warehouse --connect tls/fleet.example:7447     one site of a fleet
  rmpa gateway --router --listen tls/0.0.0.0:7447                    the router that they meet at
  rmpa gateway --site b --rank 200 --connect tls/fleet.example:7447  stands by for the one with rank 100
  rmpa gateway --ros2 --connect tcp/localhost:7447                   ROS 2 nodes beside rmw_zenohd
  rmpa gateway zenoh-config --listen tls/0.0.0.0:7447 > zenohd.json5 a router with zenohd instead
"""
_options = setting_options(
    "gateway",
    "up",
    without=_OF_THE_AGENT,
    defaults={"name": "the module's name, then _gateway", "core_port": "any free one"},
)


@click.group(cls=LazyGroup, commands_at=COMMANDS, epilog=EPILOG, invoke_without_command=True)
@_options
@config_option
@click.pass_context
def gateway(context: click.Context, /, **options: object) -> int:
    """Join this network's modules with other sites and with ROS 2, over Zenoh.

    Topics, services, actions and parameters cross once a node at the other side asks for them.
    """
    if context.invoked_subcommand is not None:
        given = [name for name, value in options.items() if value not in (None, ())]
        if given:
            flag = f"--{given[0].replace('_', '-')}"
            raise ConfigError(flag, f"stands before {context.invoked_subcommand}", "write it behind that")
        return 0
    check_libraries()
    found = None if options["name"] else find_name(None, {"config": options.get("config")}, _own(os.environ))
    beside = found.chosen.name if found is not None else ""

    def load() -> Loaded:
        return load_gateway(options, dict(os.environ), socket.gethostname(), beside)

    loaded = load()
    check_settings(loaded.settings)
    check_agents(loaded.settings, os.environ)
    writer = LogWriter(sys.stderr.fileno())
    configure_logging(loaded.settings.log_level, writer, as_json=loaded.settings.log_json)
    for note in loaded.notes:
        _log.warning("%s", note)
    gc.disable()  # as in rmpa up: the start takes a third less time; the agent turns it on again
    from rmpa.gateway.gateway import run

    try:
        return run(loaded.settings, load, lambda: check_agents(loaded.settings, os.environ))
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
    settings = replace(
        settings,
        name=settings.name if _is_option(given, "name") else _gateway_name(beside or settings.name),
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


def _gateway_name(module: str) -> str:
    """The gateway's name beside a module; where it has a state directory of its own, it may be kept there."""
    return module if module.endswith(GATEWAY_SUFFIX) else peer_name_from(module + GATEWAY_SUFFIX)


def check_agents(settings: Settings, environ: Mapping[str, str]) -> None:
    """Check that a gateway is no less secure than the agents of this machine.

    Raises:
        StartError: One is a member of a secured mesh, the gateway is not, and ``trust.insecure`` is not set.
        RmpaError: One does not answer whether it is.
    """
    from rmpa.agent.trust import trust_store

    store = trust_store(settings)
    if settings.trust.insecure or (store is not None and store.exists):
        return
    for agent in find_agents(environ):
        with ControlClient(agent.path) as client:
            secured = client.call("trust", TrustStatus, what="status").agent == "secured"
        if secured:
            problem = f"has no keys, beside the agent {agent.name} in a secured mesh"
            remedy = f"let it join: rmpa trust join TOKEN --name {settings.name}; or say --insecure"
            raise StartError(f"the gateway {settings.name}", problem, remedy)


def _is_option(given: Mapping[str, Given], name: str) -> bool:
    return name in given and given[name].source.startswith("--")


def check_settings(settings: Settings) -> None:
    """Check that there is something to join, and a way to it.

    Raises:
        ConfigError: There is not.
    """
    it = settings.gateway
    if not (it.site or it.ros2.enabled or it.router):
        raise ConfigError("rmpa gateway", "there is nothing to join", "say --site NAME for other sites, or --ros2")
    if it.router and not it.listen:
        raise ConfigError("gateway.router", "a router that listens nowhere", "add --listen tls/0.0.0.0:7447")
    if not (it.connect or it.listen):
        example = "tcp/localhost:7447 for rmw_zenohd here" if it.ros2.enabled else "tls/fleet.example:7447"
        raise ConfigError("rmpa gateway", "there is no way to the others", f"add --connect, such as {example}")


def check_libraries() -> None:
    """Check that the libraries of the extra are there.

    Raises:
        ConfigError: One is missing.
    """
    missing = [package for name, package in _LIBRARIES.items() if not _is_there(name)]
    if missing:
        problem = f"{' and '.join(missing)} not installed"
        raise ConfigError("rmpa gateway", problem, "run pip install 'rmpa[zenoh]'")


def _is_there(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # it was taken out of sys.modules
        return False


# ``rmpa site list|info``: other sites that gateways join.


_T = TypeVar("_T")
_COLOURS: Final = {"this site": "green", "joined": "green", "no gateway": "yellow", "unreachable": "red"}
_COLUMNS: Final = (
    *map(Column, ("SITE", "STATE")),
    *(Column(title, right=True) for title in ("SINCE", "GATEWAYS", "MODULES", "SOURCES", "SHOWN")),
    Column("BY"),
)
_MODULES: Final = (Column("  MODULE"), *(Column(title, right=True) for title in ("TOPICS", "SERVICES", "SHOWN")))
_SOURCES: Final = tuple(map(Column, ("  NAME", "KIND", "TYPE", "MODULE", "NODE", "HERE")))

name_option = click.option("--name", metavar="GATEWAY", help="Ask this gateway of this machine, not --agent's.")


def _connect(agent: str | None, name: str | None) -> ControlClient:
    return ControlClient(choose_agent(os.environ, name or agent).path, timeout=limits.CONTROL_HANDLER_TIMEOUT)


def _ask(client: ControlClient, what: str, kind: type[_T], **args: object) -> _T:
    try:
        value: object = client.call("site", object, what=what, args=args)
    except PeerRefused as error:
        raise RmpaError(error.reason) from None  # the agent only passes on what a gateway says
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"the gateway answers in another way: {error}; is it another version?") from None


@click.command(
    "list",
    epilog="""\
\b
Exit codes: 0 each site is joined; 1 one is not, or no gateway answers.

\b
Examples:
  rmpa site list
  rmpa site list --name store-gateway
  rmpa site list --json | jq -r '.[].sites[].name'
""",
)
@json_option
@agent_option
@name_option
def list_(as_json: bool, agent: str | None, name: str | None) -> int:
    """List this site and the others that its gateways join.

    SOURCES are the topics (one for each publisher) and services that a site offers, SHOWN those that are in the
    graph here. BY is the gateway that was asked; one that stands by shows nothing.
    """
    with _connect(agent, name) as client:
        reports = _ask(client, REPORT, tuple[SitesReport, ...])
        absent = "" if reports else _why_none(client)
    if not reports:
        warn(absent)
    if as_json:
        print_json(reports)
    elif reports:
        rows = [(report, site) for report in reports for site in report.sites]
        print_table(
            _COLUMNS,
            [_row(report, site) for report, site in rows],
            colours=[_COLOURS.get(s.state, "") for _, s in rows],
        )
        for report in reports:
            if report.problem:
                warn(f"{report.gateway}: {report.problem}")
            if not any(site.state != "this site" for site in report.sites):
                warn(f"{report.gateway} of site {report.site} knows no other site{_where(report)}")
    well = all(s.state in ("this site", "joined") for report in reports for s in report.sites)
    return 0 if reports and well and not any(report.problem for report in reports) else 1


def _why_none(client: ControlClient) -> str:
    """Why no gateway answers: this agent is a gateway whose session is not open, or it knows none."""
    with contextlib.suppress(RmpaError):  # no gateway: it has no such operation
        problem = str(client.call(GATEWAY_REPORT, dict[str, object]).get("problem", ""))
        return f"{client.name} joins no site: {problem or 'it is a gateway without --site'}"
    start = "start one with `rmpa gateway --site NAME`; in a secured mesh `relays` of [trust] names it"
    return f"{client.name} is no gateway, and is linked to none: {start}"


def _where(report: SitesReport) -> str:
    if report.endpoints:
        return f": it is connected to {', '.join(report.endpoints)}, where no other gateway is"
    return ": it is connected to nothing; is the router of gateway.connect there?"


def _row(report: SitesReport, site: SiteInfo) -> list[str]:
    sources = sum(module.topics + module.services for module in site.modules)
    shown = sum(module.shown for module in site.modules)
    return [
        site.name,
        site.state,
        duration(site.since_ago),
        str(site.gateways),
        str(len({module.name for module in site.modules})),
        str(sources),
        str(shown),
        report.gateway + ("" if report.leads else " (stands by)"),
    ]


@click.command(
    epilog="""\
\b
Exit codes: 0 the site is joined, or this one; 1 it is not there, or not known.

\b
Examples:
  rmpa site info warehouse
  rmpa site info warehouse --json | jq '.sites[0].sources[] | select(.here == "")'
"""
)
@click.argument("site")
@json_option
@agent_option
@name_option
def info(site: str, as_json: bool, agent: str | None, name: str | None) -> int:
    """Show the modules of SITE, what they offer, its name here, and why something does not cross."""
    with _connect(agent, name) as client:
        report = _ask(client, INFO, SitesReport, site=site)
    found = next((each for each in report.sites if each.name == site), None)
    if found is None:
        raise RmpaError(_unknown(report, site))
    if as_json:
        print_json(report)
    else:
        _show(report, found)
    return 0 if found.state in ("this site", "joined") else 1


def _unknown(report: SitesReport, site: str) -> str:
    known = [each.name for each in report.sites]
    near = did_you_mean(site, known)
    return f"{report.gateway} knows no site {printable(site)!r}; " + (
        f"did you mean {near}?" if near else f"known are {', '.join(known)}"
    )


def _show(report: SitesReport, site: SiteInfo) -> None:
    since = f" for {duration(site.since_ago)}" if site.since_ago is not None else ""
    facts = [
        ("Site", site.name),
        ("State", site.state + since),
        ("Gateways", str(site.gateways)),
        ("Seen by", f"{report.gateway} of site {report.site}" + ("" if report.leads else ", which stands by")),
        ("Connected", ", ".join(report.endpoints) or "to nothing"),
    ]
    if site.not_shown:
        facts.append(("Kept out", f"{site.not_shown} topics and services, by rules or for their names"))
    if site.beyond:
        facts.append(("Limit", f"{site.beyond} topics and services were left out: the site has too many"))
    for label, text in facts:
        print_line(f"{label + ':':<10} {text}")
    if site.modules:
        click.echo("\nModules:")
        rows = [[f"  {m.name}", str(m.topics), str(m.services), str(m.shown)] for m in site.modules]
        print_table(_MODULES, rows)
    if site.sources:
        click.echo("\nTopics and services:")
        print_table(
            _SOURCES, [[f"  {s.name}", s.kind, s.type, s.module, s.node, s.here or "-"] for s in site.sources]
        )
    for source in site.sources:
        if source.problem:
            warn(f"{source.name} of {source.module}: {source.problem}")


# ``rmpa gateway zenoh-config``: a configuration for zenohd as the router of a fleet.


_OF_THE_PROCESS = (
    "gateway.rank",
    "gateway.router",
    "gateway.site",
    "gateway.ros2.distribution",
    "gateway.ros2.mapping",
)
"""Settings of a gateway that a router has no use for."""
ZENOH_CONFIG_EPILOG = """\
\b
The certificate is that of the gateway's name in the secured mesh (--name); the rules of access are made from
[[permission]] and [trust] of rmpa.toml. Print it again and restart zenohd when a rule has changed.

\b
Examples:
  rmpa gateway zenoh-config --name fleet > zenohd.json5 && zenohd -c zenohd.json5
  rmpa gateway zenoh-config --listen tcp/0.0.0.0:7447 --insecure     in a network of your own
"""


@click.command(name="zenoh-config", epilog=ZENOH_CONFIG_EPILOG)
@setting_options("gateway", without=_OF_THE_PROCESS)
@click.option("--name", metavar="NAME", help="Whose certificate it has. [default: the module's name, then _gateway]")
@config_option
def zenoh_config(**options: object) -> None:
    """Print a configuration for zenohd, Zenoh's own router: endpoints, certificates, rules of access."""
    loaded = load_gateway(options, dict(os.environ), socket.gethostname())
    for note in loaded.notes:
        warn(note)
    from rmpa.gateway.zenoh.access import zenohd_config

    click.echo(zenohd_config(loaded.settings), nl=False)
