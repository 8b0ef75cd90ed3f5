"""The commands ``get`` and ``set`` of ``rmpa profile`` and ``rmpa context``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import print_json, print_line
from rmpa.cli.resource_graph import known_name, run_with_resources
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping

    from rmpa.cli.resource_graph import ResourceGraph, SeenResource
    from rmpa.resource.run.descriptor import Descriptor


@dataclass(frozen=True, slots=True)
class ManualChoice:
    """A choice that a resource offers.

    Args:
        what: ``profile`` or ``context``: the word for it, and the parameter that chooses it.
        names: The names to choose from, by the resource's descriptor.
        present: Reads the present one: an object for JSON with the keys ``what`` and ``chosen`` (by hand).
    """

    what: str
    names: Callable[[Descriptor], Iterable[str]]
    present: Callable[[ResourceGraph, SeenResource], Awaitable[Mapping[str, Any]]]

    def get_command(self, text: str) -> click.Command:
        """The command ``get`` with its help text."""

        @click.command("get", help=text, epilog=f"\b\nExamples:\n  rmpa {self.what} get /sonar\n")
        @click.argument("resource", shell_complete=completes("resource"), required=False)
        @graph_options
        def get(resource: str | None, options: GraphOptions) -> None:
            async def body(graph: ResourceGraph) -> None:
                one = graph.pick(resource)
                present = await self.present(graph, one)
                if options.as_json:
                    print_json({**resource_json(one), **present})
                else:
                    print_line(str(present[self.what]))

            run_with_resources(options, body)

        return get

    def set_command(self, text: str, auto_text: str, example: str) -> click.Command:
        """The command ``set`` with its help text, that of ``--auto``, and a name for its examples."""
        examples = f"  rmpa {self.what} set /sonar {example}\n  rmpa {self.what} set base:/sonar --auto\n"

        @click.command("set", help=text, epilog=f"\b\nExamples:\n{examples}")
        @click.argument("resource", shell_complete=completes("resource"))
        @click.argument("name", required=False, metavar=f"[{self.what.upper()}]", shell_complete=completes(self.what))
        @click.option("--auto", is_flag=True, help=auto_text)
        @graph_options
        def set_(resource: str, name: str | None, auto: bool, options: GraphOptions) -> None:
            if (name is None) != auto:
                raise ConfigError(self.what.upper(), "say which one, or --auto", "one of both")

            async def body(graph: ResourceGraph) -> None:
                one = graph.pick(resource)
                names = list(self.names(one.descriptor))
                if not names:
                    raise ConfigError("RESOURCE", f"{one} has no {self.what}s", "")
                if name is not None:
                    known_name(self.what, name, names)
                await graph.configure(one, {self.what: name or ""})
                if options.as_json:
                    print_json({**resource_json(one), "chosen": name or ""})

            run_with_resources(options, body)

        return set_


def resource_json(one: SeenResource) -> dict[str, str | None]:
    """The resource of an answer, for JSON."""
    return {"resource": one.path, "peer": one.peer}
