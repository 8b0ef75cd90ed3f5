"""``rmpa param``: parameters of this machine's core, of any ROS master, or of a peer."""

from __future__ import annotations

from typing import Final

import click

from rmpa.cli.lazy import LazyGroup

_HERE: Final = "rmpa.cli.param_commands"


@click.group(
    cls=LazyGroup,
    commands_at={
        "get": (_HERE, "Print a parameter, or a namespace of them."),
        "set": (_HERE, "Set a parameter, or the members of a namespace."),
        "list": (_HERE, "List the names of parameters."),
        "delete": (_HERE, "Delete a parameter, or a namespace of them."),
        "dump": (_HERE, "Write parameters as YAML."),
        "load": (_HERE, "Set parameters from YAML."),
        "followed": (_HERE, "List the parameters of other modules that this one follows ([[param]])."),
    },
    epilog="""\
\b
With --peer the parameters of that peer's module are meant; its [params] say what others may read and set.
The master without it: --master, else the core of --agent (or RMPA_AGENT), else ROS_MASTER_URI, else the core of
the only agent of this machine, else http://localhost:11311. YAML is read and written as rosparam does.
""",
)
def param() -> None:
    """See and set parameters, here or at a peer; no ROS installation is needed."""
