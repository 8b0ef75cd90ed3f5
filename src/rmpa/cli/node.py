"""``rmpa node``: the nodes of this module and of its peers."""

from __future__ import annotations

from typing import Final

import click

from rmpa.cli.lazy import LazyGroup

_GRAPH: Final = "rmpa.cli.node_graph"
_COMMANDS: Final = "rmpa.cli.node_commands"


@click.group(
    cls=LazyGroup,
    commands_at={
        "list": (_GRAPH, "List nodes; those of peers as PEER:/node."),
        "info": (_GRAPH, "Show a node's module, address, process, topics and services."),
        "ping": (_COMMANDS, "Ask whether a node answers, and how fast."),
        "kill": (_COMMANDS, "End nodes."),
    },
    epilog="""\
\b
A node is written /name; PEER:/name means that one peer's. A proxy's name, /rmpa/PEER/name, means the same.
The master: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of the only
agent of this machine, else http://localhost:11311.
""",
)
def node() -> None:
    """See nodes, here and in other modules; ping and end them. No ROS installation is needed."""
