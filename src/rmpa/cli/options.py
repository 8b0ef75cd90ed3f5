"""How a verb is declared: its own arguments, what a shell completes of them, and the options that verbs share."""

from __future__ import annotations

import functools
import itertools
import math
import os
import sys
import time
from collections import Counter
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

import click

from rmpa.cli.main import decorated, verb
from rmpa.config.settings import SETTINGS
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

    from rmpa.cli.graph import Graph, GraphName, Master
    from rmpa.cli.output import Text
    from rmpa.config.schema import Setting
    from rmpa.observe.control_client import ControlClient

_T = TypeVar("_T")
_Function = TypeVar("_Function", bound="Callable[..., Any]")
# Lines of a long list that a terminal shows.
LINES: Final = 100
# Finds names, for the command line so far and the begun word.
Find: TypeAlias = "Callable[[click.Context, str], Iterable[str]]"
# Seconds that the agent or master has for its answer: a person waits with the key pressed.
ANSWER: Final = 0.3


def completes(find: Find, *modules: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """A function for ``shell_complete`` of an argument or option: the names that begin as a user began to write.

    There are none where no agent or master answers in time.

    Args:
        find: Finds the names.
        modules: What it imports: the time that this takes is not the agent's.
    """

    def complete(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
        import contextlib
        import importlib
        import threading

        found: set[str] = set()

        def ask() -> None:
            with contextlib.suppress(RmpaError, OSError, ValueError):
                found.update(name for name in find(ctx, incomplete) if name.startswith(incomplete))

        for module in ("asyncio", "rmpa.cli.graph", "rmpa.ros.http.rpc", *modules):
            importlib.import_module(module)
        # In a thread, which the end of the program ends: an agent that hangs must not hold up the shell.
        asked = threading.Thread(target=ask, daemon=True)
        asked.start()
        asked.join(ANSWER)
        return sorted(found)

    return complete


def options_of(ctx: click.Context) -> Options:
    """The shared options of a command line so far."""
    return Options(as_json=False, agent=ctx.params.get("agent"), master_uri=ctx.params.get("master"))


def graph_of(ctx: click.Context) -> Graph:
    """The graph of the master that a command line means."""
    return options_of(ctx).graph()[1]


def of_peer(name: str, node: str) -> str:
    """A name as a user writes it: ``PEER:/name`` if the node that offers it is a peer's proxy."""
    from rmpa.core.identity import proxied_peer

    peer = proxied_peer(node)
    return name if peer is None else f"{peer}:{name}"


def _with_peers(found: dict[str, list[str]], incomplete: str) -> Iterable[str]:
    """Names, of this module and of its peers; ``PEER:/name`` too, unless a name without peer has been begun."""
    for name, nodes in found.items():
        yield name
        if not incomplete.startswith("/"):
            yield from (of_peer(name, node) for node in nodes)


def agents(_: click.Context, __: str) -> Iterable[str]:
    """Agents of this machine."""
    from rmpa.observe.control_client import find_agents

    return [agent.name for agent in find_agents(os.environ)]


def peers(ctx: click.Context, _: str) -> Iterable[str]:
    """Modules that the agent knows."""
    with options_of(ctx).client(ANSWER) as client:
        return [peer.name for peer in client.snapshot(topics=()).peers]


def topics(ctx: click.Context, incomplete: str) -> Iterable[str]:
    """Topics of the graph."""
    graph = graph_of(ctx)
    return _with_peers(graph.subscribers | graph.publishers, incomplete)


def services(ctx: click.Context, incomplete: str) -> Iterable[str]:
    """Services of the graph."""
    return _with_peers(graph_of(ctx).services, incomplete)


def nodes(ctx: click.Context, _: str) -> Iterable[str]:
    """Nodes of the graph."""
    from rmpa.core.identity import proxied_node

    for node in graph_of(ctx).nodes:
        proxy = proxied_node(node)
        yield node if proxy is None else of_peer(proxy[1], node)


def json_verb(*parameters: Callable[..., Any], **settings: Any) -> Callable[[Callable[..., Any]], click.Command]:
    """A ``verb`` with ``--json`` behind its own parameters, as its argument ``options``."""
    return verb(*parameters, _as_options(json_option), **settings)


def agent_verb(*parameters: Callable[..., Any], **settings: Any) -> Callable[[Callable[..., Any]], click.Command]:
    """A ``json_verb`` with ``--agent`` too."""
    return verb(*parameters, _as_options(json_option, agent_option), **settings)


def graph_verb(*parameters: Callable[..., Any], **settings: Any) -> Callable[[Callable[..., Any]], click.Command]:
    """An ``agent_verb`` with ``--master`` too."""
    return verb(*parameters, _as_options(json_option, agent_option, _master_option), **settings)


def argument(name: str, find: Find | None = None, **settings: Any) -> Callable[[_Function], _Function]:
    """An argument that a shell completes with the names that are found, as ``completes`` does."""
    return click.argument(name, shell_complete=completes(find) if find else None, **settings)


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


def option(
    names: str,
    metavar: str = "",
    help: str = "",  # noqa: A002 - click's name
    *,
    find: Find | None = None,
    **settings: Any,
) -> Callable[[_Function], _Function]:
    """An option with a value.

    Args:
        names: As click has them, ``-n --count``, and the name of the function's argument if it is another one.
        metavar: What stands for the value; empty: the name of its type.
        help: The line of ``--help``.
        find: As for ``argument``.
        settings: For ``click.option``.
    """
    complete = completes(find) if find else None
    return click.option(*names.split(), metavar=metavar or None, help=help, shell_complete=complete, **settings)


def flag(names: str, help: str) -> Callable[[_Function], _Function]:  # noqa: A002 - click's name
    """An option that is given or not; ``names`` as for ``option``."""
    return click.option(*names.split(), is_flag=True, help=help)


json_option = flag("--json as_json", "Print JSON; a stream prints one object a line.")
agent_option = option(
    "--agent", "NAME", "Which agent of this machine to ask, if several run. [env: RMPA_AGENT]", find=agents
)
_master_option = option("--master", "URI", "The ROS master to ask. [default: see rmpa topic --help]")
config_option = option("--config", "FILE", "Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")


def output_option(help: str, metavar: str = "FILE", *, required: bool = False) -> Callable[[_Function], _Function]:  # noqa: A002 - click's name
    """``--output``: where something is written."""
    type_ = click.Path(path_type=Path)
    return option("-o --output", metavar, help, type=type_, required=required)


def count_option(what: str) -> Callable[[_Function], _Function]:
    """``--count``: the end of a stream."""
    return option("-n --count", help=f"Stop after so many {what}.", type=click.IntRange(1))


def ping_options(function: _Function) -> _Function:
    """Decorate with ``--count`` and ``--interval`` of a ping."""
    seconds = FiniteRange(0.01)
    every = option("-i --interval", help="Seconds between.", type=seconds, default=1.0, show_default=True)
    count = option("-c --count", help="Stop after so many. [default: at Ctrl-C]", type=click.IntRange(1))
    return count(every(function))


def pings(count: int | None, interval: float) -> Iterator[int]:
    """The numbers of pings, so many seconds apart; ``count``: as many as that, else without an end."""
    for number in itertools.count(1) if count is None else range(1, count + 1):
        if number > 1:
            time.sleep(interval)
        yield number


@dataclass(frozen=True, slots=True)
class Options:
    """The values of ``--json``, ``--agent`` and ``--master`` of one command line."""

    as_json: bool
    agent: str | None = None
    master_uri: str | None = None

    def show(self, value: object, *text: Text) -> None:
        """Print a result, for programs or for people.

        Args:
            value: For JSON.
            text: The same for people; an iterator is read only if it is shown.
        """
        from rmpa.cli.output import print_json, print_text

        if self.as_json:
            print_json(value)
        else:
            print_text(*text)

    def client(self, timeout: float | None = None) -> ControlClient:
        """A connection to the agent that is meant.

        Raises:
            RmpaError: As ``choose_agent``.
        """
        from rmpa.observe.control_client import ControlClient, choose_agent
        from rmpa.observe.limits import CONTROL_CALL_TIMEOUT

        return ControlClient(choose_agent(os.environ, self.agent).path, timeout or CONTROL_CALL_TIMEOUT)

    def master(self) -> Master:
        """The master that is meant.

        Raises:
            RmpaError: As ``choose_master``.
        """
        from rmpa.cli.graph import choose_master

        return choose_master(self.master_uri, self.agent, os.environ)

    def graph(self, wanted: GraphName | None = None) -> tuple[Master, Graph]:
        """The master that is meant, and its graph.

        Args:
            wanted: A name whose peer, if it has one, has to be known.

        Raises:
            RmpaError: As ``choose_master``, ``Master.graph`` and ``Master.require_peer``.
        """
        import asyncio

        master = self.master()
        graph = asyncio.run(master.graph())
        if wanted is not None:
            master.require_peer(graph, wanted)
        return master, graph


def _as_options(*declared: Callable[..., Any]) -> Callable[[Callable[..., _T]], Callable[..., _T]]:
    """Decorate with options whose values a command gets as its argument ``options``."""

    def decorate(function: Callable[..., _T]) -> Callable[..., _T]:
        @functools.wraps(function)
        def command(*, as_json: bool, agent: str | None = None, master: str | None = None, **arguments: object) -> _T:
            return function(**arguments, options=Options(as_json, agent, master))

        return decorated(command, declared)

    return decorate


def setting_options(
    *commands: str, without: Collection[str] = (), defaults: dict[str, str] | None = None
) -> Callable[[_Function], _Function]:
    """Decorate a command with an option for each setting that has one, in the order of their declarations.

    Args:
        commands: Those in whose name the settings declare options; the options of the first stand first.
        without: Names of settings whose option is left out.
        defaults: By a setting's name: the default that ``--help`` shows instead of the setting's.
    """
    settings = [s for command in commands for s in SETTINGS if s.option and s.command == command]

    def decorate(command: _Function) -> _Function:
        wanted = [setting for setting in settings if setting.name not in without]
        return decorated(command, [_setting_option(each, (defaults or {}).get(each.name)) for each in wanted])

    return decorate


def _setting_option(setting: Setting, default: str | None) -> Callable[[_Function], _Function]:
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


@dataclass(frozen=True, slots=True)
class Selection:
    """What a list shows of very many things: the values of ``--match``, ``--peer``, ``--limit`` and ``--all``.

    On a terminal a long list shows its first lines and says how to see the others. In a pipe, with ``--all`` and as
    JSON it is complete.

    Args:
        match: Pattern of a shell for the name; empty: every name.
        peer: Pattern for the name of a module; empty: every module, and this one.
        limit: Lines to show at most; ``None``: as many as fit the way of output.
        everything: Whether nothing is left out, as in JSON.
    """

    match: str = ""
    peer: str = ""
    limit: int | None = None
    everything: bool = False

    def wants(self, name: str, peers: Iterable[str | None]) -> bool:
        """Whether a name is selected that these modules have; ``None``: this one."""
        return fnmatchcase(name, self.match or "*") and (
            not self.peer or any(peer is not None and fnmatchcase(peer, self.peer) for peer in peers)
        )

    @property
    def lines(self) -> int | None:
        """How many lines are shown; ``None``: all."""
        if self.everything:
            return None
        return self.limit or (LINES if sys.stdout.isatty() else None)

    def is_long(self, items: Collection[object]) -> bool:
        """Whether some of the items are left out."""
        return self.lines is not None and len(items) > self.lines

    def first(self, items: Sequence[_T], order: Callable[[_T], Any]) -> Sequence[_T]:
        """Those that are shown: all as they are; of a long list the first ones in an order."""
        return sorted(items, key=order)[: self.lines] if self.is_long(items) else items

    def framed(self, items: Collection[object], what: str, about: Text, filters: str, shown: Text) -> Text:
        """The text of a list; a long one has words in front, and behind it how to see what was left out.

        Args:
            items: All of them.
            what: What they are, in the plural.
            about: The words in front of a long one.
            filters: Options that select fewer, for the user to try.
            shown: The text of those that are shown.
        """
        left = len(items) - (self.lines or 0)
        rest = f"... {left:,} more {what}; fewer: {filters}; all: --all"
        return (about, "", shown, rest) if self.is_long(items) else shown


def by_module(what: str, remote: Collection[bool]) -> str:
    """A ``summary`` of what is of other modules, and of this one."""
    return summary(len(remote), what, ("remote" if each else "of this module" for each in remote))


def summary(total: int, what: str, counts: Iterable[str]) -> str:
    """``200 peers: 198 linked, 2 refused``, the most frequent first."""
    parts = [f"{count:,} {word}" for word, count in Counter(counts).most_common()]
    return f"{total:,} {what}: {', '.join(parts)}"


limit_options: Final = (
    option("--limit", help=f"At most so many. [default: {LINES} on a terminal]", type=click.IntRange(1)),
    flag("--all everything", "Leave nothing out on a terminal."),
)


def selection_options(function: Callable[..., _T]) -> Callable[..., _T]:
    """Decorate a list with ``--match``, ``--peer``, ``--limit`` and ``--all``; it gets them as ``selection``."""

    @functools.wraps(function)
    def command(
        *, match: str, peer: str, limit: int | None, everything: bool, as_json: bool, **arguments: object
    ) -> _T:
        selection = Selection(match, peer, limit, everything or as_json)
        return function(**arguments, as_json=as_json, selection=selection)

    match_option = option("--match", "PATTERN", "Only names like this: '*/scan', 'arm?'.", default="")
    peer_option = option("--peer", "PATTERN", "Only of modules with names like this.", default="")
    return decorated(command, (match_option, peer_option, *limit_options))
