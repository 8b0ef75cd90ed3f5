"""``rmpa topic echo|pub``."""

from __future__ import annotations

import asyncio
import contextlib
import csv
import io
import os
import sys
import time
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.graph import Enough, Graph, GraphName, read_name, run_stream
from rmpa.cli.options import FiniteRange, Options, argument, count_option, flag, graph_verb, option, topics
from rmpa.cli.output import fill_stamps, flatten, pick, print_json, print_text, read_values, shorten, to_text, warn
from rmpa.core.errors import ConfigError, UnreachableError
from rmpa.core.identity import proxied_node

if TYPE_CHECKING:
    from rmpa.ros.node.node import Node, Received
    from rmpa.ros.types.messages import MessageType

# Seconds for which a single message stays latched for subscribers to connect, as in ``rostopic pub -1``.
_ONCE_SECONDS: Final = 3.0


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


@graph_verb(
    argument("topic", topics),
    count_option("messages"),
    flag("-p --plot", "Comma-separated values, for plotting."),
    flag("--noarr", "Leave arrays out."),
    flag("--nostr", "Leave strings out."),
    flag("-c --clear", "Clear the terminal before each message."),
)
def topic_echo(
    topic: str, count: int | None, plot: bool, noarr: bool, nostr: bool, clear: bool, options: Options
) -> None:
    """Print messages until Ctrl-C.

    A field may follow the TOPIC: /cmd/axes, /cmd/axes[0].

    ---

    Examples:
      rmpa topic echo /cmd                 all messages, all sources
      rmpa topic echo joystick:/cmd -n 1   one message of peer joystick
      rmpa topic echo /odom/pose/pose      one field
      rmpa topic echo /odom -p > odom.csv  a table
      rmpa topic echo /cmd --json | jq .message.axes
    """
    master = options.master()
    numbers = iter(range(1, sys.maxsize))

    def show(received: Received, wanted: GraphName, path: list[str]) -> None:
        plain = shorten(pick(received.plain, path), arrays=noarr, strings=nostr)
        number = next(numbers)
        if options.as_json:
            proxy = proxied_node(received.caller_id)
            source = {"node": received.caller_id} if proxy is None else {"peer": proxy[0], "node": proxy[1]}
            print_json({"topic": str(wanted), **source, "time": received.stamp_ns / 1e9, "message": plain})
        elif plot:
            columns = list(flatten(plain))
            if number == 1:
                click.echo(_csv(["%time", *(name for name, _ in columns)]))
            click.echo(_csv([str(received.stamp_ns), *(cell for _, cell in columns)]))
        else:
            if clear and sys.stdout.isatty() and os.environ.get("TERM") != "dumb":
                click.clear()
            click.echo(to_text(plain) + "\n---")
        if number == count:
            raise Enough

    async def run() -> None:
        graph = await master.graph()
        wanted, path = split_field(topic, graph)
        master.require_peer(graph, wanted)
        master.warn_unpublished(graph, wanted)
        await master.watch(wanted, lambda received: show(received, wanted, path))

    run_stream(run)


def _csv(cells: list[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


@graph_verb(
    argument("topic", topics),
    argument("kind", metavar="TYPE"),
    argument("values", nargs=-1),
    option("-r --rate", help="Messages a second, until Ctrl-C.", type=FiniteRange(0.001, 10_000)),
    flag("-1 --once", "Publish one message and end."),
    flag("-l --latch", "Latch, with -r too: a new subscriber gets the last message."),
    context_settings={"ignore_unknown_options": True},
)
def topic_pub(
    topic: str, kind: str, values: tuple[str, ...], rate: float | None, once: bool, latch: bool, options: Options
) -> None:
    """Publish VALUES, in YAML or JSON, as messages of a TYPE on a TOPIC.

    ---
    Without -r one message is published and kept for late subscribers until Ctrl-C; -1 ends after 3 seconds.
    For a header write auto, for a stamp now.
    The TYPE is one that comes with rmpa, or of this machine's ROS packages (ROS_PACKAGE_PATH, CMAKE_PREFIX_PATH,
    PYTHONPATH); else it is learnt from a node that publishes it, here or at a peer.

    Examples:
      rmpa topic pub -1 /chatter std_msgs/String hello
      rmpa topic pub -r 10 /cmd_vel geometry_msgs/Twist '{linear: {x: 0.2}}'
      rmpa topic pub /cmd sensor_msgs/Joy '{header: auto, axes: [0.5, 0.0]}'
    """
    from rmpa.ros.types.definitions import UnknownTypeError
    from rmpa.ros.types.find import find_message_type

    wanted = read_name(topic)
    if wanted.peer is not None:
        raise ConfigError("TOPIC", f"{topic!r} names a peer", f"publish on {wanted.name}: it crosses to every peer")
    if once and rate is not None:
        raise ConfigError("--once", "does not go with --rate", "choose one of them")
    plain = read_values(values)
    found: MessageType | str = kind
    unknown: UnknownTypeError | None = None
    try:
        found = find_message_type(kind)
        if not found.source:
            found.serialize(fill_stamps(plain, 0))  # a mistake is reported before the master is asked
    except UnknownTypeError as error:
        if not error.fetchable:
            raise
        unknown = error
    master = options.master()

    async def publish(node: Node) -> None:
        kind = await _version(node, wanted.name, found)
        kind.serialize(fill_stamps(plain, 0))  # a mistake is reported before the topic is registered
        publisher = await node.advertise(wanted.name, kind, latch=latch or rate is None)
        if rate is not None and not options.as_json:
            print_text(f"publishing on {wanted.name} at {rate:g} Hz; Ctrl-C to end")
        begin, number = time.monotonic(), 0
        while not node.stopped.is_set():
            number += 1
            now_ns = time.time_ns()
            publisher.publish(fill_stamps(plain, now_ns))
            if options.as_json:
                sent = {"topic": wanted.name, "seq": number, "time": now_ns / 1e9}
                print_json(sent | {"subscribers": publisher.subscribers})
            if rate is None:
                if not options.as_json:
                    how_long = f"{_ONCE_SECONDS:g} s" if once else "Ctrl-C"
                    print_text(f"published on {wanted.name}, kept for late subscribers until {how_long}")
                await _wait(node, _ONCE_SECONDS if once else None)
                return
            # Each due time counts from the beginning, so that lateness does not add up.
            await _wait(node, max(0.0, begin + number / rate - time.monotonic()))

    try:
        run_stream(lambda: master.with_node("rmpa_pub", publish))
    except UnreachableError as error:
        if unknown is None:
            raise
        unknown.problem += f"; {error}"  # a publisher there might have told the type
        raise unknown from None


async def _version(node: Node, topic: str, found: MessageType | str) -> MessageType:
    """The type to publish: as found here, else learnt from a publisher.

    For a type of the user's own packages the version of a present publisher is taken, with a warning.

    Raises:
        DefinitionError: It is not known here, and no publisher tells it.
    """
    from rmpa.ros.node.fetch_type import fetch_type, find_or_fetch

    if isinstance(found, str):
        return await find_or_fetch(node.master_uri, node.name, found, topic)
    if found.source:
        there = await fetch_type(node.master_uri, node.name, found.name, topic=topic, elsewhere=False)
        if there is not None and there[0].md5sum != found.md5sum:
            kind, _, publisher = there
            warn(
                f"{publisher} publishes {topic} with another version of {found.name} (md5 {kind.md5sum}) "
                f"than {found.source} has ({found.md5sum}); that of {publisher} is used",
                "type-mismatch",
            )
            return kind
    return found


async def _wait(node: Node, seconds: float | None) -> None:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await node.stopped.wait()
