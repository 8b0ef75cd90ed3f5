"""``rmpa service``: services of this machine's agent, or of any ROS master."""

from __future__ import annotations

from typing import Final

import click

from rmpa.cli.lazy import LazyGroup

_GRAPH: Final = "rmpa.cli.service_graph"


@click.group(
    cls=LazyGroup,
    commands_at={
        "list": (_GRAPH, "List services; those of peers with the peers' names."),
        "info": (_GRAPH, "Show a service's node, address, type and arguments, and what of it crosses."),
        "type": (_GRAPH, "Print a service's type."),
        "find": (_GRAPH, "Print the services of a type."),
        "call": ("rmpa.cli.service_call", "Call a service."),
    },
    epilog="""\
\b
A service is written /name; PEER:/name means that one peer's, and nobody else's.
The master: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of the only
agent of this machine, else http://localhost:11311.
""",
)
def service() -> None:
    """See services, and call them; no ROS installation is needed."""
