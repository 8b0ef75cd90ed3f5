"""``rmpa resource list``: the resources of the graph, and those that were seen before."""

from __future__ import annotations

import asyncio
import os
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.known_resources import remembered
from rmpa.cli.options import GraphOptions, graph_options
from rmpa.cli.output import Column, print_json, print_table, warn
from rmpa.cli.resource_graph import with_resources
from rmpa.core.errors import UnreachableError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.cli.known_resources import KnownResource
    from rmpa.cli.master import Master
    from rmpa.cli.resource_graph import ResourceGraph, SeenResource

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
    """A resource of the graph with its state, profile and context; ``None`` where it does not answer."""

    seen: SeenResource
    state: str | None
    profile: str | None
    context: str | None


@click.command("list", epilog=_EXAMPLES)
@click.option("--known", is_flag=True, help="Those too that `rmpa run` has seen before and that are not here now.")
@click.option("--state", metavar="DIR", help="Where it wrote them down. [env: RMPA_STATE_DIR]")
@graph_options
def list_(known: bool, state: str | None, options: GraphOptions) -> None:
    """List the resources of this module, and those of peers with the peers' names."""
    here: list[_Present] = []
    module = options.agent or os.environ.get("RMPA_AGENT")
    try:
        master = options.master()
        here = _here(master)
        module = snapshot.agent.name if (snapshot := master.snapshot(topics=(), peers=False)) is not None else None
    except UnreachableError as error:
        if not known:
            raise
        warn(str(error))
    gone = remembered(module, state, [each.seen for each in here]) if known else []
    if options.as_json:
        more = {"here": True} if known else {}
        print_json([_as_json(e.seen, e) | more for e in here] + [_as_json(e.seen) | _as_known(e) for e in gone])
    else:
        _print(here, gone)


def _here(master: Master) -> list[_Present]:
    """The resources of the master's graph."""
    found: list[_Present] = []

    async def body(graph: ResourceGraph) -> None:
        for path, count in Counter(one.path for one in graph.seen).items():
            if count > 1:
                text = "what is asked of that name is heard by all of them; docs/names.md tells them apart"
                warn(f"{count} modules have a resource {path}: {text}")
        states, profiles, contexts = await graph.texts(graph.seen, "state", "profile", "context")
        found.extend(_Present(one, states.get(one), profiles.get(one), contexts.get(one)) for one in graph.seen)

    asyncio.run(with_resources(master, body))
    return found


def _print(here: Sequence[_Present], gone: Sequence[KnownResource]) -> None:
    rows = [_row(one.seen, one.state or "does not answer", one.profile, one.context) for one in here]
    rows += [_row(one.seen, str(one), None, None) for one in gone]
    colours = [_COLOURS.get(one.state or "", "") for one in here] + [""] * len(gone)
    titles = list(_TITLES)
    if len({one.module for one in gone}) > 1:  # the names are those of several graphs
        titles.append("SEEN BY")
        modules = [*("-" for _ in here), *(one.module for one in gone)]
        rows = [[*row, module] for row, module in zip(rows, modules, strict=True)]
    print_table(tuple(map(Column, titles)), rows, colours=colours)


def _row(seen: SeenResource, state: str, profile: str | None, context: str | None) -> list[str]:
    said = seen.descriptor
    kind = "device" if said.physical else "simulated"
    return [str(seen), state, said.role, kind, profile or "-", context or "-", said.description]


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
