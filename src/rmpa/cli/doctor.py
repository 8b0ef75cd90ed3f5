"""``rmpa doctor``: checks this machine for what would keep modules apart."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import time
from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.bridge.proxies import proxied_peer
from rmpa.cli.options import (
    FiniteRange,
    GraphOptions,
    agent_option,
    completes,
    graph_options,
    json_option,
    run_stream,
    with_node,
)
from rmpa.cli.output import (
    LEVEL_COLOURS,
    Column,
    GraphName,
    print_json,
    print_line,
    print_table,
    printable,
    read_graph,
    read_name,
    warn,
)
from rmpa.cli.resource import run_with_resources, with_resources
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.observe import limits
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.observe.peer_info import FAIL, OK, WARN, CheckLevel, exit_code
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.resource.run.descriptor import TOPIC
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.cli.output import Master
    from rmpa.cli.resource import ResourceGraph, SeenResource
    from rmpa.observe.peer_info import Check
    from rmpa.ros.node.endpoints import Received
    from rmpa.ros.node.node import Node

EPILOG = """\
\b
Exit codes: 0 nothing fails (there may be warnings); 1 something does.

\b
Examples:
  rmpa doctor
  sudo rmpa doctor                reads the firewall's rules too
  rmpa doctor --listen 30         and `rmpa doctor` on another machine: do multicasts get through?
  rmpa doctor --json | jq '.[] | select(.level == "fail")'
"""


@click.command(epilog=EPILOG)
@click.option("--config", metavar="FILE", help="Settings. [default: ./rmpa.toml, ~/.config/rmpa, /etc/rmpa]")
@click.option("-q", "--quiet", is_flag=True, help="Only what fails, or may.")
@click.option("--listen", metavar="SECONDS", type=FiniteRange(1.0), help="Wait for multicasts of other machines.")
@json_option
def doctor(config: str | None, quiet: bool, listen: float | None, as_json: bool) -> int:
    """Check this machine: settings, agents, network, ROS environment, clock and rights.

    It changes nothing. It sends one packet on each interface to the agents' multicast group, which agents ignore, and
    checks that it comes back. To see whether a switch or a firewall in between drops it, run it with --listen on one
    machine and meanwhile without on the other, then the other way round.
    """
    from rmpa.observe.doctor.checks import examine, look_at

    found, shown = [], []
    for check in examine(look_at(os.environ, config, listen or 0.0)):
        found.append(check)
        if not quiet or check.level in (WARN, FAIL):
            shown.append(check)
            if not as_json:
                click.echo("\n".join(_lines(check)))
    if as_json:
        print_json([*map(_json, shown)])
    else:
        click.echo(_summary(found))
    return exit_code(found)


def _json(check: Check) -> dict[str, str]:
    keys = {"check": check.name, "subject": check.where, "level": check.level, "text": check.text}
    return keys | ({"remedy": check.remedy} if check.remedy else {})


def _lines(check: Check) -> list[str]:
    mark = click.style(f"{check.level.value:<7}", fg=LEVEL_COLOURS[check.level])
    what = f"{check.name} {check.where}".strip()
    lines = [f"{mark}  {printable(what)}: {printable(check.text)}"]
    if check.remedy:
        lines.append(f"{'':<9}{printable(check.remedy)}")
    return lines


def _summary(found: Sequence[Check]) -> str:
    counts = Counter(check.level for check in found)
    words = [f"{counts[level]} {level.value}" for level in CheckLevel if counts[level]]
    return f"{len(found)} answers: {', '.join(words)}"


# ``rmpa why``: the stage at which a topic of a peer, or a service, stops.


WHY_EPILOG = """\
\b
Exit codes: 0 it flows, on every way if there are several, or no node subscribes and nothing is in its way;
1 it does not flow, and the first stage that fails says why.

\b
Examples:
  rmpa why joystick:/cmd          why /cmd of joystick does not come here
  rmpa why /odom                  every way of /odom, in and out
  rmpa why arm:/move              why the service /move of arm cannot be called here
  rmpa why --module arm           why the module arm is not linked, or slow
  rmpa why joystick:/cmd --json | jq '.[].stages[-1]'
"""

_WELL: Final = {"service": "it can be called", "module": "it is linked"}
"""What is said of a thing by its kind when no stage fails."""


@click.command(epilog=WHY_EPILOG)
@click.argument("name", metavar="[PEER:]NAME", shell_complete=completes("topic"))
@click.option("-s", "--service", is_flag=True, help="A service is meant, though a topic has that name.")
@click.option("-m", "--module", is_flag=True, help="NAME is a module: its link is checked.")
@json_option
@agent_option
def why(name: str, service: bool, module: bool, as_json: bool, agent: str | None) -> int:
    """Say why a topic of a peer does not arrive here, a service cannot be called, or a module is not linked.

    Both agents are asked, stage by stage from the publisher to the reader; messages are watched for a second, and
    a service's server is probed.
    PEER is a name or a GUID. Without PEER every module that publishes the topic is checked, and for one of this
    module's own topics every peer says how it arrives there.
    """
    if module:
        args: dict[str, object] = {"module": name}
    else:
        wanted = read_name(name)
        args = {"name": wanted.name, "peer": wanted.peer, "service": service}
    with ControlClient(choose_agent(os.environ, agent).path, timeout=limits.CONTROL_HANDLER_TIMEOUT) as client:
        if not module and any(peer.name == name for peer in client.snapshot(topics=()).peers):
            raise ConfigError("NAME", f"{name} is a module", f"`rmpa why --module {name}` says how it is linked")
        found = client.call("why", tuple[Diagnosis, ...], **args)
    if as_json:
        print_json(found)
    else:
        for number, diagnosis in enumerate(found):
            if number:
                click.echo()
            for line in _stage_lines(diagnosis):
                click.echo(line)
    return why_exit_code(found)


def why_exit_code(diagnoses: Sequence[Diagnosis]) -> int:
    """0 if messages or calls get through on every path that was asked about, else 1."""
    return 0 if diagnoses and all(diagnosis.flows for diagnosis in diagnoses) else 1


def _stage_lines(diagnosis: Diagnosis) -> list[str]:
    of = f" of {diagnosis.node}" if diagnosis.node else ""
    way = f" from {diagnosis.peer}" if diagnosis.peer and diagnosis.kind != "module" else ""
    to = f" to {diagnosis.to}" if diagnosis.to else ""
    lines = [printable(f"{diagnosis.name}{of}{way}{to}:")]
    width = max((len(stage.name) for stage in diagnosis.stages), default=0)
    lines += [_line(stage, width) for stage in diagnosis.stages]
    failed = diagnosis.failed
    if diagnosis.unasked:
        lines.append(_paint("nothing is in its way: it flows as soon as a node subscribes", WARN))
    elif failed is None:
        lines.append(_paint(_WELL.get(diagnosis.kind, "it flows"), OK))
    else:
        lines.append(_paint(printable(f"it stops at: {failed.name}"), FAIL))
        if failed.remedy:
            lines.append(printable(f"what to do: {failed.remedy}"))
    return lines


def _line(stage: Check, width: int) -> str:
    mark = _paint(f"{stage.level.value:<7}", stage.level)
    advice = f" ({stage.remedy})" if stage.remedy and stage.level is WARN else ""
    return f"  {mark}  {printable(stage.name):<{width}}  {printable(stage.text + advice)}"


def _paint(text: str, level: CheckLevel) -> str:
    return click.style(text, fg=LEVEL_COLOURS[level])


# ``rmpa alarm list|echo``: what is wrong with resources, now and as it changes.


_COLOURS: Final = {"OK": "green", "WARN": "yellow", "ERROR": "red", "STALE": "magenta"}
_LOOK: Final = 1.0
"""Seconds between two searches for new resources."""


@click.command("list", epilog="\b\nExamples:\n  rmpa alarm list\n  rmpa alarm list --all\n")
@click.option("-a", "--all", "everything", is_flag=True, help="Those that are well too.")
@graph_options
def list_(everything: bool, options: GraphOptions) -> None:
    """List the resources that are not well at present, here and at peers.

    WARN: adaptation, or a task that fails; ERROR: non-adaptable; STALE: an input that it needs has no publisher.
    """

    async def body(graph: ResourceGraph) -> None:
        heard = await graph.hear(graph.seen, "quality", ARRAY_TYPE)
        found = [(one, _health(heard.get(one))) for one in graph.seen]
        found = [(one, health) for one, health in found if everything or health["level"] != "OK"]
        if options.as_json:
            print_json([{"resource": one.path, "peer": one.peer, **health} for one, health in found])
            return
        rows = [(str(one), health["level"], health["message"]) for one, health in found]
        colours = [_COLOURS.get(health["level"], "") for _, health in found]
        print_table((Column("RESOURCE"), Column("LEVEL"), Column("MESSAGE")), rows, colours=colours)

    run_with_resources(options, body)


def _health(message: Any) -> dict[str, Any]:
    if message is None or not message.status:
        return {"level": "STALE", "message": "it has sent no quality while we listened", "values": {}}
    return _status(message.status[0])


def _status(status: Any) -> dict[str, Any]:
    return {
        "level": DiagnosticLevel(int(status.level) & 3).name,
        "message": str(status.message),
        "values": {str(pair.key): str(pair.value) for pair in status.values},
    }


@click.command(
    epilog="""\
\b
Examples:
  rmpa alarm echo                   of all resources, those to come included
  rmpa alarm echo base:/sonar -n 1  wait for one
  rmpa alarm echo --json | jq -r .message
"""
)
@click.argument("resource", required=False, shell_complete=completes("resource"))
@click.option("-n", "--count", type=click.IntRange(1), help="Stop after so many alarms.")
@graph_options
def echo(resource: str | None, count: int | None, options: GraphOptions) -> None:
    """Print alarms as they are raised and cleared, of all resources or of one RESOURCE, until Ctrl-C."""
    master = options.master()
    run_stream(lambda: _echo(master, resource, count, as_json=options.as_json))


async def _echo(master: Master, resource: str | None, count: int | None, *, as_json: bool) -> None:
    printer = _AlarmPrinter(count, as_json=as_json)
    if resource is not None:

        async def pick(graph: ResourceGraph) -> None:
            printer.only = graph.pick(resource)

        await with_resources(master, pick)

    async def body(node: Node) -> None:
        looking = asyncio.create_task(_keep_looking(node, master, printer))
        waiting = asyncio.create_task(printer.enough.wait())
        try:
            done, _ = await asyncio.wait((looking, waiting), return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in (looking, waiting):
                task.cancel()
            await asyncio.gather(looking, waiting, return_exceptions=True)

    await with_node(master, "rmpa_alarm", body)


async def _keep_looking(node: Node, master: Master, printer: _AlarmPrinter) -> None:
    """Subscribe to the alarms of all resources, those that start later included."""
    known: set[str] = set()
    while True:
        with contextlib.suppress(RmpaError):
            graph = await read_graph(master)
            for topic in graph.publishers.keys() - known:
                path = topic.removesuffix("/alarms")
                resource = (
                    topic != path and graph.types.get(topic) == ARRAY_TYPE and f"{path}/{TOPIC}" in graph.publishers
                )
                if resource and (printer.only is None or path == printer.only.path):
                    known.add(topic)
                    await node.subscribe(topic, MessageType(ARRAY_TYPE), functools.partial(printer.take, path))
        if not known and not printer.warned:
            printer.warned = True
            warn("there is no resource yet; waiting")
        await asyncio.sleep(_LOOK)


class _AlarmPrinter:
    """Prints alarms and counts them; ``only`` restricts it to one resource."""

    def __init__(self, count: int | None, *, as_json: bool) -> None:
        self.only: SeenResource | None = None
        self.enough = asyncio.Event()
        self.warned = False
        self._left = count
        self._json = as_json

    def take(self, path: str, received: Received) -> None:
        """Print the alarms of one message of a resource."""
        if self.only is not None and received.caller_id != self.only.caller:
            return
        peer = proxied_peer(received.caller_id)
        for status in received.message.status:
            if self._left == 0:
                return
            alarm = _status(status)
            if self._json:
                at = received.stamp_ns / 1e9
                print_json({"resource": path, "peer": peer, "at": at, **alarm})
            else:
                self._show(str(GraphName(path, peer)), received.stamp_ns, alarm)
            if self._left is not None:
                self._left -= 1
                if not self._left:
                    self.enough.set()

    def _show(self, source: str, stamp_ns: int, alarm: dict[str, Any]) -> None:
        at = time.strftime("%H:%M:%S", time.localtime(stamp_ns / 1e9))
        level = alarm["level"]
        mark = click.style(level, fg=_COLOURS.get(level))
        click.echo(f"{at} {mark} {printable(source)}: {printable(alarm['message'])}")
        for key, value in alarm["values"].items():
            if value.startswith("wanted "):
                print_line(f"    {key}: {value}")
