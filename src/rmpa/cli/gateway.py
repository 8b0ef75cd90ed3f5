"""``rmpa gateway``, and ``rmpa gateway zenoh-config``."""

from __future__ import annotations

import gc
import logging
import os
import socket
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.main import LazyGroup, verb
from rmpa.cli.module import check_gateway, find_module
from rmpa.cli.options import config_option, option, setting_options
from rmpa.cli.output import begin_log, warn
from rmpa.config.module_name import GATEWAY_SUFFIX
from rmpa.config.read import Given, Loaded, load_settings
from rmpa.config.settings import Settings, WebSettings
from rmpa.core.errors import ConfigError, StartError
from rmpa.core.identity import peer_name_from
from rmpa.observe.control_client import ControlClient, find_agents
from rmpa.runtime.systemd import LogWriter
from rmpa.trust.permissions import TrustStatus

if TYPE_CHECKING:
    from collections.abc import Mapping


_log = logging.getLogger("rmpa.gateway")
# Settings whose options a gateway has not: its core is its own, and only for its proxies; it has an --insecure.
_OF_THE_AGENT: Final = ("core_mode", "core_master", "core_keep", "web.enabled", "trust.insecure")
# Settings of a gateway that a router has no use for.
_OF_THE_PROCESS: Final = (
    *("gateway.rank", "gateway.router", "gateway.site"),
    *("gateway.ros2.distribution", "gateway.ros2.mapping"),
)


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
        check_gateway(loaded.settings)
        return loaded

    loaded = load()
    _check_agents(loaded.settings)
    writer = LogWriter(sys.stderr.fileno())
    begin_log(loaded.settings, loaded.notes, _log, writer)
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


@verb(
    setting_options("gateway", without=_OF_THE_PROCESS),
    option("--name", "NAME", "The gateway whose certificate it has. [default: the module's name, then _gateway]"),
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
