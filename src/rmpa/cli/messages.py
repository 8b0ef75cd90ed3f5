"""Messages as text, ``rmpa topic pub``, and ``rmpa alarm``.

Messages as text: the YAML-like form and the CSV form of ``rostopic echo``, and single fields of a message.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import re
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import click

from rmpa.cli.options import FiniteRange, GraphOptions, completes, graph_options
from rmpa.cli.output import (
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
from rmpa.cli.resource import run_stream, run_with_resources, with_node, with_resources
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.core.identity import proxied_peer
from rmpa.resource.descriptor import TOPIC
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.cli.output import Master
    from rmpa.cli.resource import ResourceGraph, SeenResource
    from rmpa.ros.node.endpoints import Received
    from rmpa.ros.node.node import Node, Publisher
    from rmpa.ros.types.messages import Plain

_PART: Final = re.compile(r"(?P<name>\w+)(?P<indices>(?:\[[0-9]+\])*)", re.ASCII)
_TIME: Final = {"secs", "nsecs"}


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
            raise RmpaError(f"{part!r} is not a field; one looks like name or name[0]")
        if not isinstance(plain, dict) or match["name"] not in plain:
            known = ", ".join(plain) if isinstance(plain, dict) else "none"
            raise RmpaError(f"no field {match['name']!r} in the message; it has {known}")
        plain = plain[match["name"]]
        for index in re.findall(r"[0-9]+", match["indices"]):
            if not isinstance(plain, list) or int(index) >= len(plain):
                raise RmpaError(f"no element {index} in {match['name']!r}")
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
    if isinstance(plain, str) and strings:
        return _Note(f"<string length: {len(plain)}>")
    return plain


class _Note(str):
    """A text in place of a value, printed without quotes."""

    __slots__ = ()


def to_text(plain: Plain, indent: str = "") -> str:
    """A message in the format of ``rostopic echo``, with control characters escaped."""
    if isinstance(plain, dict):
        return "\n".join(_field(name, value, indent) for name, value in plain.items())
    if isinstance(plain, list):
        return indent + _scalar_list(plain)
    return indent + _scalar(plain)


def _field(name: str, value: Plain, indent: str) -> str:
    if isinstance(value, dict):
        return f"{indent}{name}:" + ("\n" + to_text(value, indent + "  ") if value else " {}")
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return f"{indent}{name}:\n" + "\n".join(f"{indent}  -\n{to_text(item, indent + '    ')}" for item in value)
    return f"{indent}{name}: {_scalar_list(value) if isinstance(value, list) else _scalar(value)}"


def _scalar_list(values: list[Plain]) -> str:
    if any(isinstance(value, dict) for value in values):
        return "\n".join(f"-\n{to_text(value, '  ')}" for value in values)
    return f"[{', '.join(map(_scalar, values))}]"


def _scalar(value: Plain) -> str:
    if isinstance(value, _Note):
        return str(value)
    if isinstance(value, str):
        escaped = "\n".join(printable(line) for line in value.replace("\\", "\\\\").replace('"', '\\"').split("\n"))
        return f'"{escaped}"' if "\n" not in value else '"' + escaped.replace("\n", "\\n") + '"'
    return str(value)


def flatten(plain: Plain, name: str = "field") -> Iterator[tuple[str, str]]:
    """Columns and cells in the format of ``rostopic echo -p``: times in nanoseconds, elements of arrays numbered."""
    if isinstance(plain, dict) and plain.keys() == _TIME:
        secs, nsecs = plain["secs"], plain["nsecs"]
        assert isinstance(secs, int)  # noqa: S101 - as to_plain makes them
        assert isinstance(nsecs, int)  # noqa: S101 - likewise
        yield name, str(secs * 1_000_000_000 + nsecs)
    elif isinstance(plain, dict):
        for field, value in plain.items():
            yield from flatten(value, f"{name}.{field}")
    elif isinstance(plain, list):
        for index, value in enumerate(plain):
            yield from flatten(value, f"{name}{index}")
    else:
        text = str(int(plain)) if isinstance(plain, bool) else str(plain)
        yield name, printable(text) if isinstance(plain, str) else text


# ``rmpa topic pub``: messages from values in YAML or JSON.


_ONCE_SECONDS: Final = 3.0
"""Seconds for which a single message stays latched for subscribers to connect, as in ``rostopic pub -1``."""


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
            filled[name] = {"stamp": dict(stamp)}
        elif value == "now" and name == "stamp":
            filled[name] = dict(stamp)
        else:
            filled[name] = fill_stamps(value, now_ns) if isinstance(value, dict | list) else value
    return filled


@click.command(
    context_settings={"ignore_unknown_options": True},
    epilog="""\
\b
Without -r one message is published and kept for late subscribers until Ctrl-C; -1 ends after 3 seconds.
A header may be written auto, and a stamp now.
The TYPE is one that comes with rmpa, or of this machine's ROS packages (ROS_PACKAGE_PATH, CMAKE_PREFIX_PATH,
PYTHONPATH); else it is learnt from a node that publishes it, here or at a peer.

\b
Examples:
  rmpa topic pub -1 /chatter std_msgs/String hello
  rmpa topic pub -r 10 /cmd_vel geometry_msgs/Twist '{linear: {x: 0.2}, angular: {z: 0.1}}'
  rmpa topic pub /cmd sensor_msgs/Joy '{header: auto, axes: [0.5, 0.0]}'
""",
)
@click.argument("topic", shell_complete=completes("topic"))
@click.argument("kind", metavar="TYPE")
@click.argument("values", nargs=-1)
@click.option("-r", "--rate", type=FiniteRange(0.001, 10_000), help="Messages a second, until Ctrl-C.")
@click.option("-1", "--once", is_flag=True, help="Publish one message and end.")
@click.option("-l", "--latch", is_flag=True, help="Latch, with -r too: a new subscriber gets the last message.")
@graph_options
def pub(
    topic: str, kind: str, values: tuple[str, ...], rate: float | None, once: bool, latch: bool, options: GraphOptions
) -> None:
    """Publish VALUES, in YAML or JSON, as messages of a TYPE on a TOPIC."""
    from rmpa.ros.types.definitions import UnknownTypeError
    from rmpa.ros.types.find import find_message_type

    wanted = read_name(topic)
    if wanted.peer is not None:
        raise ConfigError("TOPIC", f"{topic!r} names a peer", f"publish on {wanted.name}: it crosses to every peer")
    if once and rate is not None:
        raise ConfigError("--once", "does not go with --rate", "choose one of them")
    plain = read_values(values)
    found: MessageType | None = None
    unknown: UnknownTypeError | None = None
    try:
        found = find_message_type(kind)
    except UnknownTypeError as error:
        if not error.fetchable:
            raise
        unknown = error
    if found is not None and not found.source:
        found.make(fill_stamps(plain, 0))  # a mistake is reported before the master is asked
    master = options.master()
    latch = latch or rate is None
    publish = partial(_pub, master, wanted.name, found or kind, plain, rate, once=once, latch=latch)
    try:
        run_stream(lambda: publish(as_json=options.as_json))
    except UnreachableError as error:
        if unknown is None:
            raise
        unknown.problem += f"; {error}"  # a publisher there might have told the type
        raise unknown from None


async def _pub(
    master: Master,
    topic: str,
    type_: MessageType | str,
    plain: Plain,
    rate: float | None,
    *,
    once: bool,
    latch: bool,
    as_json: bool,
) -> None:
    async def publish(node: Node) -> None:
        kind = await _version(node, topic, type_)
        kind.make(fill_stamps(plain, 0))  # a mistake is reported before the topic is registered
        publisher = await node.advertise(topic, kind, latch=latch)
        if rate is not None:
            if not as_json:
                print_line(f"publishing on {topic} at {rate:g} Hz; Ctrl-C to end")
            await _repeat(node, publisher, kind, plain, rate, as_json=as_json)
            return
        _one(publisher, kind, plain, 1, as_json=as_json)
        if not as_json:
            how_long = f"{_ONCE_SECONDS:g} s" if once else "Ctrl-C"
            print_line(f"published on {topic}, kept for late subscribers until {how_long}")
        await _wait(node, _ONCE_SECONDS if once else None)

    await with_node(master, "rmpa_pub", publish)


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
                f"than {found.source} has ({found.md5sum}); that of {there.node} is used"
            )
            return there.kind
    return found


def _one(publisher: Publisher, kind: MessageType, plain: Plain, number: int, *, as_json: bool) -> None:
    now_ns = time.time_ns()
    publisher.publish(kind.make(fill_stamps(plain, now_ns)))
    if as_json:
        line = {"topic": publisher.topic, "seq": number, "time": now_ns / 1e9, "subscribers": publisher.subscribers}
        print_json(line)


async def _repeat(
    node: Node, publisher: Publisher, kind: MessageType, plain: Plain, rate: float, *, as_json: bool
) -> None:
    loop = asyncio.get_running_loop()
    begin = loop.time()
    number = 0
    while not node.stopped.is_set():
        number += 1
        _one(publisher, kind, plain, number, as_json=as_json)
        # Each due time counts from the beginning, so that lateness does not add up.
        await _wait(node, max(0.0, begin + number / rate - loop.time()))


async def _wait(node: Node, seconds: float | None) -> None:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await node.stopped.wait()


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
