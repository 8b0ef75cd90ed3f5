"""``rmpa up``: the agent of this machine."""

from __future__ import annotations

import gc
import logging
import os
import socket
import sys
from functools import partial

import click

from rmpa.cli.module import keep_first_name
from rmpa.cli.setting_options import config_option, setting_options
from rmpa.config.module_name import NameSource, choose_name
from rmpa.config.read import load_settings
from rmpa.core.counters import configure_logging
from rmpa.runtime.process import LogWriter

_log = logging.getLogger("rmpa.up")
EPILOG = """\
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


@click.command(epilog=EPILOG)
@setting_options("up")
@config_option
def up(**options: object) -> int:
    """Run this machine's agent: ROS core, discovery, mesh and bridge."""
    load = partial(load_settings, options, dict(os.environ), host_name=socket.gethostname())
    loaded = load()
    writer = LogWriter(sys.stderr.fileno())
    configure_logging(loaded.settings.log_level, writer, as_json=loaded.settings.log_json)
    for note in loaded.notes:
        _log.warning("%s", note)
    chosen = choose_name(loaded.name_facts)
    if chosen.source is NameSource.KEPT:
        _log.info("= the module is %s, as at its first start (%s)", chosen.name, loaded.given["name"])
    # Imports leave no garbage: without collection the start takes a third less time. The agent turns it on again.
    gc.disable()
    from rmpa.agent.agent import run

    try:
        return run(loaded.settings, load, partial(keep_first_name, loaded.settings, loaded.name_facts))
    finally:
        writer.close()
