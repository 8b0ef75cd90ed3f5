"""What ``rmpa profile`` and ``rmpa context`` have in common: which one there is, and choosing one by hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import print_json, printable
from rmpa.cli.resources_seen import known_name, run_around
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping

    from rmpa.cli.resources_seen import Room, SeenResource
    from rmpa.resource.run.descriptor import Descriptor


@dataclass(frozen=True, slots=True)
class ManualChoice:
    """What is chosen of a resource.

    Args:
        what: ``profile`` or ``context``: the word for it, and the parameter that chooses it.
        names: Those that a resource has.
        present: What there is now, for JSON, with ``what`` and ``chosen`` (by hand) in it.
    """

    what: str
    names: Callable[[Descriptor], Iterable[str]]
    present: Callable[[Room, SeenResource], Awaitable[Mapping[str, Any]]]

    def get_command(self, text: str) -> click.Command:
        """``get``, with its help."""

        @click.command("get", help=text, epilog=f"\b\nExamples:\n  rmpa {self.what} get /sonar\n")
        @click.argument("resource", required=False)
        @json_option
        @agent_option
        @master_option
        def get(resource: str | None, as_json: bool, agent: str | None, master: str | None) -> None:
            async def body(room: Room) -> None:
                one = room.pick(resource)
                present = await self.present(room, one)
                if as_json:
                    print_json({**whose(one), **present})
                else:
                    click.echo(printable(str(present[self.what])))

            run_around(master, agent, body)

        return get

    def set_command(self, text: str, auto_text: str, example: str) -> click.Command:
        """``set``, with its help, that of its ``--auto``, and a name for an example."""
        examples = f"  rmpa {self.what} set /sonar {example}\n  rmpa {self.what} set base:/sonar --auto\n"

        @click.command("set", help=text, epilog=f"\b\nExamples:\n{examples}")
        @click.argument("resource")
        @click.argument("name", required=False, metavar=f"[{self.what.upper()}]")
        @click.option("--auto", is_flag=True, help=auto_text)
        @json_option
        @agent_option
        @master_option
        def set_(
            resource: str, name: str | None, auto: bool, as_json: bool, agent: str | None, master: str | None
        ) -> None:
            if (name is None) != auto:
                raise ConfigError(self.what.upper(), "say which one, or --auto", "one of both")

            async def body(room: Room) -> None:
                one = room.pick(resource)
                names = list(self.names(one.descriptor))
                if not names:
                    raise ConfigError("RESOURCE", f"{one} has no {self.what}s", "")
                if name is not None:
                    known_name(self.what, name, names)
                await room.configure(one, {self.what: name or ""})
                if as_json:
                    print_json({**whose(one), "chosen": name or ""})

            run_around(master, agent, body)

        return set_


def whose(one: SeenResource) -> dict[str, str | None]:
    """Which resource it is about, for JSON."""
    return {"resource": one.path, "peer": one.peer}
