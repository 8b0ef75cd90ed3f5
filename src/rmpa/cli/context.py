"""``rmpa context``: the contexts of a resource."""

from __future__ import annotations

from typing import Final

import click

from rmpa.cli.lazy import LazyGroup

_HERE: Final = "rmpa.cli.context_commands"


@click.group(
    cls=LazyGroup,
    commands_at={
        "list": (_HERE, "List a resource's contexts, their rules and what they require."),
        "get": (_HERE, "Print the present context; an empty line for none."),
        "set": (_HERE, "Choose a context by hand, or let the rules decide again."),
    },
    epilog="\b\nA resource is written as its node, /sonar; PEER:/sonar is that peer's. See rmpa resource --help.\n",
)
def context() -> None:
    """See and choose the context of a resource, here or at a peer."""
