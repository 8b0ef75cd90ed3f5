"""``rmpa topic echo``: prints messages as they arrive."""

from __future__ import annotations

import csv
import io
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from rmpa.bridge.proxies import proxied_node
from rmpa.cli.graph import Graph, GraphName, read_graph, read_name, require_peer, warn_unpublished
from rmpa.cli.message_text import flatten, pick, shorten, to_text
from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import print_json
from rmpa.cli.stream import Enough, StreamWatch, run_stream, watch_topic

if TYPE_CHECKING:
    from rmpa.cli.master import Master
    from rmpa.ros.node.node import Received
    from rmpa.ros.types.messages import Plain


@dataclass
class _MessagePrinter:
    """Prints messages in one form and counts them.

    Args:
        form: ``text``, ``csv`` or ``json``.
        noarr: Print the length of an array in place of its elements.
        nostr: Print the length of a string in place of its text.
        clear: Clear the terminal before each message.
    """

    form: str
    noarr: bool
    nostr: bool
    clear: bool
    count: int = 0

    def show(self, received: Received, wanted: GraphName, path: list[str]) -> None:
        """Print a message, or the field of it at ``path``."""
        plain = shorten(pick(received.plain, path), arrays=self.noarr, strings=self.nostr)
        self.count += 1
        if self.form == "json":
            proxy = proxied_node(received.caller_id)
            source = {"node": received.caller_id} if proxy is None else {"peer": proxy[0], "node": proxy[1]}
            line: dict[str, Plain] = {"topic": str(wanted), **source, "time": received.stamp_ns / 1e9}
            print_json(line | {"message": plain})
        elif self.form == "csv":
            columns = list(flatten(plain))
            if self.count == 1:
                click.echo(_csv(["%time", *(name for name, _ in columns)]))
            click.echo(_csv([str(received.stamp_ns), *(cell for _, cell in columns)]))
        else:
            if self.clear:
                click.clear()
            click.echo(to_text(plain) + "\n---")


def _csv(cells: list[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


def split_field(text: str, graph: Graph) -> tuple[GraphName, list[str]]:
    """Split ``/cmd/axes[0]`` into the topic and the path of a field, by the topics that the graph has.

    Raises:
        ConfigError: It is no topic's name.
    """
    peer, colon, rest = text.rpartition(":")
    parts = rest.strip("/").split("/")
    for end in range(len(parts), 0, -1):
        topic = "/" + "/".join(parts[:end])
        if topic in graph.publishers or topic in graph.subscribers:
            return read_name(f"{peer}{colon}{topic}"), parts[end:]
    return read_name(text), []


@click.command(
    epilog="""\
\b
Examples:
  rmpa topic echo /cmd                 all messages, all sources
  rmpa topic echo joystick:/cmd -n 1   one message of peer joystick
  rmpa topic echo /odom/pose/pose      one field
  rmpa topic echo /odom -p > odom.csv  a table
  rmpa topic echo /cmd --json | jq .message.axes
"""
)
@click.argument("topic", shell_complete=completes("topic"))
@click.option("-n", "--count", type=click.IntRange(1), help="Stop after so many messages.")
@click.option("-p", "--plot", is_flag=True, help="Comma-separated values, for plotting.")
@click.option("--noarr", is_flag=True, help="Leave arrays out.")
@click.option("--nostr", is_flag=True, help="Leave strings out.")
@click.option("-c", "--clear", is_flag=True, help="Clear the terminal before each message.")
@graph_options
def echo(
    topic: str, count: int | None, plot: bool, noarr: bool, nostr: bool, clear: bool, options: GraphOptions
) -> None:
    """Print messages until Ctrl-C.

    Behind the TOPIC a field may stand: /cmd/axes, /cmd/axes[0].
    """
    form = "json" if options.as_json else "csv" if plot else "text"
    printer = _MessagePrinter(form, noarr, nostr, clear and sys.stdout.isatty())
    master = options.master()
    run_stream(lambda: _echo(master, topic, count, printer))


async def _echo(master: Master, topic: str, count: int | None, printer: _MessagePrinter) -> None:
    graph = await read_graph(master)
    wanted, path = split_field(topic, graph)
    require_peer(master, graph, wanted)
    warn_unpublished(master, graph, wanted)

    def on_message(received: Received) -> None:
        if count is None or printer.count < count:
            printer.show(received, wanted, path)
        if printer.count == count:
            raise Enough

    async def body(watch: StreamWatch) -> None:
        await watch.finished()

    try:
        await watch_topic(master, wanted, on_message, body)
    except Enough:
        return
