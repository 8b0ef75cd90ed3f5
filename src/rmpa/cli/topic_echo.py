"""``rmpa topic echo``: messages as they come."""

from __future__ import annotations

import csv
import io
import os
import sys
from typing import TYPE_CHECKING

import click

from rmpa.bridge.proxy_names import proxied_node
from rmpa.cli.master import Graph, Master, TopicName, choose_master, read_graph, read_topic
from rmpa.cli.message_text import flatten, pick, shorten, to_text
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import print_json, print_line, warn
from rmpa.cli.stream import Enough, StreamWatch, run_stream, watch_topic
from rmpa.config.values import did_you_mean

if TYPE_CHECKING:
    from rmpa.ros.node.node import Received
    from rmpa.ros.types.messages import Plain

_CLEAR = "\x1b[2J\x1b[H"


class _MessagePrinter:
    """Prints messages, each in the form that was asked for."""

    def __init__(
        self, wanted: TopicName, path: list[str], *, form: str, noarr: bool, nostr: bool, clear: bool
    ) -> None:
        self.count = 0
        self._wanted = wanted
        self._path = path
        self._form = form
        self._noarr = noarr
        self._nostr = nostr
        self._clear = clear

    def show(self, received: Received) -> None:
        plain = shorten(pick(received.plain, self._path), arrays=self._noarr, strings=self._nostr)
        self.count += 1
        if self._form == "json":
            self._json(received, plain)
        elif self._form == "csv":
            columns = list(flatten(plain))
            if self.count == 1:
                print_line(_csv(["%time", *(name for name, _ in columns)]))
            print_line(_csv([str(received.stamp_ns), *(cell for _, cell in columns)]))
        else:
            print_line((_CLEAR if self._clear else "") + to_text(plain) + "\n---")

    def _json(self, received: Received, plain: Plain) -> None:
        proxy = proxied_node(received.caller_id)
        whence = {"node": received.caller_id} if proxy is None else {"peer": proxy[0], "node": proxy[1]}
        line = {"topic": str(self._wanted), **whence, "time": received.stamp_ns / 1e9, "message": plain}
        print_json(line, flush=True)


def _csv(cells: list[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


def split_field(text: str, graph: Graph) -> tuple[TopicName, list[str]]:
    """``/cmd/axes[0]`` to the topic and the path of a field in it, by which topics there are.

    Raises:
        ConfigError: It is no topic's name.
    """
    peer, colon, rest = text.rpartition(":")
    parts = rest.strip("/").split("/")
    for end in range(len(parts), 0, -1):
        topic = "/" + "/".join(parts[:end])
        if topic in graph.publishers or topic in graph.subscribers:
            return read_topic(f"{peer}{colon}{topic}"), parts[end:]
    return read_topic(text), []


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
@click.argument("topic")
@click.option("-n", "--count", type=click.IntRange(1), help="Stop after so many messages.")
@click.option("-p", "--plot", is_flag=True, help="Comma-separated values, for plotting.")
@click.option("--noarr", is_flag=True, help="Leave arrays out.")
@click.option("--nostr", is_flag=True, help="Leave strings out.")
@click.option("-c", "--clear", is_flag=True, help="Clear the terminal before each message.")
@json_option
@agent_option
@master_option
def echo(
    topic: str,
    count: int | None,
    plot: bool,
    noarr: bool,
    nostr: bool,
    clear: bool,
    as_json: bool,
    agent: str | None,
    master: str | None,
) -> None:
    """Print messages until Ctrl-C.

    Behind the TOPIC a field may stand: /cmd/axes, /cmd/axes[0].
    """
    form = "json" if as_json else "csv" if plot else "text"
    chosen = choose_master(master, agent, os.environ)
    clear = clear and sys.stdout.isatty()
    run_stream(lambda: _echo(chosen, topic, count, form=form, noarr=noarr, nostr=nostr, clear=clear))


async def _echo(
    master: Master, topic: str, count: int | None, *, form: str, noarr: bool, nostr: bool, clear: bool
) -> None:
    graph = await read_graph(master)
    wanted, path = split_field(topic, graph)
    if wanted.topic not in graph.publishers:
        near = did_you_mean(wanted.topic, graph.publishers)
        warn(f"{wanted.topic} is not published yet; waiting" + (f" (did you mean {near}?)" if near else ""))
    printer = _MessagePrinter(wanted, path, form=form, noarr=noarr, nostr=nostr, clear=clear)

    def take(received: Received) -> None:
        if count is None or printer.count < count:
            printer.show(received)
        if count is not None and printer.count >= count:
            raise Enough

    async def body(watch: StreamWatch) -> None:
        await watch.finished()

    try:
        await watch_topic(master, wanted, take, body)
    except Enough:
        return
