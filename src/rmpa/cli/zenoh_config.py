"""``rmpa gateway zenoh-config``: a configuration for zenohd as the router of a fleet."""

from __future__ import annotations

import os
import socket

import click

from rmpa.cli.gateway import load_gateway
from rmpa.cli.output import warn
from rmpa.cli.setting_options import config_option, setting_options

_OF_THE_PROCESS = (
    "gateway.rank",
    "gateway.router",
    "gateway.site",
    "gateway.ros2.distribution",
    "gateway.ros2.mapping",
)
"""Settings of a gateway that a router has no use for."""
EPILOG = """\
\b
The certificate is that of the gateway's name in the secured mesh (--name); the rules of access are made from
[[permission]] and [trust] of rmpa.toml. Print it again and restart zenohd when a rule has changed.

\b
Examples:
  rmpa gateway zenoh-config --name fleet > zenohd.json5 && zenohd -c zenohd.json5
  rmpa gateway zenoh-config --listen tcp/0.0.0.0:7447 --insecure     in a network of your own
"""


@click.command(name="zenoh-config", epilog=EPILOG)
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
