"""Options and choices that several commands share.

Flags that several commands share.
"""

from __future__ import annotations

import functools
import importlib
import math
import os
import re
import sys
from collections import Counter
from dataclasses import dataclass
from fnmatch import translate
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from rmpa.config.settings import SETTINGS

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Sequence

    from rmpa.cli.output import Graph, Master
    from rmpa.config.schema import Setting

_T = TypeVar("_T")


def completes(kind: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """A function that completes names in a shell, for ``shell_complete`` of an argument or option.

    Args:
        kind: ``peer``, ``agent``, ``topic``, ``service``, ``node``, ``param``, ``resource``, ``profile`` or
            ``context``. Of a peer's own names, ``PEER:/name``, those of that peer are offered.
    """

    def complete(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
        # By its name, as commands are: it asks the agent by the modules of the commands, which import this one.
        found: list[str] = importlib.import_module("rmpa.cli.completion").names(kind, ctx, incomplete)
        return found

    return complete


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON; a stream prints one object a line.")
agent_option = click.option(
    "--agent",
    metavar="NAME",
    shell_complete=completes("agent"),
    help="Which agent of this machine to ask, if several run. [env: RMPA_AGENT]",
)
_master_option = click.option(
    "--master", metavar="URI", help="The ROS master to ask. [default: see rmpa topic --help]"
)


class FiniteRange(click.FloatRange):
    """A number in a range. Unlike click's own type it refuses ``nan``, which lies in every range, and ``inf``."""

    def convert(self, value: float, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Read the number.

        Raises:
            click.BadParameter: It is none, is not finite, or out of range.
        """
        found = super().convert(value, param, ctx)
        if not math.isfinite(found):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return found


@dataclass(frozen=True, slots=True)
class GraphOptions:
    """The values of ``--json``, ``--agent`` and ``--master`` of one command line."""

    as_json: bool
    agent: str | None
    master_uri: str | None

    def master(self) -> Master:
        """The master that is meant.

        Raises:
            RmpaError: As ``choose_master``.
        """
        from rmpa.cli.output import choose_master

        return choose_master(self.master_uri, self.agent, os.environ)

    def graph(self) -> tuple[Master, Graph]:
        """The master that is meant, and its graph.

        Raises:
            RmpaError: As ``choose_master`` and ``read_graph``.
        """
        import asyncio

        from rmpa.cli.output import read_graph

        master = self.master()
        return master, asyncio.run(read_graph(master))


def graph_options(function: Callable[..., _T]) -> Callable[..., _T]:
    """Decorate a command with ``--json``, ``--agent`` and ``--master``: it gets them as its argument ``options``."""

    @functools.wraps(function)
    def command(*, as_json: bool, agent: str | None, master: str | None, **arguments: object) -> _T:
        return function(**arguments, options=GraphOptions(as_json, agent, master))

    return json_option(agent_option(_master_option(command)))


# Options of commands that follow from the declarations of the settings.


config_option = click.option(
    "--config", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]"
)


def setting_options(
    *commands: str, without: Collection[str] = (), defaults: dict[str, str] | None = None
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate a command with an option for each setting that has one, in the order of their declarations.

    Args:
        commands: Those in whose name the settings declare options; the options of the first stand first.
        without: Names of settings whose option is left out.
        defaults: By a setting's name: the default that ``--help`` shows instead of the setting's.
    """
    settings = [s for command in commands for s in SETTINGS if s.option and s.command == command]

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for setting in reversed([setting for setting in settings if setting.name not in without]):
            command = _option(setting, (defaults or {}).get(setting.name))(command)
        return command

    return decorate


def _option(setting: Setting, default: str | None) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    if default is None:
        default = setting.shown_default or ("" if setting.is_switch or setting.is_list else str(setting.default))
    shown = setting.help + (" Repeatable." if setting.is_list else "")
    return click.option(
        setting.option,
        is_flag=setting.is_switch,
        default=None,
        multiple=setting.is_list,
        metavar=None if setting.is_switch else setting.type.metavar,
        help=f"{shown} [default: {default}]" if default else shown,
    )


# What a list shows of very many things: those that the user asks for, the first of them, and what was left out.
#
# On a terminal a long list shows its first lines and says how to see the others. In a pipe, with ``--all`` and as
# JSON
# it is complete.


_R = TypeVar("_R")

LINES: Final = 100
"""Lines of a long list that a terminal shows."""


@dataclass(frozen=True, slots=True)
class Selection:
    """The values of ``--match``, ``--peer``, ``--limit`` and ``--all`` of one command line.

    Args:
        match: Pattern of a shell for the name; empty: every name.
        peer: Pattern for the name of a module; empty: every module, and this one.
        limit: Lines to show at most; ``None``: as many as fit the way of output.
        everything: Whether nothing is left out.
    """

    match: str = ""
    peer: str = ""
    limit: int | None = None
    everything: bool = False

    def names(self, names: Iterable[str]) -> list[str]:
        """Those of the names that match, in order."""
        fits = _matcher(self.match)
        return [name for name in names if fits(name)]

    def with_peers(self, names: Iterable[str], peers: Callable[[str], Iterable[str]]) -> list[str]:
        """Those of the names that match and that a wanted module has; ``peers`` returns the modules of a name."""
        fits = _matcher(self.peer)
        return [name for name in self.names(names) if not self.peer or any(map(fits, peers(name)))]

    def wants_peer(self, peer: str | None) -> bool:
        """Whether what this module has is wanted; ``None``: this agent's own."""
        return not self.peer or (peer is not None and _matcher(self.peer)(peer))

    @property
    def lines(self) -> int | None:
        """How many lines are shown; ``None``: all."""
        if self.everything:
            return None
        if self.limit is not None:
            return self.limit
        return LINES if sys.stdout.isatty() else None

    def shown(self, items: Sequence[_T]) -> Sequence[_T]:
        """The first ones, as many as are shown."""
        return items if self.lines is None else items[: self.lines]

    def is_long(self, items: Sequence[object]) -> bool:
        """Whether some of the items are left out."""
        return self.lines is not None and len(items) > self.lines

    def print_rest(self, items: Sequence[object], what: str, filters: str) -> None:
        """Say what was left out, and how to see it; nothing if all are shown.

        Args:
            items: All of them.
            what: What they are, in the plural.
            filters: Options that select fewer, for the user to try.
        """
        if self.is_long(items):
            left = len(items) - (self.lines or 0)
            click.secho(f"... {left:,} more {what}; fewer: {filters}; all: --all", fg="yellow")


def summary(total: int, what: str, counts: Iterable[str]) -> str:
    """``200 peers: 198 linked, 2 refused``, the most frequent first."""
    parts = [f"{count:,} {word}" for word, count in Counter(counts).most_common()]
    return f"{total:,} {what}: {', '.join(parts)}"


def selection_options(function: Callable[..., _R]) -> Callable[..., _R]:
    """Decorate a list with ``--match``, ``--peer``, ``--limit`` and ``--all``; it gets them as ``selection``."""

    @functools.wraps(function)
    def command(*, match: str, peer: str, limit: int | None, everything: bool, **arguments: object) -> _R:
        return function(**arguments, selection=Selection(match, peer, limit, everything))

    options = [
        click.option("--match", default="", metavar="PATTERN", help="Only names like this: '*/scan', 'arm?'."),
        click.option("--peer", default="", metavar="PATTERN", help="Only of modules with names like this."),
        click.option("--limit", type=click.IntRange(1), help=f"At most so many. [default: {LINES} on a terminal]"),
        click.option("--all", "everything", is_flag=True, help="Leave nothing out on a terminal."),
    ]
    decorated: Callable[..., _R] = command
    for option in reversed(options):
        decorated = option(decorated)
    return decorated


@functools.lru_cache(maxsize=8)
def _matcher(pattern: str) -> Callable[[str], bool]:
    if not pattern:
        return lambda _: True
    compiled = re.compile(translate(pattern))
    return lambda name: compiled.match(name) is not None
