"""``rmpa alarm``: what is wrong with resources."""

from __future__ import annotations

from typing import Final

import click

from rmpa.cli.lazy import LazyGroup

_HERE: Final = "rmpa.cli.alarm_commands"


@click.group(
    cls=LazyGroup,
    commands_at={
        "list": (_HERE, "List the resources that are not well at present."),
        "echo": (_HERE, "Print alarms as they are raised and cleared, until Ctrl-C."),
    },
    epilog="\b\nA resource is written as its node, /sonar; PEER:/sonar is that peer's. See rmpa resource --help.\n",
)
def alarm() -> None:
    """See the alarms of resources, here and at peers."""
