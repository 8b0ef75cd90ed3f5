"""``rmpa context list|get|set``."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from rmpa.cli.manual_choice import ManualChoice, resource_json
from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import Column, print_json, print_table
from rmpa.cli.resource_graph import run_with_resources
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from rmpa.cli.resource_graph import ResourceGraph, SeenResource


@click.command("list", epilog="\b\nExamples:\n  rmpa context list\n  rmpa context list base:/sonar --json\n")
@click.argument("resource", required=False, shell_complete=completes("resource"))
@graph_options
def list_(resource: str | None, options: GraphOptions) -> None:
    """List a RESOURCE's contexts, their rules and what they require."""

    async def body(graph: ResourceGraph) -> None:
        one = graph.pick(resource)
        present = await _present(graph, one)
        contexts = one.descriptor.contexts
        if options.as_json:
            print_json({**resource_json(one), **present, "contexts": contexts})
            return
        columns = tuple(map(Column, ("CONTEXT", "NOW", "WHEN", "REQUIRES", "PROFILES", "OUTPUTS")))
        rows = [
            (
                each.name,
                _mark(each.name, **present),
                each.when or "by hand",
                ", ".join(f"{key} {bound}" for key, bound in each.requires.items()) or "-",
                ", ".join(each.profiles) or "any",
                ", ".join(each.outputs) or "none" if each.outputs is not None else "all",
            )
            for each in contexts
        ]
        print_table(columns, rows)

    run_with_resources(options, body)


def _mark(name: str, context: str, chosen: str) -> str:
    if name != context:
        return ""
    return "by hand" if name == chosen else "yes"


async def _present(graph: ResourceGraph, one: SeenResource) -> dict[str, str]:
    """The present context, and the one chosen by hand."""
    if not one.descriptor.contexts:
        return {"context": "", "chosen": ""}
    (said,), values = await asyncio.gather(graph.texts([one], "context"), graph.configuration(one))
    if one not in said:
        raise RmpaError(f"{one} does not say its context; does it run?")
    return {"context": said[one], "chosen": str(values.get("context", ""))}


_CHOICE = ManualChoice("context", lambda descriptor: (each.name for each in descriptor.contexts), _present)
get = _CHOICE.get_command("Print the present context of a RESOURCE; an empty line for none.")
set_ = _CHOICE.set_command(
    "Choose the CONTEXT of a RESOURCE by hand; returns when it is there.", "Let the rules decide again.", "docked"
)
