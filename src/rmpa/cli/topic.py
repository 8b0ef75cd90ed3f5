"""``rmpa topic``: lists topics, and shows one with what of it crosses.

``rmpa topic list|info|type|find``: the topics of the graph.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from rmpa.cli.options import GraphOptions, Selection, completes, graph_options, selection_options, summary
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
from rmpa.core.errors import RmpaError
from rmpa.core.identity import proxied_peer
from rmpa.observe.why.diagnosis import UNMEASURED, route_texts, subscriber_text
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.cli.output import Graph, GraphName, Master
    from rmpa.observe.snapshot import LatencyInfo, RouteInfo, SubscriberTransport, TopicInfo


# What the agent knows of the topics that cross the mesh, as the topic commands show it.


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
