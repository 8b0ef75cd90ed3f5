"""A group of commands, each imported when it is called: ``rmpa --help`` stays quick."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Final

import click

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

REMOVED_VERBS: Final = {
    "experiment": "in a clone of the repository: make experiment, or python -m lab experiment (docs/experiments.md)",
    "multicast": "`rmpa doctor --listen 30` on one machine and `rmpa doctor` on the other try multicast between them",
    "resource history": "record it: rosbag record /SONAR/decision /SONAR/quality /SONAR/alarms",
    "site last": "record the topic with rosbag where it is needed, or keep its key by a storage of Zenoh",
    "trust import": "write [[permission]] tables into rmpa.toml: docs/permissions.md",
}
"""What to use in place of a command that is gone, by its words behind ``rmpa``."""


class PipeClosed(Exception):  # noqa: N818 - not an error: the program that reads our output has closed the pipe
    """Standard output was closed; click would turn the BrokenPipeError into an exit of its own."""


class LazyGroup(click.Group):
    """A click group whose commands are imported on use.

    Click shows a command's help line by importing it, and suggests the nearest command only since 8.4; this class
    does both from the table alone.

    Args:
        commands_at: By name: the module, which has the command under that name (or with ``_`` behind it, where the
            name is a builtin's), and the line that the group's help shows.
        meant: By a word that is no command: what a user who writes it wants, a command line without the program.
        arguments: For ``click.Group``.
    """

    def __init__(
        self,
        *,
        commands_at: Mapping[str, tuple[str, str]],
        meant: Mapping[str, Sequence[str]] | None = None,
        **arguments: object,
    ) -> None:
        super().__init__(**arguments)  # type: ignore[arg-type] # handed through as they came
        self.commands_at = commands_at
        self.meant = meant or {}

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """The names, in the order of the table."""
        return list(self.commands_at)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - click's signature
        """Import one command, or ``None``."""
        if cmd_name not in self.commands_at:
            return None
        module = importlib.import_module(self.commands_at[cmd_name][0])
        command = getattr(module, cmd_name.replace("-", "_"), None)
        if not isinstance(command, click.Command):
            command = getattr(module, f"{cmd_name}_")
        assert isinstance(command, click.Command)  # noqa: S101 - a mistake in our own table
        return command

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the group's own options; for one of a command the error says where it stands.

        Raises:
            click.NoSuchOption: The group has no such option.
        """
        words = [*args]
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            path = [ctx.command_path]
            found: click.Command = self
            for word in words:
                if isinstance(found, LazyGroup) and word in found.commands_at:
                    path.append(word)
                    found = found.get_command(ctx, word) or found
            if any(error.option_name in each.opts for each in found.params):
                ctx.fail(f"{error.option_name} stands behind the command: {' '.join(path)} {error.option_name}")
            raise

    def invoke(self, ctx: click.Context) -> object:
        """Run the command.

        Raises:
            PipeClosed: Standard output was closed by its reader.
        """
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            raise PipeClosed from error

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find a command; for a misspelt one the error names the nearest."""
        if args:
            words = " ".join((*ctx.command_path.split()[1:], args[0]))
            if remedy := REMOVED_VERBS.get(words):
                raise ConfigError(f"rmpa {words}", "is not a command any more", remedy)
        if args and args[0] not in self.commands_at and not args[0].startswith("-"):
            near = did_you_mean(args[0], self.commands_at)
            others = self.meant.get(args[0]) or ([near] if near else [])
            named = " or ".join(f"`{ctx.command_path} {other}`" for other in others)
            hint = f"Did you mean {named}?" if others else f"There are {', '.join(self.commands_at)}."
            ctx.fail(f"No such command {args[0]!r}. {hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's
        """Write the table's lines, without importing anything."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in self.commands_at.items()])
