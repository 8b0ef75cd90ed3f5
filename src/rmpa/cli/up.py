"""``rmpa up``: the agent of this machine."""

from __future__ import annotations

import gc
import logging
import os
import socket
import sys
from functools import partial

import click

from rmpa.config.sources import Flags, load_settings
from rmpa.config.values import LOG_LEVELS
from rmpa.core.log import configure_logging
from rmpa.runtime.log_writer import LogWriter

_log = logging.getLogger("rmpa.up")
EPILOG = """\
\b
Settings, each stronger than the last: the ROS environment (ROS_MASTER_URI's port, ROS_DOMAIN_ID,
ROS_STATIC_PEERS, ROS_AUTOMATIC_DISCOVERY_RANGE), rmpa.toml, RMPA_* variables, flags.

\b
Examples:
  rmpa up                                 all defaults; the name is the host's
  rmpa up --name base --interface wlan0   on one interface only
  rmpa up --seed 10.8.0.5:40001           greet an agent that multicast does not reach
  rmpa up --name b2 --core-port 11312     a second agent on this machine
  rmpa up --fresh                         forget what the core kept of the run before
  rmpa up --core external                 join the graph of a roscore that runs already
  rmpa up --realtime                      punctual on a busy machine; the log says what was not granted
"""


@click.command(epilog=EPILOG)
@click.option("--name", metavar="NAME", help="The module's name among its peers. [default: from the host's name]")
@click.option("--core-port", metavar="PORT", help="The ROS core's port. [default: 11311]")
@click.option(
    "--core-host", metavar="HOST", help="The address it listens at. [default: 127.0.0.1, this machine only]"
)
@click.option(
    "--core",
    "core_mode",
    metavar="MODE",
    help="embedded: run the ROS core; external: use the roscore of ROS_MASTER_URI. [default: embedded]",
)
@click.option("--master", "core_master", metavar="URI", help="The external core, if not ROS_MASTER_URI's.")
@click.option(
    "--fresh",
    is_flag=True,
    default=None,
    help="Begin with an empty core, as roscore does; else nodes and parameters of the run before are taken up.",
)
@click.option("--port", metavar="PORT", help="The mesh's port, TCP and UDP. [default: 0, any]")
@click.option("--domain", metavar="N", help="Only agents of one domain join, 0 to 232. [default: 0]")
@click.option("--interface", "interfaces", metavar="NAME", multiple=True, help="Use only this interface; repeatable.")
@click.option("--seed", "seeds", metavar="HOST:PORT", multiple=True, help="An agent to greet by unicast; repeatable.")
@click.option(
    "--multicast", metavar="GROUP:PORT", help="Where beacons go; off for none. [default: 239.255.82.77:11411]"
)
@click.option("--config", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")
@click.option("--log-level", metavar="LEVEL", help=f"{', '.join(LOG_LEVELS)}. [default: info]")
@click.option("--log-json", is_flag=True, default=None, help="Log one JSON object a line.")
@click.option(
    "--realtime/--no-realtime",
    default=None,
    help="Ask for SCHED_FIFO, locked memory and the CPUs of [realtime] in rmpa.toml. [default: no]",
)
def up(
    name: str | None,
    core_port: str | None,
    core_host: str | None,
    core_mode: str | None,
    core_master: str | None,
    fresh: bool | None,
    port: str | None,
    domain: str | None,
    interfaces: tuple[str, ...],
    seeds: tuple[str, ...],
    multicast: str | None,
    config: str | None,
    log_level: str | None,
    log_json: bool | None,
    realtime: bool | None,
) -> int:
    """Run this machine's agent: ROS core, discovery, mesh and bridge."""
    flags = Flags(
        name,
        core_host,
        core_port,
        core_mode,
        core_master,
        port,
        domain,
        interfaces,
        seeds,
        multicast,
        config,
        log_level,
        log_json,
        realtime,
        fresh,
    )
    load = partial(load_settings, flags, dict(os.environ), host_name=socket.gethostname())
    loaded = load()
    writer = LogWriter(sys.stderr.fileno())
    configure_logging(loaded.settings.log_level, writer, as_json=loaded.settings.log_json)
    for note in loaded.notes:
        _log.warning("%s", note)
    # Imports leave no garbage: without collection the start takes a third less time. The agent turns it on again.
    gc.disable()
    from rmpa.agent import run

    try:
        return run(loaded.settings, load)
    finally:
        writer.close()
