"""``rmpa up``: the agent of this machine."""

from __future__ import annotations

import gc
import logging
import os
import socket
import sys
from functools import partial
from typing import TYPE_CHECKING

import click

from rmpa.config.settings import SETTINGS
from rmpa.config.sources import load_settings
from rmpa.core.log import configure_logging
from rmpa.runtime.log_writer import LogWriter

if TYPE_CHECKING:
    from collections.abc import Callable

_log = logging.getLogger("rmpa.up")
EPILOG = """\
\b
Settings, each stronger than the last: the ROS environment (ROS_MASTER_URI's port, ROS_DOMAIN_ID,
ROS_STATIC_PEERS, ROS_AUTOMATIC_DISCOVERY_RANGE), rmpa.toml, RMPA_* variables, options.
`rmpa config show` prints those that hold, each with its source.

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


def _setting_options(command: Callable[..., int]) -> Callable[..., int]:
    """An option for each setting that has one, in the order of their declarations."""
    for setting in reversed([setting for setting in SETTINGS if setting.option]):
        default = setting.shown_default or ("" if setting.is_switch or setting.is_list else str(setting.default))
        shown = setting.help + (" Repeatable." if setting.is_list else "")
        command = click.option(
            setting.option,
            is_flag=setting.is_switch,
            default=None,
            multiple=setting.is_list,
            metavar=None if setting.is_switch else setting.type.metavar,
            help=f"{shown} [default: {default}]" if default else shown,
        )(command)
    return command


@click.command(epilog=EPILOG)
@_setting_options
@click.option("--config", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")
def up(**options: object) -> int:
    """Run this machine's agent: ROS core, discovery, mesh and bridge."""
    load = partial(load_settings, options, dict(os.environ), host_name=socket.gethostname())
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
