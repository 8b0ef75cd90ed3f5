"""``rmpa context list|get|set``."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from rmpa.cli.choice_commands import ManualChoice, whose
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import Column, print_json, print_table, printable
from rmpa.cli.resources_seen import run_around
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from rmpa.cli.resources_seen import Room, SeenResource


@click.command("list", epilog="\b\nExamples:\n  rmpa context list\n  rmpa context list base:/sonar --json\n")
@click.argument("resource", required=False)
@json_option
@agent_option
@master_option
def list_(resource: str | None, as_json: bool, agent: str | None, master: str | None) -> None:
    """List a RESOURCE's contexts, their rules and what they require."""

    async def body(room: Room) -> None:
        one = room.pick(resource)
        present = await _present(room, one)
        contexts = one.descriptor.contexts
        if as_json:
            print_json({**whose(one), **present, "contexts": contexts})
            return
        columns = tuple(map(Column, ("CONTEXT", "NOW", "WHEN", "REQUIRES", "PROFILES", "OUTPUTS")))
        rows = [
            tuple(
                printable(cell)
                for cell in (
                    each.name,
                    _mark(each.name, **present),
                    each.when or "by hand",
                    ", ".join(f"{key} {wish}" for key, wish in each.requires.items()) or "-",
                    ", ".join(each.profiles) or "any",
                    ", ".join(each.outputs) or "none" if each.outputs is not None else "all",
                )
            )
            for each in contexts
        ]
        print_table(columns, rows)

    run_around(master, agent, body)


def _mark(name: str, context: str, chosen: str) -> str:
    if name != context:
        return ""
    return "by hand" if name == chosen else "yes"


async def _present(room: Room, one: SeenResource) -> dict[str, str]:
    """The present context, and the one chosen by hand."""
    if not one.descriptor.contexts:
        return {"context": "", "chosen": ""}
    (said,), values = await asyncio.gather(room.texts([one], "context"), room.configuration(one))
    if one not in said:
        raise RmpaError(f"{one} does not say its context; does it run?")
    return {"context": said[one], "chosen": str(values.get("context", ""))}


_CHOICE = ManualChoice("context", lambda descriptor: (each.name for each in descriptor.contexts), _present)
get = _CHOICE.get_command("Print the present context of a RESOURCE; an empty line for none.")
set_ = _CHOICE.set_command(
    "Choose the CONTEXT of a RESOURCE by hand; returns when it is there.", "Let the rules decide again.", "docked"
)
