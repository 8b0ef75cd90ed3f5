"""``rmpa topic list|info|type|find``: the topics of the graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from rmpa.bridge.proxies import proxied_peer
from rmpa.cli.graph import (
    origin_json,
    origin_text,
    peers_mark,
    peers_of,
    print_names,
    read_name,
    read_namespace,
    require_peer,
)
from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import duration, print_json, print_line, printable, warn
from rmpa.cli.selection import Selection, selection_options, summary
from rmpa.cli.topic_crossing import ask_agent, facts, shown_state
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from rmpa.cli.graph import Graph, GraphName
    from rmpa.observe.snapshot import TopicInfo


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
