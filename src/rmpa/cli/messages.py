"""``rmpa topic echo|pub``: messages as text, as rostopic writes and reads them."""

from __future__ import annotations

import asyncio
import contextlib
import csv
import io
import os
import re
import sys
import time
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.graph import (
    Enough,
    read_graph,
    read_name,
    require_peer,
    run_stream,
    warn_unpublished,
    watch_topic,
    with_node,
)
from rmpa.cli.options import FiniteRange, Options, argument, count_option, flag, graph_verb
from rmpa.cli.output import print_json, print_text, printable, warn
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.core.identity import proxied_node

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.cli.graph import Graph, GraphName
    from rmpa.ros.node.node import Node, Received
    from rmpa.ros.types.messages import MessageType, Plain

_PART: Final = re.compile(r"(?P<name>\w+)(?P<indices>(?:\[[0-9]+\])*)", re.ASCII)
_TIME: Final = {"secs", "nsecs"}
# Seconds for which a single message stays latched for subscribers to connect, as in ``rostopic pub -1``.
_ONCE_SECONDS: Final = 3.0


def pick(plain: Plain, path: list[str]) -> Plain:
    """Return one field of a message.

    Args:
        plain: The message.
        path: Names from the outside in, each perhaps with indices: ``["pose", "covariance[0]"]``.

    Raises:
        RmpaError: There is no such field or element.
    """
    for part in path:
        match = _PART.fullmatch(part)
        if match is None:
            raise RmpaError(f"{part!r} is not a field; one looks like name or name[0]", code="invalid-value")
        if not isinstance(plain, dict) or match["name"] not in plain:
            known = ", ".join(plain) if isinstance(plain, dict) else "none"
            raise RmpaError(f"no field {match['name']!r} in the message; it has {known}", code="invalid-value")
        plain = plain[match["name"]]
        for index in re.findall(r"[0-9]+", match["indices"]):
            if not isinstance(plain, list) or int(index) >= len(plain):
                raise RmpaError(f"no element {index} in {match['name']!r}", code="invalid-value")
            plain = plain[int(index)]
    return plain


def shorten(plain: Plain, *, arrays: bool, strings: bool) -> Plain:
    """A copy of a message in which a note of the length replaces each array, and each string, if wanted."""
    if isinstance(plain, dict):
        return {name: shorten(value, arrays=arrays, strings=strings) for name, value in plain.items()}
    if isinstance(plain, list):
        if arrays:
            return _Note(f"<array length: {len(plain)}>")
        return [shorten(value, arrays=arrays, strings=strings) for value in plain]
    return _Note(f"<string length: {len(plain)}>") if isinstance(plain, str) and strings else plain


class _Note(str):
    """A text in place of a value, printed without quotes."""

    __slots__ = ()


def to_text(plain: Plain, indent: str = "") -> str:
    """A message in the format of ``rostopic echo``, with control characters escaped."""
    if isinstance(plain, dict):
        return "\n".join(_field(name, value, indent) for name, value in plain.items())
    return indent + _scalar(plain)


def _field(name: str, value: Plain, indent: str) -> str:
    if isinstance(value, dict):
        return f"{indent}{name}:" + ("\n" + to_text(value, indent + "  ") if value else " {}")
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return f"{indent}{name}:\n" + "\n".join(f"{indent}  -\n{to_text(item, indent + '    ')}" for item in value)
    return f"{indent}{name}: {_scalar(value)}"


def _scalar(value: Plain) -> str:
    if isinstance(value, list):
        if any(isinstance(item, dict) for item in value):
            return "\n".join(f"-\n{to_text(item, '  ')}" for item in value)
        return f"[{', '.join(map(_scalar, value))}]"
    if isinstance(value, str) and not isinstance(value, _Note):
        lines = value.replace("\\", "\\\\").replace('"', '\\"').split("\n")
        return '"' + "\\n".join(map(printable, lines)) + '"'
    return str(value)


def flatten(plain: Plain, name: str = "field") -> Iterator[tuple[str, str]]:
    """Columns and cells in the format of ``rostopic echo -p``: times in nanoseconds, elements of arrays numbered."""
    if isinstance(plain, dict) and plain.keys() == _TIME:
        yield name, str(plain["secs"] * 1_000_000_000 + plain["nsecs"])  # type: ignore[operator] # both are numbers
    elif isinstance(plain, dict):
        for field, value in plain.items():
            yield from flatten(value, f"{name}.{field}")
    elif isinstance(plain, list):
        for index, value in enumerate(plain):
            yield from flatten(value, f"{name}{index}")
    else:
        yield name, printable(str(int(plain) if isinstance(plain, bool) else plain))


def read_values(texts: tuple[str, ...]) -> Plain:
    """Read a message's values from the command line: none, one YAML value, or one for each field in order.

    Raises:
        ConfigError: It is not YAML.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    values: list[Plain] = []
    for text in texts:
        try:
            values.append(YAML(typ="safe", pure=True).load(text))
        except (YAMLError, ValueError) as error:
            problem = getattr(error, "problem", None) or str(error)
            raise ConfigError("VALUES", f"not YAML: {problem}", f"in {text!r}") from None
    if len(values) == 1 and values[0] is not None:
        return values[0]
    return values or None


def fill_stamps(values: Plain, now_ns: int) -> Plain:
    """Replace ``auto`` (a header) and ``now`` (a stamp) by the time, as rostopic does."""
    secs, nsecs = divmod(now_ns, 1_000_000_000)
    stamp: dict[str, Plain] = {"secs": secs, "nsecs": nsecs}
    if isinstance(values, list):
        return [fill_stamps(value, now_ns) for value in values]
    if not isinstance(values, dict):
        return {"stamp": stamp} if values == "auto" else values
    filled: dict[str, Plain] = {}
    for name, value in values.items():
        if name == "header" and value == "auto":
            filled[name] = {"stamp": stamp}
        elif name == "stamp" and value == "now":
            filled[name] = stamp
        else:
            filled[name] = fill_stamps(value, now_ns) if isinstance(value, dict | list) else value
    return filled


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
    argument("topic", "topic"),
    count_option("messages"),
    flag("-p", "--plot", help="Comma-separated values, for plotting."),
    flag("--noarr", help="Leave arrays out."),
    flag("--nostr", help="Leave strings out."),
    flag("-c", "--clear", help="Clear the terminal before each message."),
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
        graph = await read_graph(master)
        wanted, path = split_field(topic, graph)
        require_peer(master, graph, wanted)
        warn_unpublished(master, graph, wanted)
        await watch_topic(master, wanted, lambda received: show(received, wanted, path))

    run_stream(run)


def _csv(cells: list[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


@graph_verb(
    argument("topic", "topic"),
    argument("kind", metavar="TYPE"),
    argument("values", nargs=-1),
    click.option("-r", "--rate", type=FiniteRange(0.001, 10_000), help="Messages a second, until Ctrl-C."),
    flag("-1", "--once", help="Publish one message and end."),
    flag("-l", "--latch", help="Latch, with -r too: a new subscriber gets the last message."),
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
        run_stream(lambda: with_node(master, "rmpa_pub", publish))
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
        if there is not None and there.kind.md5sum != found.md5sum:
            warn(
                f"{there.node} publishes {topic} with another version of {found.name} (md5 {there.kind.md5sum}) "
                f"than {found.source} has ({found.md5sum}); that of {there.node} is used",
                "type-mismatch",
            )
            return there.kind
    return found


async def _wait(node: Node, seconds: float | None) -> None:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await node.stopped.wait()
