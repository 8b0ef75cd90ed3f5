"""What the agent knows of the topics that cross the mesh, as the topic commands show it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from functools import partial
from typing import TYPE_CHECKING, Final

import click

from rmpa.bridge.proxies import proxied_peer
from rmpa.cli.options import (
    FiniteRange,
    GraphOptions,
    Selection,
    completes,
    graph_options,
    run_stream,
    selection_options,
    summary,
    with_node,
)
from rmpa.cli.output import (
    duration,
    origin_json,
    origin_text,
    peers_mark,
    peers_of,
    print_json,
    print_line,
    print_names,
    printable,
    read_name,
    read_namespace,
    require_peer,
    size,
    warn,
)
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.observe.health import UNMEASURED, route_texts, subscriber_text
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.cli.output import Graph, GraphName, Master
    from rmpa.observe.snapshot import LatencyInfo, RouteInfo, SubscriberTransport, TopicInfo
    from rmpa.ros.node.node import Node, Publisher
    from rmpa.ros.types.messages import MessageType, Plain


def ask_agent(master: Master, topic: str) -> TopicInfo | None:
    """What the master's agent knows of a topic; ``None`` without an agent, or if it does not answer.

    Args:
        master: The master.
        topic: The topic.
    """
    snapshot = master.snapshot(topics=(topic,), peers=False)
    return next((info for info in snapshot.topics if info.name == topic), None) if snapshot is not None else None


def arriving(master: Master, wanted: GraphName) -> tuple[RouteInfo, ...]:
    """The routes of a topic's remote sources from which a message has come."""
    info = ask_agent(master, wanted.name)
    return tuple(
        route
        for route in (info.routes if info else ())
        if route.direction == "in" and route.messages and wanted.peer in (None, route.peer)
    )


def origin(route: RouteInfo) -> str:
    """The source that figures are about: ``joystick /joy_node``."""
    return printable(f"{route.peer} {route.node}")


def rate_text(route: RouteInfo) -> str:
    """Rate, period and jitter."""
    if route.rate is None or route.period is None:
        return "one message, no rate yet" if route.messages == 1 else "nothing in the last minute"
    p = route.period
    return (
        f"{route.rate:.3f} Hz, period {duration(p.mean)} (sd {duration(p.sd)}, min {duration(p.min)}, "
        f"max {duration(p.max)}, p99 {duration(p.p99)}), jitter {duration(route.jitter)}"
    )


def latency_text(latency: LatencyInfo | None) -> str:
    """One-way latency, with the bound of its error."""
    if latency is None:
        return "unknown yet"
    return (
        f"p50 {duration(latency.p50)}, p99 {duration(latency.p99)}, max {duration(latency.max)}, "
        f"last {duration(latency.last)}; each ± {duration(latency.error)}"
    )


def bandwidth_text(route: RouteInfo) -> str:
    """Bytes a second, and bytes a message."""
    mean = route.bytes / route.messages if route.messages else None
    return f"{size(route.bandwidth)}/s, {size(mean)} a message" if route.bandwidth is not None else "unknown yet"


def losses_text(route: RouteInfo) -> str:
    """Messages that did not arrive, by reason."""
    ours = f"{route.dropped} dropped here"
    if route.direction == "in":
        lost = f"{route.lost} lost"
        if unknown := route.events.get("loss_unknown", 0):
            lost = f"loss unknown ({_times(unknown)})" + (f", {route.lost} more lost" if route.lost else "")
        return f"{lost}, {route.late} late, {route.expired} expired, {ours}"
    return f"{route.lost} lost to {route.peer}" if route.contract.get("reliability") == "reliable" else ours


def oversized_text(route: RouteInfo) -> str:
    """Messages that were left out because they are too long."""
    where = f"by the agent of {route.peer}" if route.direction == "in" else "here"
    last, most = size(route.oversized_bytes), size(limits.TCPROS_MESSAGE_MAX)
    return f"{route.oversized} left out {where}, the last of {last}; at most {most} cross: send parts"


def shown_state(route: RouteInfo) -> str:
    """The state of a route, where its messages pass the agents or not: ``open``, ``direct``, ``open and direct``."""
    if route.transport == "direct":
        return "direct"
    return f"{route.state} and direct" if route.transport == "both" else route.state


def transport_lines(route: RouteInfo) -> Iterator[tuple[str, str]]:
    """The transport of each subscriber: label and text of each line."""
    if not route.subscribers:
        yield from (("transport", text) for text in route_texts(route))
    for one in route.subscribers:
        since = duration(one.since_ago) if one.since_ago is not None else ""
        yield "transport", subscriber_text(one, since)
        if one.interruptions:
            yield "", interruption_text(one)
        if one.transport == "direct":
            yield "", UNMEASURED


def interruption_text(one: SubscriberTransport) -> str:
    """How often a subscriber was without its path, and for how long the last time."""
    lasted = duration(one.interrupted)
    over = (
        f"{lasted}, until {duration(one.interrupted_ago)} ago" if one.interrupted_ago is not None else f"{lasted} now"
    )
    return f"interrupted {_times(one.interruptions)}, the last for {over}; what is lost of that time is not counted"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def facts(route: RouteInfo) -> Iterator[tuple[str, str]]:
    """All that the agent knows of a route: label and text of each line."""
    if route.wire:
        yield "there", route.wire
    yield from transport_lines(route)
    if route.lane:
        yield "lane", route.lane
    if route.direction == "in" and route.messages:
        yield "rate", rate_text(route)
        yield "latency", latency_text(route.latency)
        yield "bandwidth", bandwidth_text(route)
    if route.messages or route.lost or route.events.get("loss_unknown"):
        yield "missing", losses_text(route)
    if route.kept:
        yield "waiting", f"{route.kept} messages for {route.peer}"
    if route.oversized:
        yield "too long", oversized_text(route)
    if route.contract:
        yield "contract", ", ".join(f"{key} {_value(key, value)}" for key, value in route.contract.items())
    if route.events:
        yield "events", ", ".join(f"{kind} {count}" for kind, count in route.events.items())
    for event in route.recent:
        yield "", f"{duration(event.ago)} ago: {event.kind}: {event.text}"


def _value(key: str, value: object) -> str:
    """A contract's value with its unit: only the key says whether a number is a count, a rate or seconds."""
    if not isinstance(value, int | float):
        return str(value)
    if key == "depth":
        return f"{value:.0f}"
    return f"{value:g} Hz" if key == "max_rate" else duration(value)


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


# ``rmpa topic list|info|type|find``: the topics of the graph.


def _topic_json(graph: Graph, name: str) -> dict[str, object]:
    return {
        "name": name,
        "type": graph.types.get(name),
        "peers": peers_of(graph.publishers.get(name, ())),
        "publishers": [origin_json(node) for node in graph.publishers.get(name, ())],
        "subscribers": [origin_json(node) for node in graph.subscribers.get(name, ())],
    }


@click.command(
    "list", epilog="\b\nExamples:\n  rmpa topic list\n  rmpa topic list -v /camera\n  rmpa topic list joystick:/\n"
)
@click.argument("namespace", default="", shell_complete=completes("topic"))
@click.option("-v", "--verbose", is_flag=True, help="Types and counts, publishers and subscribers apart.")
@click.option("-p", "--publishers", is_flag=True, help="Only topics that have a publisher.")
@click.option("-s", "--subscribers", is_flag=True, help="Only topics that have a subscriber.")
@selection_options
@graph_options
def list_(
    namespace: str,
    verbose: bool,
    publishers: bool,
    subscribers: bool,
    selection: Selection,
    options: GraphOptions,
) -> None:
    """List topics, all or those of a NAMESPACE.

    A topic that peers publish has their names behind it: /cmd  [joystick]. A terminal shows the first of very many,
    this module's own before the others.
    """
    master, graph = options.graph()
    wanted = read_namespace(namespace, "topic")
    require_peer(master, graph, wanted)
    names = [
        name
        for name in graph.topics
        if wanted.contains(name, peers_of(graph.publishers.get(name, ())))
        and (not publishers or graph.publishers.get(name))
        and (not subscribers or graph.subscribers.get(name))
    ]
    names = selection.with_peers(names, lambda name: peers_of(graph.publishers.get(name, ())))
    if options.as_json:
        print_json([_topic_json(graph, name) for name in names])
        return
    every = names
    if selection.is_long(names):
        remote = {name for name in names if _is_remote(graph, name)}
        owners = {peer for name in remote for peer in peers_of(graph.publishers[name])}
        click.echo(summary(len(names), "topics", ("remote" if n in remote else "of this module" for n in names)))
        click.echo(f"the remote ones are of {len(owners):,} module{'s' if len(owners) != 1 else ''}\n")
        names = [*selection.shown(sorted(names, key=lambda name: (name in remote, name)))]
    if verbose:
        if not subscribers:
            _verbose("Published topics", "publisher", graph, [n for n in names if n in graph.publishers])
        if not publishers:
            _verbose("Subscribed topics", "subscriber", graph, [n for n in names if n in graph.subscribers])
    else:
        print_names(names, graph.publishers)
    selection.print_rest(every, "topics", "rmpa topic list MODULE:/, /NAMESPACE, --match '*/scan', --peer 'arm*'")


def _is_remote(graph: Graph, name: str) -> bool:
    """Whether peers alone publish a topic."""
    nodes = graph.publishers.get(name, ())
    return bool(nodes) and all(proxied_peer(node) is not None for node in nodes)


def _verbose(title: str, what: str, graph: Graph, names: list[str]) -> None:
    ends = graph.publishers if what == "publisher" else graph.subscribers
    click.echo(f"{title}:")
    for name in names:
        count = len(ends[name])
        kind = printable(graph.types.get(name, "unknown type"))
        mark = peers_mark(ends[name]) if what == "publisher" else ""
        click.echo(f" * {printable(name)} [{kind}] {count} {what}{'s' if count != 1 else ''}{mark}")


@click.command(
    epilog="""\
\b
Examples:
  rmpa topic info /cmd
  rmpa topic info joystick:/cmd                       what comes from joystick alone
  rmpa topic info /cmd --json | jq '.mesh.routes[0].latency.p99'
"""
)
@click.argument("topic", shell_complete=completes("topic"))
@graph_options
def info(topic: str, options: GraphOptions) -> None:
    """Show a topic's type, publishers and subscribers, and what of it crosses.

    Of each remote source the agent measures, over the last minute: rate, period, jitter, bandwidth, losses, and the
    one-way latency from the publisher's agent to this one. The ± behind a latency bounds its error: the other
    machine's clock is known only so well. The agent measures only while a node here subscribes.
    """
    wanted = read_name(topic)
    master, graph = options.graph()
    require_peer(master, graph, wanted)
    graph.require_topic(wanted.name)
    crossing = ask_agent(master, wanted.name)
    if options.as_json:
        print_json(_topic_json(graph, wanted.name) | {"mesh": crossing})
        return
    print_line(f"Type: {graph.types.get(wanted.name, 'unknown')}")
    if crossing is not None and crossing.md5:
        print_line(f"MD5: {crossing.md5}")
    for title, nodes in (("Publishers", graph.publishers), ("Subscribers", graph.subscribers)):
        meant = [node for node in nodes.get(wanted.name, []) if wanted.matches(node) or title == "Subscribers"]
        click.echo(f"\n{title}:" + ("" if meant else " none"))
        for node in meant:
            print_line(f" * {origin_text(node)}")
    if crossing is not None:
        _print_crossing(crossing, wanted)


def _print_crossing(crossing: TopicInfo, wanted: GraphName) -> None:
    click.echo("\nMesh:" + ("" if crossing.routes else " nothing of it crosses"))
    if crossing.policy:
        print_line(f" * {'may cross' if crossing.crosses else 'stays home'}: {crossing.policy}")
    for route in crossing.routes:
        if wanted.peer not in (None, route.peer):
            continue
        way = "from" if route.direction == "in" else "to"
        last = "" if route.age is None else f", last {duration(route.age)} ago"
        relayed = f", {route.messages} messages{last}" if route.transport != "direct" or route.messages else ""
        print_line(f" * {way} {route.peer}: {route.node} {shown_state(route)}{relayed}")
        for label, text in facts(route):
            print_line(f"     {label:<10} {text}")
        if route.problem:
            warn(f"{route.peer} {route.node}: {route.problem}")
    for trouble in (*crossing.mismatches, *crossing.unreachable):
        warn(trouble)


@click.command("type", epilog="\b\nExamples:\n  rmpa topic type /cmd\n")
@click.argument("topic", shell_complete=completes("topic"))
@graph_options
def type_(topic: str, options: GraphOptions) -> None:
    """Print a topic's type."""
    wanted = read_name(topic)
    master, graph = options.graph()
    require_peer(master, graph, wanted)
    graph.require_topic(wanted.name)
    kind = graph.types.get(wanted.name)
    if kind is None:
        raise RmpaError(f"the type of {wanted.name} is not known yet: its publisher tells it")
    if options.as_json:
        print_json({"name": wanted.name, "type": kind})
    else:
        print_line(kind)


@click.command(epilog="\b\nExamples:\n  rmpa topic find sensor_msgs/Joy\n")
@click.argument("kind", metavar="TYPE")
@graph_options
def find(kind: str, options: GraphOptions) -> None:
    """Print the topics of a TYPE."""
    _, graph = options.graph()
    found = [name for name in graph.topics if graph.types.get(name) == kind]
    if options.as_json:
        print_json(found)
    else:
        print_names(found, graph.publishers)
