"""``rmpa gateway``: joins this network's modules with other sites and with ROS 2, over Zenoh."""

from __future__ import annotations

import gc
import importlib.util
import logging
import os
import socket
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.lazy_group import LazyGroup
from rmpa.cli.module import find_name
from rmpa.cli.setting_options import config_option, setting_options
from rmpa.config.module_name import GATEWAY_SUFFIX
from rmpa.config.read import load_settings
from rmpa.config.settings import WebSettings
from rmpa.core.counters import configure_logging
from rmpa.core.errors import ConfigError, StartError
from rmpa.core.identity import peer_name_from
from rmpa.observe.control_client import ControlClient, find_agents
from rmpa.runtime.process import LogWriter
from rmpa.trust.joining import TrustStatus

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.config.read import Given, Loaded
    from rmpa.config.settings import Settings

_log = logging.getLogger("rmpa.gateway")
_LIBRARIES: Final = {"zenoh": "eclipse-zenoh", "xxhash": "xxhash"}
"""What the extra installs: the name in Python, and that of the package."""
_OF_THE_AGENT: Final = ("core_mode", "core_master", "core_keep", "web.enabled", "trust.insecure")
"""Settings whose options a gateway has not: its core is its own, and only for its proxies; it has an --insecure."""
COMMANDS: Final = {
    "zenoh-config": ("rmpa.cli.zenoh_config", "Print a configuration for zenohd, Zenoh's own router."),
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
