"""``rmpa topic pub``: messages from values in YAML or JSON."""

from __future__ import annotations

import asyncio
import contextlib
import time
from functools import partial
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.graph import read_name
from rmpa.cli.options import FiniteRange, GraphOptions, completes, graph_options
from rmpa.cli.output import print_json, print_line, warn
from rmpa.cli.stream import run_stream, with_node
from rmpa.core.errors import ConfigError, UnreachableError

if TYPE_CHECKING:
    from rmpa.cli.master import Master
    from rmpa.ros.node.node import Node, Publisher
    from rmpa.ros.types.messages import MessageType, Plain

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
