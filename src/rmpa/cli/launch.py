"""``rmpa resource start``, ``stop``, ``restart`` and ``log``; ``rmpa top``: what runs in all modules."""

from __future__ import annotations

import contextlib
import sys
import time
from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from rmpa.bridge.launched import ModuleResources
from rmpa.bridge.limits import LAUNCH_LOG_LINES
from rmpa.cli.graph import suggestion
from rmpa.cli.options import ANSWER, FiniteRange, Options, agent_verb, argument, flag, options_of, peers
from rmpa.cli.output import Painted, Table, paint, print_json, print_text, printable, size, warn
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.observe.limits import CONTROL_HANDLER_TIMEOUT
from rmpa.ros.environment import NodeCost

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from rmpa.bridge.launched import LaunchedResource
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
    flag("-f", "--follow", help="Go on to print lines as they come, until Ctrl-C."),
    click.option(
        "-n",
        "--lines",
        type=click.IntRange(1, LAUNCH_LOG_LINES),
        help=f"At most so many of each log, the newest. [default: {_LINES}, with -f {_BEFORE}]",
    ),
    click.option("--node", default="", metavar="NODE", help="Only of this node of the resource: its declared name."),
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
                if not node or log.source == node:
                    _print_log(log.source, log.lines, options)
            if not follow:
                return
            sys.stdout.flush()
            time.sleep(_LOOK)


def _print_log(source: str, lines: Iterable[str], options: Options) -> None:
    for line in lines:
        if options.as_json:
            print_json({"node": source or None, "text": line})
        else:
            print_text(f"{source}: {line}" if source else line)


@agent_verb(
    argument("modules", peers, nargs=-1, metavar="[MODULE]..."),
    flag("--once", help="Show it once; in a pipe and as JSON that is always so."),
    click.option("-i", "--interval", type=FiniteRange(0.5), default=2.0, show_default=True, help="Seconds between."),
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
            told = client.call("top", dict[str, Any], modules=list(modules))
            rates = client.call("rates", dict[str, Any])
            seen = {name: value if isinstance(value, str) else _costs(value) for name, value in told.items()}
            if options.as_json:
                print_json({"modules": [*_as_json(seen, rates)]})
            else:
                if live:
                    click.echo(_CLEAR, nl=False)
                _print_top(seen, rates)
            for name in (missing := [name for name in modules if isinstance(seen.get(name, ""), str)]):
                warn(f"{name}: {seen.get(name) or 'no linked module has this name'}", "peer-unlinked")
            if not live:
                return int(bool(missing))
            time.sleep(interval)
    return 0


def _costs(value: object) -> tuple[NodeCost, ...]:
    return msgspec.convert(value, tuple[NodeCost, ...])


def _busiest(rates: object) -> list[dict[str, Any]]:
    """The topics of a module with the most bytes a second."""
    rows = [row for row in rates if row[2]] if isinstance(rates, list) else []
    rows.sort(key=lambda row: -row[2])
    return [{"topic": row[0], "rate": row[1], "bandwidth": row[2]} for row in rows[:_TOPICS]]


def _as_json(seen: Mapping[str, str | tuple[NodeCost, ...]], rates: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for name, nodes in seen.items():
        problem = nodes if isinstance(nodes, str) else None
        listed = [] if isinstance(nodes, str) else msgspec.to_builtins(nodes)
        yield {"module": name, "problem": problem, "nodes": listed, "topics": _busiest(rates.get(name))}


def _print_top(seen: Mapping[str, str | tuple[NodeCost, ...]], rates: Mapping[str, Any]) -> None:
    rows = []
    for name, nodes in seen.items():
        if isinstance(nodes, str):
            warn(f"{name}: {nodes}", "peer-unlinked")
            continue
        for one in sorted(nodes, key=lambda each: (-each.cpu, each.node)):
            if one.pid is None:
                cells = ["-"] * 5
            else:
                cells = [str(one.pid), _percent(one.cpu), size(one.rss), str(one.threads), _age(one.since)]
            rows.append([f"{name}:{one.node}", *cells, one.started_by])
    print_text(Table("NODE, >PROCESS, >CPU, >MEMORY, >THREADS, >RUNS, RESOURCE", rows))
    busy = [(name, row) for name in seen for row in _busiest(rates.get(name))]
    shown = [[f"{name}:{row['topic']}", f"{row['rate']:.1f} Hz", f"{size(row['bandwidth'])}/s"] for name, row in busy]
    if shown:
        print_text("", Table("TOPIC, >RATE, >BANDWIDTH", shown))


def _age(since: float) -> str:
    seconds = max(time.time() - since, 0.0)
    for unit, length in (("d", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"
