"""``rmpa node list|info``: the nodes of all modules."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from rmpa.bridge.proxies import proxied_peer
from rmpa.cli.graph import GraphName, read_graph, read_namespace
from rmpa.cli.node_names import ask_peer, find_uri, module_of, peers_nodes, read_node, unreachable_nodes, uris_of
from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import Column, print_json, print_line, print_table, warn
from rmpa.cli.selection import Selection, selection_options, summary
from rmpa.core.errors import RmpaError
from rmpa.ros.core.liveness import ping_node
from rmpa.ros.environment import NodeFacts, NodeLine, describe_node, list_nodes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.cli.graph import Graph
    from rmpa.cli.master import Master

CALLER_ID = "/rmpa_node"
_COLUMNS = (
    Column("NODE"),
    Column("MODULE"),
    Column("PUB", right=True),
    Column("SUB", right=True),
    Column("SRV", right=True),
    Column("URI"),
)


@click.command(
    "list", epilog="\b\nExamples:\n  rmpa node list\n  rmpa node list -v /camera\n  rmpa node list joystick:/\n"
)
@click.argument("namespace", default="", shell_complete=completes("node"))
@click.option("-v", "--verbose", is_flag=True, help="With module, address, and counts of topics and services.")
@selection_options
@graph_options
def list_(namespace: str, verbose: bool, selection: Selection, options: GraphOptions) -> None:
    """List the nodes of this module and of its peers, all or those of a NAMESPACE.

    Each linked peer is asked for its nodes, including those of which nothing crosses. A node of a peer is written
    PEER:/node. A node that cannot be reached is named on stderr.
    """
    master, graph = options.graph()
    wanted = read_namespace(namespace, "node")
    found: list[tuple[str | None, NodeLine]] = []
    if wanted.peer is None:
        found += [(None, line) for line in _own(master, graph, with_uris=verbose or options.as_json)]
    found += peers_nodes(master, graph, wanted.peer)
    fitting = set(selection.names({line.name for _, line in found}))
    found = every = [
        (peer, line)
        for peer, line in found
        if wanted.contains(line.name, (peer,)) and line.name in fitting and selection.wants_peer(peer)
    ]
    if not options.as_json and selection.is_long(found):
        found = [*selection.shown(found)]  # this module's own are the first
        click.echo(summary(len(every), "nodes", ("remote" if peer else "of this module" for peer, _ in every)) + "\n")
    if options.as_json or verbose:
        here = module_of(master)
        if options.as_json:
            print_json([_line_json(peer, line, here) for peer, line in found])
        else:
            print_table(_COLUMNS, [_row(peer, line, here) for peer, line in found])
    else:
        for peer, line in found:
            print_line(str(GraphName(line.name, peer)), "cyan" if peer is not None else None)
    if not options.as_json:
        selection.print_rest(every, "nodes", "rmpa node list MODULE:/, /NAMESPACE, --match '*driver*'")
    for peer, line in found:
        if line.problem:
            warn(f"{GraphName(line.name, peer)} cannot be reached at {line.uri}: {line.problem}")


def _own(master: Master, graph: Graph, *, with_uris: bool) -> list[NodeLine]:
    """The nodes of the graph without the proxies; the master is asked for addresses only where they are shown."""
    problems = {info.node: info.problem for info in unreachable_nodes(master)}
    names = [node for node in graph.nodes if proxied_peer(node) is None]
    asked = names if with_uris else [name for name in names if name in problems]
    uris = asyncio.run(uris_of(master, asked)) if asked else {}
    lines = list_nodes(graph.publishers, graph.subscribers, graph.services, uris, problems)
    return [line for line in lines if proxied_peer(line.name) is None]


def _line_json(peer: str | None, line: NodeLine, here: str | None) -> dict[str, object]:
    return {
        "name": line.name,
        "peer": peer,
        "module": peer if peer is not None else here,
        "uri": line.uri or None,
        "publications": line.publications,
        "subscriptions": line.subscriptions,
        "services": line.services,
        "problem": line.problem or None,
    }


def _row(peer: str | None, line: NodeLine, here: str | None) -> Sequence[str]:
    counts = map(str, (line.publications, line.subscriptions, line.services))
    return [str(GraphName(line.name, peer)), peer or here or "-", *counts, line.uri or "-"]


@click.command(epilog="\b\nExamples:\n  rmpa node info /talker\n  rmpa node info joystick:/joy_node --json\n")
@click.argument("node", shell_complete=completes("node"))
@graph_options
def info(node: str, options: GraphOptions) -> None:
    """Show a node's module, address, process, topics and services, and whether it answers."""
    master = options.master()
    wanted = read_node(node)
    if wanted.peer is not None:
        facts = ask_peer(master, wanted, "node.info", NodeFacts)
    else:
        facts = asyncio.run(_facts(master, wanted.name))
    module = wanted.peer or module_of(master)
    if options.as_json:
        about: dict[str, object] = {
            "name": facts.name,
            "peer": wanted.peer,
            "module": module,
            "uri": facts.uri,
            "pid": facts.pid,
        }
        about |= {"reachable": not facts.problem, "problem": facts.problem or None}
        about |= {"publications": facts.publications, "subscriptions": facts.subscriptions}
        print_json(about | {"services": facts.services})
        return
    print_line(f"Node: {wanted}")
    print_line(f"Module: {module or 'none, for no agent runs at this master'}")
    print_line(f"URI: {facts.uri}")
    click.echo(f"Pid: {facts.pid if facts.pid is not None else 'it does not answer'}")
    for title, topics in (("Publications", facts.publications), ("Subscriptions", facts.subscriptions)):
        click.echo(f"\n{title}:" + ("" if topics else " none"))
        for topic, kind in topics.items():
            print_line(f" * {topic} [{kind if kind != '*' else 'unknown type'}]")
    click.echo("\nServices:" + ("" if facts.services else " none"))
    for service in facts.services:
        print_line(f" * {service}")
    if facts.problem:
        warn(facts.problem)


async def _facts(master: Master, name: str) -> NodeFacts:
    from msgspec.structs import replace

    graph = await read_graph(master)
    uri = await find_uri(master, graph, name)
    facts = describe_node(name, uri, graph.publishers, graph.subscribers, graph.services, graph.types)
    try:
        return replace(facts, pid=(await ping_node(name, uri, CALLER_ID)).pid)
    except RmpaError as error:
        return replace(facts, problem=str(error))
