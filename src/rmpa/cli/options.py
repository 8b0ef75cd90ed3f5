"""Flags that several commands share."""

from __future__ import annotations

import click

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON; a stream prints one object a line.")
agent_option = click.option(
    "--agent", metavar="NAME", help="Which agent of this machine to ask, if several run. [env: RMPA_AGENT]"
)
master_option = click.option(
    "--master", metavar="URI", help="The ROS master to ask. [default: see rmpa topic --help]"
)
