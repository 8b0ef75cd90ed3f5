"""``rmpa alarm list|echo``."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import time
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.bridge.proxy_names import proxied_node
from rmpa.cli.master import TopicName, choose_master, read_graph
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import Column, coloured, print_json, print_line, print_table, printable
from rmpa.cli.resources_seen import look_around, run_around
from rmpa.cli.stream import run_stream, with_node
from rmpa.core.errors import RmpaError
from rmpa.resource.run.descriptor import TOPIC
from rmpa.ros.types.diagnostic_array import ARRAY_TYPE, DiagnosticLevel
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from rmpa.cli.master import Master
    from rmpa.cli.resources_seen import Room, SeenResource
    from rmpa.ros.node.node import Node
    from rmpa.ros.node.topics import Received

_COLOURS: Final = {"OK": "green", "WARN": "yellow", "ERROR": "red", "STALE": "magenta"}
_LOOK: Final = 1.0
"""Seconds between looks for resources that have come since."""


@click.command("list", epilog="\b\nExamples:\n  rmpa alarm list\n  rmpa alarm list --all\n")
@click.option("-a", "--all", "everything", is_flag=True, help="Those that are well too.")
@json_option
@agent_option
@master_option
def list_(everything: bool, as_json: bool, agent: str | None, master: str | None) -> None:
    """List the resources that are not well at present, here and at peers.

    WARN: adaptation, or a task that fails; ERROR: non-adaptable; STALE: nobody publishes what it needs.
    """

    async def body(room: Room) -> None:
        heard = await room.hear(room.seen, "quality", ARRAY_TYPE)
        found = [(one, _health(heard.get(one))) for one in room.seen]
        found = [(one, health) for one, health in found if everything or health["level"] != "OK"]
        if as_json:
            print_json([{"resource": one.path, "peer": one.peer, **health} for one, health in found])
            return
        rows = [tuple(map(printable, (str(one), health["level"], health["message"]))) for one, health in found]
        colours = [_COLOURS.get(health["level"], "") for _, health in found]
        print_table((Column("RESOURCE"), Column("LEVEL"), Column("MESSAGE")), rows, colours=colours)

    run_around(master, agent, body)


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
@click.argument("resource", required=False)
@click.option("-n", "--count", type=click.IntRange(1), help="Stop after so many alarms.")
@json_option
@agent_option
@master_option
def echo(resource: str | None, count: int | None, as_json: bool, agent: str | None, master: str | None) -> None:
    """Print alarms as they are raised and cleared, of all resources or of one RESOURCE, until Ctrl-C."""
    chosen = choose_master(master, agent, os.environ)
    run_stream(lambda: _echo(chosen, resource, count, as_json=as_json))


async def _echo(master: Master, resource: str | None, count: int | None, *, as_json: bool) -> None:
    if resource is not None:

        async def pick(room: Room) -> None:
            printer.only = room.pick(resource)

        printer = _AlarmPrinter(count, as_json=as_json)
        await look_around(master, pick)
    else:
        printer = _AlarmPrinter(count, as_json=as_json)

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
    """Listen to the alarms of all resources, those to come included."""
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
        if not known and not printer.told:
            printer.told = True
            click.echo("! there is no resource yet; waiting", err=True)
        await asyncio.sleep(_LOOK)


class _AlarmPrinter:
    """Prints alarms, and counts them."""

    def __init__(self, count: int | None, *, as_json: bool) -> None:
        self.only: SeenResource | None = None
        self.enough = asyncio.Event()
        self.told = False
        self._left = count
        self._json = as_json

    def take(self, path: str, received: Received) -> None:
        """One message of a resource, with one alarm or several."""
        if self.only is not None and received.caller_id != self.only.caller:
            return
        proxy = proxied_node(received.caller_id)
        peer = None if proxy is None else proxy[0]
        for status in received.message.status:
            if self._left == 0:
                return
            alarm = _status(status)
            if self._json:
                at = received.stamp_ns / 1e9
                print_json({"resource": path, "peer": peer, "at": at, **alarm}, flush=True)
            else:
                self._show(str(TopicName(path, peer)), received.stamp_ns, alarm)
            if self._left is not None:
                self._left -= 1
                if not self._left:
                    self.enough.set()

    def _show(self, who: str, stamp_ns: int, alarm: dict[str, Any]) -> None:
        at = time.strftime("%H:%M:%S", time.localtime(stamp_ns / 1e9))
        level = alarm["level"]
        mark = click.style(level, fg=_COLOURS.get(level)) if coloured() else level
        print_line(f"{at} {mark} {printable(who)}: {printable(alarm['message'])}")
        for key, value in alarm["values"].items():
            if value.startswith("wanted "):
                print_line(f"    {printable(key)}: {printable(value)}")
