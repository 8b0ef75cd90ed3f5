"""``rmpa node``: lists nodes, shows one, asks whether it answers, and ends it.

``rmpa node ping|kill``: calls to the nodes themselves.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

import click

from rmpa.cli.options import (
    FiniteRange,
    GraphOptions,
    Selection,
    completes,
    graph_options,
    selection_options,
    summary,
)
from rmpa.cli.output import (
    Column,
    Graph,
    GraphName,
    print_json,
    print_line,
    print_table,
    printable,
    read_graph,
    read_name,
    read_namespace,
    require_peer,
    unknown_name,
    warn,
)
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.core.identity import is_own, proxied_node, proxied_peer
from rmpa.observe import limits as observe_limits
from rmpa.observe.control_client import ControlClient
from rmpa.ros import limits as ros_limits
from rmpa.ros.core.liveness import end_node, ping_node
from rmpa.ros.environment import NodeFacts, NodeLine, NodePing, PeerNodes, describe_node, list_nodes
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.master.mirror import lookup_calls, read_lookups

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rmpa.cli.output import Master
    from rmpa.observe.snapshot import UnreachableInfo


# Finds the node that a user names: in the master's graph, or at a peer by asking the agent.


_T = TypeVar("_T")
_CALLER_ID: Final = "/rmpa_node"
_NAMED: Final = 3
"""Modules that one line names."""


def read_node(text: str) -> GraphName:
    """Read ``NODE`` or ``PEER:NODE``; a proxy's name means the node that it stands for.

    Raises:
        ConfigError: It is no node's name.
    """
    wanted = read_name(text, "node")
    proxy = proxied_node(wanted.name) if wanted.peer is None else None
    return wanted if proxy is None else GraphName(proxy[1], proxy[0])


async def find_uri(master: Master, graph: Graph, name: str) -> str:
    """The URI of the slave API of a node of a master's graph.

    Raises:
        RmpaError: There is no such node; the text offers the nearest one.
    """
    reply = await call_api(master.uri, "lookupNode", _CALLER_ID, name)
    if reply.code == 1 and isinstance(reply.value, str):
        return reply.value
    raise unknown_name("node", name, [node for node in graph.nodes if proxied_peer(node) is None])


async def uris_of(master: Master, names: Sequence[str]) -> dict[str, str]:
    """The URIs of the slave APIs of several nodes, by one call; nodes that are not there are left out."""
    answer = await call(master.uri, "system.multicall", lookup_calls(_CALLER_ID, names, ()))
    return read_lookups(answer, names, ())[0]


def unreachable_nodes(master: Master) -> tuple[UnreachableInfo, ...]:
    """The nodes of the graph that the master's agent cannot connect to; none without an agent."""
    snapshot = master.snapshot(topics=(), peers=False)
    return snapshot.unreachable if snapshot is not None else ()


def module_of(master: Master) -> str | None:
    """The name of the master's agent, if it has one."""
    snapshot = master.snapshot(topics=(), peers=False)
    return snapshot.agent.name if snapshot is not None else None


def ask_peer(master: Master, wanted: GraphName, what: str, kind: type[_T]) -> _T:
    """Ask the agent of a node's module about the node, through the agent of this module.

    Args:
        master: This module's.
        wanted: The node, with its peer.
        what: ``node.info``, ``node.ping`` or ``node.kill``.
        kind: The type of the answer.

    Raises:
        UnreachableError: This master is not an agent's core.
        RmpaError: There is no such peer, it does not answer, or it refuses.
    """
    if master.agent is None:
        raise master.no_agent()
    with ControlClient(master.agent, timeout=observe_limits.CONTROL_HANDLER_TIMEOUT) as client:
        try:
            return client.call("node", kind, what=what, peer=wanted.peer, node=wanted.name)
        except PeerRefused as error:
            # The peer's agent refuses, not this one; its name is in the text.
            raise RmpaError(f"{error.reason}; {error.remedy}" if error.remedy else error.reason) from None


def _untold(told: Iterable[PeerNodes]) -> Iterator[str]:
    """Which modules do not tell their nodes, one line for all with the same reason."""
    reasons: dict[str, list[str]] = {}
    for one in told:
        if one.problem:
            reasons.setdefault(one.problem, []).append(one.peer)
    for reason, peers in reasons.items():
        first = ", ".join(peers[:_NAMED])
        if len(peers) == 1:
            yield f"{first} does not tell its nodes, only those that stand here: {reason}"
        else:
            names = f"{len(peers):,} modules ({first}, ...)" if len(peers) > _NAMED else first
            yield f"{names} do not tell their nodes, only those that stand here: {reason}"


def peers_nodes(master: Master, graph: Graph, peer: str | None) -> list[tuple[str | None, NodeLine]]:
    """The nodes of all peers, or of one; of those that no link leads to only those that have a proxy here.

    Modules behind a relay and other sites have no link; without an agent, or an answer, there is none either.

    Raises:
        RmpaError: The peer that was named is not linked, and has no proxy here.
    """
    proxied = [proxied_node(node) for node in graph.nodes]
    shown = [(one[0], NodeLine(name=one[1])) for one in proxied if one is not None and peer in (None, one[0])]
    if master.agent is None:
        return list(shown)
    with ControlClient(master.agent, timeout=observe_limits.CONTROL_HANDLER_TIMEOUT) as client:
        try:
            told = client.call("node", tuple[PeerNodes, ...], what="node.list", peer=peer)
        except PeerRefused:
            if peer is None or not shown:
                raise
            told = ()
    for line in _untold(told):
        warn(line)
    found: list[tuple[str | None, NodeLine]] = [(one.peer, line) for one in told for line in one.nodes]
    asked = {one.peer for one in told}
    found += [(name, line) for name, line in shown if name not in asked]
    return sorted(found, key=lambda one: one[0] or "")


CALLER_ID: Final = "/rmpa_node"
_ROSOUT: Final = "/rosout"


def _named(master: Master, names: tuple[str, ...], *, everything: bool) -> list[GraphName]:
    """The nodes that a command is about: the named ones, or all of this module except the agent's own and /rosout.

    Raises:
        ConfigError: Neither names nor ``--all`` are given, or both.
    """
    if everything is bool(names):
        raise ConfigError("NODE", "name some nodes, or say --all", "one of both")
    if names:
        return [read_node(name) for name in names]
    graph = asyncio.run(read_graph(master))
    return [read_node(node) for node in graph.nodes if not is_own(node) and node != _ROSOUT]


async def _uri(master: Master, name: str) -> str:
    return await find_uri(master, await read_graph(master), name)


@click.command(
    epilog="""\
\b
Examples:
  rmpa node ping /talker
  rmpa node ping joystick:/joy_node -c 3
  rmpa node ping --all                    each node of this module once
"""
)
@click.argument("node", default="", shell_complete=completes("node"))
@click.option("-c", "--count", type=click.IntRange(1), help="Stop after so many. [default: at Ctrl-C]")
@click.option("-i", "--interval", type=FiniteRange(0.01), default=1.0, show_default=True, help="Seconds between.")
@click.option("-a", "--all", "everything", is_flag=True, help="Each node of this module, once.")
@graph_options
def ping(node: str, count: int | None, interval: float, everything: bool, options: GraphOptions) -> int:
    """Ask whether a node answers, and how fast: a call of its slave API.

    The peer's agent asks a node of a peer: the time is that of the whole way, and in brackets that of the call on the
    node's own machine. Exits 1 if a node did not answer at all.
    """
    master = options.master()
    found = _named(master, (node,) if node else (), everything=everything)
    if node:
        require_peer(master, Graph(), found[0])
    if everything:
        answers = [_ping(master, one, 1, as_json=options.as_json) for one in found]
        return 0 if all(answers) else 1
    answered = sent = 0
    with contextlib.suppress(KeyboardInterrupt):
        while count is None or sent < count:
            if sent:
                time.sleep(interval)
            sent += 1
            answered += _ping(master, found[0], sent, as_json=options.as_json)
    return 0 if answered else 1


def _ping(master: Master, wanted: GraphName, number: int, *, as_json: bool) -> bool:
    """Ping a node once and print the result; return whether it answered."""
    begin = time.monotonic()
    try:
        if wanted.peer is not None:
            answer = ask_peer(master, wanted, "node.ping", NodePing)
        else:
            answer = asyncio.run(_ping_here(master, wanted.name))
    except RmpaError as error:
        if as_json:
            print_json({"node": str(wanted), "seq": number, "time": None, "error": str(error)})
        else:
            print_line(f"{wanted}: seq={number} {error}")
        return False
    taken = time.monotonic() - begin if wanted.peer is not None else answer.time
    if as_json:
        about = {"node": str(wanted), "seq": number, "time": taken, "node_time": answer.time}
        print_json(about | {"uri": answer.uri, "pid": answer.pid})
    else:
        there = f" ({answer.time * 1e3:.3f} ms there)" if wanted.peer is not None else ""
        text = f"{wanted} ({answer.uri}): seq={number} time={taken * 1e3:.3f} ms{there} pid={answer.pid}"
        print_line(text)
    return True


async def _ping_here(master: Master, name: str) -> NodePing:
    return await ping_node(name, await _uri(master, name), CALLER_ID)


@dataclass(frozen=True, slots=True)
class _Killed:
    """The outcome for one node; ``error`` is empty if the node has ended."""

    node: str
    error: str = ""


@click.command(
    epilog="""\
\b
Examples:
  rmpa node kill /talker
  rmpa node kill joystick:/joy_node base:/driver
  rmpa node kill --all                    every node of this module
"""
)
@click.argument("nodes", nargs=-1, metavar="NODE...", shell_complete=completes("node"))
@click.option("-a", "--all", "everything", is_flag=True, help="All of this module but /rosout and the agent's own.")
@graph_options
def kill(nodes: tuple[str, ...], everything: bool, options: GraphOptions) -> int:
    """Ask nodes to end, and wait until they have.

    The peer's agent ends a node of a peer, if `[nodes] kill` of its rmpa.toml allows it. Exits 1 if a node lives on.
    """
    master = options.master()
    found = [_kill(master, wanted) for wanted in _named(master, nodes, everything=everything)]
    if options.as_json:
        print_json([{"node": one.node, "killed": not one.error, "error": one.error or None} for one in found])
    for one in found:
        if one.error:
            click.echo(printable(f"rmpa: {one.node}: {one.error}"), err=True)
        elif not options.as_json:
            print_line(f"killed {one.node}")
    return int(any(one.error for one in found))


def _kill(master: Master, wanted: GraphName) -> _Killed:
    try:
        if wanted.peer is not None:
            gone = ask_peer(master, wanted, "node.kill", dict[str, bool]).get("gone", False)
        elif is_own(wanted.name):
            return _Killed(str(wanted), "it is the agent itself; end `rmpa up` instead")
        else:
            gone = asyncio.run(_kill_here(master, wanted.name))
    except RmpaError as error:
        return _Killed(str(wanted), str(error))
    still = f"it was asked to end, and is still there after {ros_limits.NODE_KILL_WAIT:g} s"
    return _Killed(str(wanted), "" if gone else still)


async def _kill_here(master: Master, name: str) -> bool:
    return await end_node(name, await _uri(master, name), CALLER_ID, "user request")


# ``rmpa node list|info``: the nodes of all modules.


GRAPH_CALLER_ID = "/rmpa_node"
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
        return replace(facts, pid=(await ping_node(name, uri, GRAPH_CALLER_ID)).pid)
    except RmpaError as error:
        return replace(facts, problem=str(error))
