"""``rmpa topic list|info|type|find``: what the graph holds."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING

import click

from rmpa.bridge.proxy_names import proxied_node
from rmpa.cli.master import Graph, Master, TopicName, choose_master, read_graph, read_topic
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import coloured, duration, print_json, printable, warn
from rmpa.cli.topic_figures import ask_agent, facts
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from rmpa.observe.snapshot import TopicInfo


def _graph(master: str | None, agent: str | None) -> tuple[Master, Graph]:
    chosen = choose_master(master, agent, os.environ)
    return chosen, asyncio.run(read_graph(chosen))


def _ends(nodes: list[str]) -> list[dict[str, str]]:
    """Publishers or subscribers for JSON: a proxy's with the peer and the node behind it."""
    found = []
    for node in nodes:
        proxy = proxied_node(node)
        found.append({"node": node} if proxy is None else {"node": node, "peer": proxy[0], "remote_node": proxy[1]})
    return found


def _topic_json(graph: Graph, name: str) -> dict[str, object]:
    return {
        "name": name,
        "type": graph.types.get(name),
        "peers": graph.peers(name),
        "publishers": _ends(graph.publishers.get(name, [])),
        "subscribers": _ends(graph.subscribers.get(name, [])),
    }


@click.command(
    "list", epilog="\b\nExamples:\n  rmpa topic list\n  rmpa topic list -v /camera\n  rmpa topic list joystick:/\n"
)
@click.argument("namespace", default="")
@click.option("-v", "--verbose", is_flag=True, help="Types and counts, publishers and subscribers apart.")
@click.option("-p", "--publishers", is_flag=True, help="Only topics that have a publisher.")
@click.option("-s", "--subscribers", is_flag=True, help="Only topics that have a subscriber.")
@json_option
@agent_option
@master_option
def list_(
    namespace: str,
    verbose: bool,
    publishers: bool,
    subscribers: bool,
    as_json: bool,
    agent: str | None,
    master: str | None,
) -> None:
    """List topics, all or those of a NAMESPACE.

    A topic that peers publish has their names behind it: /cmd  [joystick].
    """
    _, graph = _graph(master, agent)
    wanted = read_topic(namespace) if namespace else None
    names = [
        name
        for name in graph.topics
        if (wanted is None or wanted.topic == "/" or f"{name}/".startswith(f"{wanted.topic}/"))
        and (wanted is None or wanted.peer is None or wanted.peer in graph.peers(name))
        and (not publishers or graph.publishers.get(name))
        and (not subscribers or graph.subscribers.get(name))
    ]
    if as_json:
        print_json([_topic_json(graph, name) for name in names])
    elif verbose:
        if not subscribers:
            _verbose("Published topics", "publisher", graph, [n for n in names if n in graph.publishers])
        if not publishers:
            _verbose("Subscribed topics", "subscriber", graph, [n for n in names if n in graph.subscribers])
    else:
        for name in names:
            click.echo(printable(name) + _mark(graph, name))


def _mark(graph: Graph, name: str) -> str:
    peers = graph.peers(name)
    text = f"  [{', '.join(peers)}]" if peers else ""
    return click.style(printable(text), fg="cyan") if text and coloured() else printable(text)


def _verbose(title: str, what: str, graph: Graph, names: list[str]) -> None:
    ends = graph.publishers if what == "publisher" else graph.subscribers
    click.echo(f"{title}:")
    for name in names:
        count = len(ends[name])
        kind = printable(graph.types.get(name, "unknown type"))
        mark = _mark(graph, name) if what == "publisher" else ""
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
@click.argument("topic")
@json_option
@agent_option
@master_option
def info(topic: str, as_json: bool, agent: str | None, master: str | None) -> None:
    """Show a topic's type, publishers and subscribers, and what of it crosses.

    Of what comes over the mesh the agent measures, over the last minute: rate, period, jitter and bandwidth; what was
    lost; and the one-way latency from the publisher's agent to this one, with the bound of what is known of the other
    machine's clock. It measures only while somebody here listens.
    """
    wanted = read_topic(topic)
    chosen, graph = _graph(master, agent)
    graph.require(wanted.topic)
    crossing = ask_agent(chosen, wanted.topic)
    if as_json:
        print_json(_topic_json(graph, wanted.topic) | {"mesh": crossing})
        return
    click.echo(f"Type: {printable(graph.types.get(wanted.topic, 'unknown'))}")
    if crossing is not None and crossing.md5:
        click.echo(f"MD5: {printable(crossing.md5)}")
    for title, nodes in (("Publishers", graph.publishers), ("Subscribers", graph.subscribers)):
        meant = [node for node in nodes.get(wanted.topic, []) if wanted.takes(node) or title == "Subscribers"]
        click.echo(f"\n{title}:" + ("" if meant else " none"))
        for node in meant:
            proxy = proxied_node(node)
            whence = "" if proxy is None else f"{proxy[1]} of peer {proxy[0]}, by its proxy "
            click.echo(f" * {printable(whence + node)}")
    if crossing is not None:
        _print_crossing(crossing, wanted)


def _print_crossing(crossing: TopicInfo, wanted: TopicName) -> None:
    click.echo("\nMesh:" + ("" if crossing.routes else " nothing of it crosses"))
    if crossing.policy:
        click.echo(f" * {'may cross' if crossing.crosses else 'stays home'}: {printable(crossing.policy)}")
    for route in crossing.routes:
        if wanted.peer not in (None, route.peer):
            continue
        way = "from" if route.direction == "in" else "to"
        last = "" if route.age is None else f", last {duration(route.age)} ago"
        click.echo(printable(f" * {way} {route.peer}: {route.node} {route.state}, {route.messages} messages{last}"))
        for label, text in facts(route):
            click.echo(printable(f"     {label:<10} {text}"))
        if route.problem:
            warn(printable(f"{route.peer} {route.node}: {route.problem}"))
    for trouble in (*crossing.mismatches, *crossing.unreachable):
        warn(printable(trouble))


@click.command("type", epilog="\b\nExamples:\n  rmpa topic type /cmd\n")
@click.argument("topic")
@json_option
@agent_option
@master_option
def type_(topic: str, as_json: bool, agent: str | None, master: str | None) -> None:
    """Print a topic's type."""
    wanted = read_topic(topic)
    _, graph = _graph(master, agent)
    graph.require(wanted.topic)
    kind = graph.types.get(wanted.topic)
    if kind is None:
        raise RmpaError(f"nobody has told the type of {wanted.topic} yet: its publisher does")
    if as_json:
        print_json({"name": wanted.topic, "type": kind})
    else:
        click.echo(printable(kind))


@click.command(epilog="\b\nExamples:\n  rmpa topic find sensor_msgs/Joy\n")
@click.argument("kind", metavar="TYPE")
@json_option
@agent_option
@master_option
def find(kind: str, as_json: bool, agent: str | None, master: str | None) -> None:
    """Print the topics of a TYPE."""
    _, graph = _graph(master, agent)
    found = [name for name in graph.topics if graph.types.get(name) == kind]
    if as_json:
        print_json(found)
    else:
        for name in found:
            click.echo(printable(name) + _mark(graph, name))
