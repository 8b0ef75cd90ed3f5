"""``rmpa alarm list|echo``: what is wrong with resources, now and as it changes."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import time
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.bridge.proxies import proxied_peer
from rmpa.cli.graph import GraphName, read_graph
from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import Column, print_json, print_line, print_table, printable, warn
from rmpa.cli.resource_graph import run_with_resources, with_resources
from rmpa.cli.stream import run_stream, with_node
from rmpa.core.errors import RmpaError
from rmpa.resource.run.descriptor import TOPIC
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from rmpa.cli.master import Master
    from rmpa.cli.resource_graph import ResourceGraph, SeenResource
    from rmpa.ros.node.endpoints import Received
    from rmpa.ros.node.node import Node

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
