"""``rmpa experiment``: the paper's evaluation on this machine."""

from __future__ import annotations

from typing import Final

import click

from rmpa.cli.lazy_group import LazyGroup

_HERE: Final = "rmpa.cli.experiment_commands"


@click.group(
    cls=LazyGroup,
    commands_at={
        "list": (_HERE, "List the experiments, how long they take, and where they would run here."),
        "run": (_HERE, "Measure classic ROS and RMPA side by side, and write the report."),
        "report": (_HERE, "Write the report of a run again."),
        "compare": (_HERE, "Compare two runs."),
    },
    epilog="""\
\b
With root, iproute2 and ROS 1 the hosts are network namespaces with a shaped cable each, and the nodes rospy's and
roscpp's. Without them all is on loopback, with our own nodes and core, and the report says so.
""",
)
def experiment() -> None:
    """Measure whether RMPA keeps its promise: the paper's evaluation, classic ROS beside it, on this machine."""
