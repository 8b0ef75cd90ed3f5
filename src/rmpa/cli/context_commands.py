"""``rmpa context list|get|set``."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING

import click

from rmpa.cli.master import choose_master
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import Column, print_json, print_table, printable
from rmpa.cli.resources_seen import known_name, look_around
from rmpa.core.errors import ConfigError, RmpaError

if TYPE_CHECKING:
    from rmpa.cli.resources_seen import Room, Seen


@click.command("list", epilog="\b\nExamples:\n  rmpa context list\n  rmpa context list base:/sonar --json\n")
@click.argument("resource", required=False)
@json_option
@agent_option
@master_option
def list_(resource: str | None, as_json: bool, agent: str | None, master: str | None) -> None:
    """List a RESOURCE's contexts, their rules and what they require."""

    async def body(room: Room) -> None:
        one = room.pick(resource)
        present, chosen = await _present(room, one)
        contexts = one.descriptor.contexts
        if as_json:
            print_json(
                {"resource": one.path, "peer": one.peer, "context": present, "chosen": chosen, "contexts": contexts}
            )
            return
        columns = tuple(map(Column, ("CONTEXT", "NOW", "WHEN", "REQUIRES", "PROFILES", "OUTPUTS")))
        rows = [
            tuple(
                printable(cell)
                for cell in (
                    each.name,
                    _mark(each.name, present, chosen),
                    each.when or "by hand",
                    ", ".join(f"{key} {wish}" for key, wish in each.requires.items()) or "-",
                    ", ".join(each.profiles) or "any",
                    ", ".join(each.outputs) or "none" if each.outputs is not None else "all",
                )
            )
            for each in contexts
        ]
        print_table(columns, rows)

    asyncio.run(look_around(choose_master(master, agent, os.environ), body))


def _mark(name: str, present: str, chosen: str) -> str:
    if name != present:
        return ""
    return "by hand" if name == chosen else "yes"


async def _present(room: Room, one: Seen) -> tuple[str, str]:
    """The present context, and the one chosen by hand."""
    if not one.descriptor.contexts:
        return "", ""
    (said,), values = await asyncio.gather(room.texts([one], "context"), room.configuration(one))
    if one not in said:
        raise RmpaError(f"{one} does not say its context; does it run?")
    return said[one], str(values.get("context", ""))


@click.command(epilog="\b\nExamples:\n  rmpa context get /sonar\n")
@click.argument("resource", required=False)
@json_option
@agent_option
@master_option
def get(resource: str | None, as_json: bool, agent: str | None, master: str | None) -> None:
    """Print the present context of a RESOURCE; an empty line for none."""

    async def body(room: Room) -> None:
        one = room.pick(resource)
        present, chosen = await _present(room, one)
        if as_json:
            print_json({"resource": one.path, "peer": one.peer, "context": present, "chosen": chosen})
        else:
            click.echo(printable(present))

    asyncio.run(look_around(choose_master(master, agent, os.environ), body))


@click.command(
    "set",
    epilog="\b\nExamples:\n  rmpa context set /sonar docked\n  rmpa context set base:/sonar --auto\n",
)
@click.argument("resource")
@click.argument("context", required=False)
@click.option("--auto", is_flag=True, help="Let the rules decide again.")
@agent_option
@master_option
def set_(resource: str, context: str | None, auto: bool, agent: str | None, master: str | None) -> None:
    """Choose the CONTEXT of a RESOURCE by hand; returns when it is there."""
    if (context is None) != auto:
        raise ConfigError("CONTEXT", "say which one, or --auto", "one of both")

    async def body(room: Room) -> None:
        one = room.pick(resource)
        if not one.descriptor.contexts:
            raise ConfigError("RESOURCE", f"{one} has no contexts", "")
        if context is not None:
            known_name("context", context, (each.name for each in one.descriptor.contexts))
        await room.configure(one, {"context": context or ""})

    asyncio.run(look_around(choose_master(master, agent, os.environ), body))
