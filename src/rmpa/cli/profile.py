"""``rmpa profile``: the System Profiles of a resource."""

from __future__ import annotations

from typing import Final

import click

from rmpa.cli.lazy import LazyGroup

_HERE: Final = "rmpa.cli.profile_commands"


@click.group(
    cls=LazyGroup,
    commands_at={
        "list": (_HERE, "List a resource's profiles and what they offer."),
        "get": (_HERE, "Print the profile that runs."),
        "set": (_HERE, "Choose a profile by hand, or let the resource decide again."),
        "explain": (_HERE, "Show each term of the last decision."),
    },
    epilog="\b\nA resource is written as its node, /sonar; PEER:/sonar is that peer's. See rmpa resource --help.\n",
)
def profile() -> None:
    """See and choose the System Profile of a resource, here or at a peer."""
