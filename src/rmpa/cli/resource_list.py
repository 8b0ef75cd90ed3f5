"""``rmpa resource list``: those that are here, and those that were seen before."""

from __future__ import annotations

import asyncio
import os
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.master import choose_master
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import Column, print_json, print_table, printable, warn
from rmpa.cli.resources_known import remembered
from rmpa.cli.resources_seen import look_around
from rmpa.core.errors import UnreachableError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.cli.master import Master
    from rmpa.cli.resources_known import KnownResource
    from rmpa.cli.resources_seen import Room, SeenResource

_COLOURS: Final = {"active": "green", "inactive": "yellow", "unconfigured": "yellow", "finalized": "red"}
_TITLES: Final = ("RESOURCE", "STATE", "ROLE", "KIND", "PROFILE", "CONTEXT", "DESCRIPTION")
_EXAMPLES: Final = """\
\b
Examples:
  rmpa resource list
  rmpa resource list --known                   those too that are not here now
  rmpa resource list --json | jq -r '.[].name'
"""


@dataclass(frozen=True, slots=True)
class _Present:
    """A resource that is here, with what it says; ``None``: it does not answer."""

    seen: SeenResource
    state: str | None
    profile: str | None
    context: str | None


@click.command("list", epilog=_EXAMPLES)
@click.option("--known", is_flag=True, help="Those too that `rmpa run` has seen before and that are not here now.")
@click.option("--state", metavar="DIR", help="Where it wrote them down. [env: RMPA_STATE_DIR]")
@json_option
@agent_option
@master_option
def list_(known: bool, state: str | None, as_json: bool, agent: str | None, master: str | None) -> None:
    """List the resources of this module, and those of peers with the peers' names."""
    here: list[_Present] = []
    module = agent or os.environ.get("RMPA_AGENT")
    try:
        chosen = choose_master(master, agent, os.environ)
        here = _here(chosen)
        module = snapshot.agent.name if (snapshot := chosen.snapshot()) is not None else None
    except UnreachableError as error:
        if not known:
            raise
        warn(printable(str(error)))
    gone = remembered(module, state, [each.seen for each in here]) if known else []
    if as_json:
        more = {"here": True} if known else {}
        print_json([_as_json(e.seen, e) | more for e in here] + [_as_json(e.seen) | _as_known(e) for e in gone])
    else:
        _print(here, gone)


def _here(master: Master) -> list[_Present]:
    """The resources that the master's graph shows now."""
    found: list[_Present] = []

    async def body(room: Room) -> None:
        for path, count in Counter(one.path for one in room.seen).items():
            if count > 1:
                text = "what is asked of that name is heard by all of them; docs/names.md tells them apart"
                warn(f"{count} modules have a resource {printable(path)}: {text}")
        states, profiles, contexts = await room.texts(room.seen, "state", "profile", "context")
        found.extend(_Present(one, states.get(one), profiles.get(one), contexts.get(one)) for one in room.seen)

    asyncio.run(look_around(master, body))
    return found


def _print(here: Sequence[_Present], gone: Sequence[KnownResource]) -> None:
    rows = [_row(one.seen, one.state or "does not answer", one.profile, one.context) for one in here]
    rows += [_row(one.seen, str(one), None, None) for one in gone]
    colours = [_COLOURS.get(one.state or "", "") for one in here] + [""] * len(gone)
    titles = list(_TITLES)
    if len({one.module for one in gone}) > 1:  # then the names are those of several graphs
        titles.append("SEEN BY")
        modules = [*("-" for _ in here), *(printable(one.module) for one in gone)]
        rows = [[*row, module] for row, module in zip(rows, modules, strict=True)]
    print_table(tuple(map(Column, titles)), rows, colours=colours)


def _row(seen: SeenResource, state: str, profile: str | None, context: str | None) -> list[str]:
    said = seen.descriptor
    kind = "device" if said.physical else "simulated"
    cells = (str(seen), state, said.role, kind, profile or "-", context or "-", said.description)
    return [printable(cell) for cell in cells]


def _as_json(seen: SeenResource, present: _Present | None = None) -> dict[str, Any]:
    return {
        "name": seen.path,
        "peer": seen.peer,
        "role": seen.descriptor.role,
        "physical": seen.descriptor.physical,
        "description": seen.descriptor.description,
        "state": present.state if present is not None else None,
        "profile": present.profile if present is not None else None,
        "context": present.context if present is not None else None,
    }


def _as_known(one: KnownResource) -> dict[str, Any]:
    return {
        "here": False,
        "seen_by": one.module,
        "first_seen": one.first,
        "last_seen": one.last,
        "last_seen_ago": one.ago,
        "descriptor": one.seen.descriptor,
    }
