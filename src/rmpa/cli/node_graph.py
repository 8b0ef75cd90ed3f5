"""``rmpa node list|info``: which nodes there are, in all modules."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING

import click

from rmpa.bridge.proxy_names import proxied_node
from rmpa.cli.master import choose_master, read_graph, read_topic
from rmpa.cli.node_names import ask_peer, find_uri, module_of, peers_nodes, read_node, troubles, uris_of
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import Column, coloured, print_json, print_table, printable, warn
from rmpa.core.errors import RmpaError
from rmpa.ros.core.node_calls import ping_node
from rmpa.ros.node_info import NodeFacts, NodeLine, describe_node, list_nodes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.cli.master import Graph, Master

CALLER_ID = "/rmpa_node"
_COLUMNS = (
    Column("NODE"),
    Column("MODULE"),
    Column("PUBLISHES", right=True),
    Column("SUBSCRIBES", right=True),
    Column("SERVICES", right=True),
    Column("URI"),
)


@click.command(
    "list", epilog="\b\nExamples:\n  rmpa node list\n  rmpa node list -v /camera\n  rmpa node list joystick:/\n"
)
@click.argument("namespace", default="")
@click.option("-v", "--verbose", is_flag=True, help="With module, counts of topics and services, and address.")
@json_option
@agent_option
@master_option
def list_(namespace: str, verbose: bool, as_json: bool, agent: str | None, master: str | None) -> None:
    """List the nodes of this module and of its peers, all or those of a NAMESPACE.

    Each linked peer is asked for its nodes, those too of which nothing crosses. A node of a peer is PEER:/node. One
    that cannot be reached is named on stderr.
    """
    chosen = choose_master(master, agent, os.environ)
    graph = asyncio.run(read_graph(chosen))
    wanted = read_topic(namespace, "node") if namespace else None
    peer = wanted.peer if wanted is not None else None
    found: list[tuple[str | None, NodeLine]] = []
    if peer is None:
        found += [(None, line) for line in _own(chosen, graph, with_uris=verbose or as_json)]
    found += peers_nodes(chosen, graph, peer)
    if wanted is not None and wanted.topic != "/":
        found = [(whose, line) for whose, line in found if f"{line.name}/".startswith(f"{wanted.topic}/")]
    if as_json or verbose:
        here = module_of(chosen)
        if as_json:
            print_json([_line_json(whose, line, here) for whose, line in found])
        else:
            print_table(_COLUMNS, [_row(whose, line, here) for whose, line in found])
    else:
        for whose, line in found:
            click.echo(_painted(whose, line.name))
    for whose, line in found:
        if line.problem:
            warn(printable(f"{_written(whose, line.name)} cannot be reached at {line.uri}: {line.problem}"))


def _own(master: Master, graph: Graph, *, with_uris: bool) -> list[NodeLine]:
    """The nodes of the graph without the proxies; addresses are asked for where they are wanted."""
    problems = {info.node: info.problem for info in troubles(master)}
    lines = list_nodes(graph.publishers, graph.subscribers, graph.services, {}, problems)
    names = [line.name for line in lines if proxied_node(line.name) is None]
    asked = names if with_uris else [name for name in names if name in problems]
    uris = asyncio.run(uris_of(master, asked)) if asked else {}
    lines = list_nodes(graph.publishers, graph.subscribers, graph.services, uris, problems)
    return [line for line in lines if proxied_node(line.name) is None]


def _written(peer: str | None, name: str) -> str:
    return name if peer is None else f"{peer}:{name}"


def _painted(peer: str | None, name: str) -> str:
    text = printable(_written(peer, name))
    return click.style(text, fg="cyan") if peer is not None and coloured() else text


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
    return [
        printable(_written(peer, line.name)),
        printable(peer or here or "-"),
        str(line.publications),
        str(line.subscriptions),
        str(line.services),
        printable(line.uri or "-"),
    ]


@click.command(epilog="\b\nExamples:\n  rmpa node info /talker\n  rmpa node info joystick:/joy_node --json\n")
@click.argument("node")
@json_option
@agent_option
@master_option
def info(node: str, as_json: bool, agent: str | None, master: str | None) -> None:
    """Show a node's module, address, process, topics and services, and whether it answers."""
    chosen = choose_master(master, agent, os.environ)
    wanted = read_node(node)
    if wanted.peer is not None:
        facts = ask_peer(chosen, wanted, "node.info", NodeFacts)
    else:
        facts = asyncio.run(_facts(chosen, wanted.topic))
    module = wanted.peer or module_of(chosen)
    if as_json:
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
    click.echo(f"Node: {printable(str(wanted))}")
    click.echo(f"Module: {printable(module or 'none, for no agent runs at this master')}")
    click.echo(f"URI: {printable(facts.uri)}")
    click.echo(f"Pid: {facts.pid if facts.pid is not None else 'it does not answer'}")
    for title, topics in (("Publications", facts.publications), ("Subscriptions", facts.subscriptions)):
        click.echo(f"\n{title}:" + ("" if topics else " none"))
        for topic, kind in topics.items():
            click.echo(printable(f" * {topic} [{kind if kind != '*' else 'unknown type'}]"))
    click.echo("\nServices:" + ("" if facts.services else " none"))
    for service in facts.services:
        click.echo(printable(f" * {service}"))
    if facts.problem:
        warn(printable(facts.problem))


async def _facts(master: Master, name: str) -> NodeFacts:
    from msgspec.structs import replace

    graph = await read_graph(master)
    uri = await find_uri(master, graph, name)
    facts = describe_node(name, uri, graph.publishers, graph.subscribers, graph.services, graph.types)
    try:
        return replace(facts, pid=(await ping_node(name, uri, CALLER_ID)).pid)
    except RmpaError as error:
        return replace(facts, problem=str(error))
