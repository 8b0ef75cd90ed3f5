"""``rmpa resource list``: the resources of the graph."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.options import GraphOptions, graph_options
from rmpa.cli.output import Column, print_json, print_table, warn
from rmpa.cli.resource_graph import run_with_resources

if TYPE_CHECKING:
    from rmpa.cli.resource_graph import ResourceGraph

_COLOURS: Final = {"active": "green", "inactive": "yellow", "unconfigured": "yellow", "finalized": "red"}
_TITLES: Final = ("RESOURCE", "STATE", "ROLE", "KIND", "PROFILE", "CONTEXT", "DESCRIPTION")
_EXAMPLES: Final = """\
\b
Examples:
  rmpa resource list
  rmpa resource list --json | jq -r '.[].name'
"""


@click.command("list", epilog=_EXAMPLES)
@graph_options
def list_(options: GraphOptions) -> None:
    """List the resources of this module, and those of peers with the peers' names."""

    async def body(graph: ResourceGraph) -> None:
        for path, count in Counter(one.path for one in graph.seen).items():
            if count > 1:
                text = "what is asked of that name is heard by all of them; docs/names.md tells them apart"
                warn(f"{count} modules have a resource {path}: {text}")
        states, profiles, contexts = await graph.texts(graph.seen, "state", "profile", "context")
        found: list[dict[str, Any]] = [
            {
                "name": one.path,
                "peer": one.peer,
                "role": one.descriptor.role,
                "physical": one.descriptor.physical,
                "description": one.descriptor.description,
                "state": states.get(one),
                "profile": profiles.get(one),
                "context": contexts.get(one),
            }
            for one in graph.seen
        ]
        if options.as_json:
            print_json(found)
        else:
            rows = [_row(str(one), each) for one, each in zip(graph.seen, found, strict=True)]
            colours = [_COLOURS.get(each["state"], "") for each in found]
            print_table(tuple(map(Column, _TITLES)), rows, colours=colours)

    run_with_resources(options, body)


def _row(name: str, each: dict[str, Any]) -> list[str]:
    kind = "device" if each["physical"] else "simulated"
    ends = [each["profile"] or "-", each["context"] or "-", each["description"]]
    return [name, each["state"] or "does not answer", each["role"], kind, *ends]
