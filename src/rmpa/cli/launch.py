"""``rmpa resource start``, ``stop``, ``restart`` and ``log``; ``rmpa top``: what runs in all modules."""

from __future__ import annotations

import contextlib
import sys
import time
from typing import TYPE_CHECKING, Any, Final, Self

import click
import msgspec

from rmpa.bridge.launched import LaunchedResource, ModuleResources
from rmpa.bridge.limits import LAUNCH_LOG_LINES
from rmpa.cli.graph import suggestion
from rmpa.cli.options import ANSWER, FiniteRange, Options, agent_verb, argument, flag, option, options_of, peers
from rmpa.cli.output import Painted, Table, paint, print_json, print_text, printable, size, warn
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.observe.limits import CONTROL_HANDLER_TIMEOUT
from rmpa.ros.environment import NodeCost

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rmpa.observe.control_client import ControlClient

# Lines of each log that are shown, alone and before those that are followed.
_LINES: Final = 50
_BEFORE: Final = 10
# Seconds between two questions while a log is followed.
_LOOK: Final = 0.5
# Topics that ``rmpa top`` shows of each module: those with the most bytes.
_TOPICS: Final = 5
# Seconds over which their rates are measured for one answer.
_MEASURED: Final = 1.0
_COLOURS: Final = {"active": "green", "failed": "red", "refused": "red", "stopped": "bright_black"}
_CLEAR: Final = "\x1b[H\x1b[2J"


def _launchable(ctx: click.Context, _: str) -> Iterable[str]:
    """What can be started, for a shell's completion."""
    with options_of(ctx).client(ANSWER) as client:
        own = client.agent().name
        for module in client.call("launch", tuple[ModuleResources, ...], what="list"):
            for each in module.resources:
                yield f"{module.module}:{each.name}"
                if module.module == own:
                    yield each.name


def _read_name(text: str) -> tuple[str | None, str]:
    """``[MODULE:]NAME``; a name may be written as its node, ``/camera``.

    Raises:
        ConfigError: It is none.
    """
    module, _, name = text.rpartition(":")
    name = name.removeprefix("/").removesuffix(".resource.toml").removesuffix(".py")
    if not name or "/" in name:
        problem = f"{text!r} is not the name of a resource"
        raise ConfigError("RESOURCE", problem, "one is camera or arm:camera: its file's name, in the module's folder")
    return module or None, name


def _ask(client: ControlClient, what: str, text: str, **more: object) -> ModuleResources:
    """Ask the module of a resource.

    Raises:
        RmpaError: It does not answer, refuses, or cannot do it.
    """
    module, name = _read_name(text)
    args = {key: value for key, value in more.items() if value is not None} | ({"module": module} if module else {})
    (found,) = client.call("launch", tuple[ModuleResources, ...], what=what, name=name, **args)
    if found.problem:
        hint = "; a [[permission]] there may allow it: launch" if found.code == "not-permitted" else ""
        raise RmpaError(f"{found.module}: {found.problem}{hint}", code=found.code)
    return found


def _act(what: str, resource: str, options: Options) -> int:
    with options.client(CONTROL_HANDLER_TIMEOUT) as client:
        found = _ask(client, what, resource)
    (one,) = found.resources
    about = {"module": found.module, **msgspec.to_builtins(one)}
    options.show(about, *map(Painted, _lines(found.module, one)))
    return int(one.state in ("failed", "refused"))


def _lines(module: str, one: LaunchedResource) -> Iterator[str]:
    """A resource as text, with its nodes."""
    state = paint(one.state, _COLOURS.get(one.state, "yellow"))
    process = f", process {one.pid}" if one.pid is not None else ""
    yield f"{printable(f'{module}:{one.name}')} is {state}{process}" + (f": {printable(one.why)}" if one.why else "")
    for node in one.processes if one.pid is not None else ():
        cost = f"process {node.pid}, {_percent(node.cpu)}, {size(node.rss)}" if node.pid is not None else node.why
        yield printable(f"  {node.node} is {node.state}" + (f": {cost}" if cost else ""))
    if one.state == "starting":
        yield f"it takes longer: rmpa resource log {printable(f'{module}:{one.name}')}"


def _percent(cpu: float) -> str:
    return f"{100 * cpu:.0f} %"


@agent_verb(argument("resource", _launchable, metavar="[MODULE:]RESOURCE"))
def resource_start(resource: str, options: Options) -> int:
    """Start a resource whose file is in the folder of its module; one that runs goes on.

    The folder is that of [resources] in the module's rmpa.toml. Other modules start it if a [[permission]] there
    allows launch. Returns when it is active; exits 1 if it does not start.

    ---

    Examples:
      rmpa resource start camera           camera.resource.toml, or camera.py, of this module
      rmpa resource start base:laser       of the module base
      rmpa resource list                   what can be started
    """
    return _act("start", resource, options)


@agent_verb(argument("resource", _launchable, metavar="[MODULE:]RESOURCE"))
def resource_stop(resource: str, options: Options) -> int:
    """End a resource, with the nodes that it has started; those that it has found running go on.

    ---

    Examples:
      rmpa resource stop camera
      rmpa resource stop base:laser
    """
    return _act("stop", resource, options)


@agent_verb(argument("resource", _launchable, metavar="[MODULE:]RESOURCE"))
def resource_restart(resource: str, options: Options) -> int:
    """End a resource and start it again, with its file as it is now.

    ---

    Examples:
      rmpa resource restart camera
      rmpa resource restart base:laser --json
    """
    return _act("restart", resource, options)


@agent_verb(
    argument("resource", _launchable, metavar="[MODULE:]RESOURCE"),
    flag("-f --follow", "Go on to print lines as they come, until Ctrl-C."),
    option(
        "-n --lines",
        help=f"At most so many of each log, the newest. [default: {_LINES}, with -f {_BEFORE}]",
        type=click.IntRange(1, LAUNCH_LOG_LINES),
    ),
    option("--node", "NODE", "Only of this node of the resource: its declared name.", default=""),
)
def resource_log(resource: str, follow: bool, lines: int | None, node: str, options: Options) -> None:
    """Show what a resource and the nodes that it has started have written, kept on their own machine.

    A line of a node has the node's declared name in front.

    ---

    Examples:
      rmpa resource log camera
      rmpa resource log base:laser -f
      rmpa resource log camera --node driver -n 200
    """
    after: dict[str, int] = {}
    with options.client(CONTROL_HANDLER_TIMEOUT) as client, contextlib.suppress(KeyboardInterrupt):
        while True:
            most = LAUNCH_LOG_LINES if after else lines or (_BEFORE if follow else _LINES)
            found = _ask(client, "log", resource, lines=most, after=after or None)
            known = [each.source for each in found.logs if each.source]
            if node and node not in known:
                hint = suggestion(node, known, f"there are {', '.join(known) or 'none'}")
                raise RmpaError(f"{resource} has no log of a node {node}; {hint}", code="unknown-name")
            for log in found.logs:
                after[log.source] = log.next
                for line in log.lines if not node or log.source == node else ():
                    if options.as_json:
                        print_json({"node": log.source or None, "text": line})
                    else:
                        print_text(f"{log.source}: {line}" if log.source else line)
            if not follow:
                return
            sys.stdout.flush()
            time.sleep(_LOOK)


@agent_verb(
    argument("modules", peers, nargs=-1, metavar="[MODULE]..."),
    flag("--once", "Show it once; in a pipe and as JSON that is always so."),
    option("-i --interval", help="Seconds between.", type=FiniteRange(0.5), default=2.0, show_default=True),
)
def top(modules: tuple[str, ...], once: bool, interval: float, options: Options) -> int:
    """Show the processes and topics of all modules at a glance, or of each MODULE: CPU, memory, threads, rates.

    Of each node its process, the share of one core that it uses, its memory and threads, how long it runs, and the
    resource that has started it. Of topics those with the most bytes a second. Until Ctrl-C. Exits 1 if a MODULE does
    not answer.

    ---

    Examples:
      rmpa top
      rmpa top base arm --once
      rmpa top --json | jq -r '.modules[].nodes[] | select(.cpu > 0.5) | .node'
    """
    live = sys.stdout.isatty() and not (once or options.as_json)
    with options.client(CONTROL_HANDLER_TIMEOUT) as client, contextlib.suppress(KeyboardInterrupt):
        if not live:  # topics are measured from the first request on
            client.call("rates", dict[str, Any])
            time.sleep(_MEASURED)
        while True:
            told = client.call("top", dict[str, str | tuple[NodeCost, ...]], modules=list(modules))
            rates = client.call("rates", dict[str, Any])
            seen = [ModuleLoad.of(name, nodes, rates.get(name)) for name, nodes in told.items()]
            if options.as_json:
                print_json({"modules": seen})
            else:
                if live:
                    click.echo(_CLEAR, nl=False)
                _print_top(seen)
            well = {one.module for one in seen if one.problem is None}
            for name in (missing := [name for name in modules if name not in well]):
                problem = next((one.problem for one in seen if one.module == name), None)
                warn(f"{name}: {problem or 'no linked module has this name'}", "peer-unlinked")
            if not live:
                return int(bool(missing))
            time.sleep(interval)
    return 0


class ModuleLoad(msgspec.Struct, frozen=True):
    """What the nodes of a module cost, and its topics with the most bytes a second.

    Attributes:
        module: Its name.
        problem: Why it does not tell; ``None``: it does.
        nodes: Its nodes.
        topics: The topics: ``topic``, ``rate`` and ``bandwidth``.
    """

    module: str
    problem: str | None
    nodes: tuple[NodeCost, ...]
    topics: list[dict[str, Any]]

    @classmethod
    def of(cls, module: str, nodes: str | tuple[NodeCost, ...], rates: object) -> Self:
        """From what the operations ``top`` and ``rates`` tell of a module: a text where it does not."""
        rows = [row for row in rates if row[2]] if isinstance(rates, list) else []
        rows.sort(key=lambda row: -row[2])
        topics = [dict(zip(("topic", "rate", "bandwidth"), row, strict=False)) for row in rows[:_TOPICS]]
        return cls(module, nodes, (), topics) if isinstance(nodes, str) else cls(module, None, nodes, topics)


def _print_top(seen: Sequence[ModuleLoad]) -> None:
    rows, topics = [], []
    for module in seen:
        if module.problem is not None:
            warn(f"{module.module}: {module.problem}", "peer-unlinked")
        for one in sorted(module.nodes, key=lambda each: (-each.cpu, each.node)):
            cells = ["-"] * 5
            if one.pid is not None:
                cells = [str(one.pid), _percent(one.cpu), size(one.rss), str(one.threads), _age(one.since)]
            rows.append([f"{module.module}:{one.node}", *cells, one.started_by])
        for row in module.topics:
            name, bandwidth = f"{module.module}:{row['topic']}", f"{size(row['bandwidth'])}/s"
            topics.append([name, f"{row['rate']:.1f} Hz", bandwidth])
    print_text(Table("NODE, >PROCESS, >CPU, >MEMORY, >THREADS, >RUNS, RESOURCE", rows))
    if topics:
        print_text("", Table("TOPIC, >RATE, >BANDWIDTH", topics))


def _age(since: float) -> str:
    seconds = max(time.time() - since, 0.0)
    for unit, length in (("d", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"
