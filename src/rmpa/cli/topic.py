"""``rmpa topic``: topics of this machine's agent, or of any ROS master."""

from __future__ import annotations

from typing import Final

import click

from rmpa.cli.lazy import LazyGroup

_GRAPH: Final = "rmpa.cli.topic_graph"
_WATCH: Final = "rmpa.cli.topic_watch"


@click.group(
    cls=LazyGroup,
    commands_at={
        "list": (_GRAPH, "List topics; those of peers with the peers' names."),
        "info": (_GRAPH, "Show a topic's type, publishers and subscribers, and what of it crosses."),
        "type": (_GRAPH, "Print a topic's type."),
        "find": (_GRAPH, "Print the topics of a type."),
        "echo": ("rmpa.cli.topic_echo", "Print messages."),
        "hz": (_WATCH, "Show how often messages come."),
        "bw": (_WATCH, "Show how many bytes they need."),
        "delay": (_WATCH, "Show how old they are when they come; over the mesh by the link's clock too."),
        "pub": ("rmpa.cli.topic_pub", "Publish messages."),
    },
    epilog="""\
\b
A topic is written /name; PEER:/name means the sources of one peer alone.
The master: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of the only
agent of this machine, else http://localhost:11311.
""",
)
def topic() -> None:
    """See topics, listen to them, publish on them; no ROS installation is needed."""
