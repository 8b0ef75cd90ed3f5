"""``rmpa resource``: the Smart Resources of this module, and of others."""

from __future__ import annotations

from typing import Final

import click

from rmpa.cli.lazy import LazyGroup

_HERE: Final = "rmpa.cli.resource_commands"


@click.group(
    cls=LazyGroup,
    commands_at={
        "list": ("rmpa.cli.resource_list", "List resources; those of peers with the peers' names."),
        "history": (
            "rmpa.cli.resource_history",
            "Show which profile ran when and why, violations, and the measured quality.",
        ),
        "info": (_HERE, "Show all of a resource: topics, parameters, qualities, profiles, contexts, clients."),
    },
    epilog="""\
\b
A resource is written as its node, /sonar; PEER:/sonar is that peer's. It may be left out where there is only one.
The master: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of the only
agent of this machine, else http://localhost:11311.
""",
)
def resource() -> None:
    """See Smart Resources, here or at a peer."""
