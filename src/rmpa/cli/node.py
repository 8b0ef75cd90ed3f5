"""``rmpa node``: lists the nodes of all modules, shows one, asks whether it answers, sets its log, and ends it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.cli.graph import CALLER_ID, Graph, GraphName, Master, read_name
from rmpa.cli.options import (
    Options,
    Selection,
    argument,
    by_module,
    flag,
    graph_verb,
    nodes,
    ping_options,
    pings,
    selection_options,
)
from rmpa.cli.output import Table, Text, paint, print_error, print_json, print_text, warn
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.core.identity import is_own, proxied_node, proxied_peer
from rmpa.observe.limits import CONTROL_HANDLER_TIMEOUT
from rmpa.ros import limits as ros_limits
from rmpa.ros.environment import NodeFacts, NodeLine, NodePing, PeerNodes, list_nodes
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.master.mirror import lookup_calls, read_lookups
from rmpa.ros.node.ask import end_node, ping_node
from rmpa.ros.node.loggers import LEVELS, read_levels, set_level

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


_T = TypeVar("_T")
# A node and its peer; ``None``: this module's own.
_Line = tuple[str | None, NodeLine]
_ROSOUT: Final = "/rosout"
# Modules that one line names.
_NAMED: Final = 3


def _read_node(text: str) -> GraphName:
    """Read ``NODE`` or ``PEER:NODE``; a proxy's name means the node that it stands for.

    Raises:
        ConfigError: It is no node's name.
    """
    wanted = read_name(text, "node")
    proxy = proxied_node(wanted.name) if wanted.peer is None else None
    return wanted if proxy is None else GraphName(proxy[1], proxy[0])


def _module_of(master: Master) -> str | None:
    """The name of the master's agent, if it has one."""
    snapshot = master.snapshot(topics=(), peers=False)
    return snapshot.agent.name if snapshot is not None else None


def _ask_peer(master: Master, wanted: GraphName, what: str, kind: type[_T]) -> _T:
    """Ask the agent of a node's module about the node, through the agent of this module.

    Raises:
        UnreachableError: This master is not an agent's core.
        RmpaError: There is no such peer, it does not answer, or it refuses; in its own words.
    """
    with master.client(CONTROL_HANDLER_TIMEOUT) as client:
        return client.pass_on("node", kind, what=what, peer=wanted.peer, node=wanted.name)


def _untold(told: Iterable[PeerNodes]) -> Iterator[str]:
    """Which modules do not list their nodes, one line for all with the same reason."""
    reasons: dict[str, list[str]] = {}
    for one in told:
        if one.problem:
            reasons.setdefault(one.problem, []).append(one.peer)
    for reason, peers in reasons.items():
        first = ", ".join(peers[:_NAMED])
        who = f"{len(peers):,} modules ({first}, ...)" if len(peers) > _NAMED else first
        verb = "does not list its" if len(peers) == 1 else "do not list their"
        yield f"{who} {verb} nodes, only those with proxies here: {reason}"


def _of_peers(master: Master, graph: Graph, peer: str | None) -> list[_Line]:
    """The nodes of all peers, or of one; of those that no link leads to only those that have a proxy here.

    Modules behind a relay and other sites have no link; without an agent, or an answer, there is none either.

    Raises:
        RmpaError: The peer that was named is not linked, and has no proxy here.
    """
    proxied = [proxied_node(node) for node in graph.nodes]
    shown: list[_Line] = [(one[0], NodeLine(name=one[1])) for one in proxied if one and peer in (None, one[0])]
    if master.agent is None:
        return shown
    told: tuple[PeerNodes, ...] = ()
    try:
        with master.client(CONTROL_HANDLER_TIMEOUT) as client:
            told = client.call("node", tuple[PeerNodes, ...], what="node.list", peer=peer)
    except PeerRefused:
        if peer is None or not shown:
            raise
    for line in _untold(told):
        warn(line, "refused")
    asked = {one.peer for one in told}
    found: list[_Line] = [(one.peer, line) for one in told for line in one.nodes]
    found += [(name, line) for name, line in shown if name not in asked]
    return sorted(found, key=lambda one: one[0] or "")


def _named(master: Master, names: tuple[str, ...], *, everything: bool) -> list[GraphName]:
    """The nodes that a command is about: the named ones, or all of this module except the agent's own and /rosout.

    Raises:
        ConfigError: Neither names nor ``--all`` are given, or both.
    """
    if everything is bool(names):
        raise ConfigError("NODE", "name some nodes, or say --all", "one of both")
    if names:
        return [_read_node(name) for name in names]
    graph = asyncio.run(master.graph())
    return [_read_node(node) for node in graph.nodes if not is_own(node) and node != _ROSOUT]


@graph_verb(
    argument("node", nodes, default=""), ping_options, flag("-a --all everything", "Each node of this module, once.")
)
def node_ping(node: str, count: int | None, interval: float, everything: bool, options: Options) -> int:
    """Ask whether a node answers, and how fast: a call of its slave API.

    A node of a peer is asked by the peer's agent: the time is the whole round trip; in brackets is the time of the
    call on the node's own machine. Exits 1 if a node did not answer at all.

    ---

    Examples:
      rmpa node ping /talker
      rmpa node ping joystick:/joy_node -c 3
      rmpa node ping --all                    each node of this module once
    """
    master = options.master()
    found = _named(master, (node,) if node else (), everything=everything)
    if everything:
        answers = [_ping(master, one, 1, options) for one in found]
        return 0 if all(answers) else 1
    master.require_peer(Graph(), found[0])
    answered = False
    with contextlib.suppress(KeyboardInterrupt):
        for number in pings(count, interval):
            answered |= _ping(master, found[0], number, options)
    return 0 if answered else 1


def _ping(master: Master, wanted: GraphName, number: int, options: Options) -> bool:
    """Ping a node once and print the result; return whether it answered."""

    async def here() -> NodePing:
        uri = await master.node_uri(await master.graph(), wanted.name)
        return await ping_node(wanted.name, uri, CALLER_ID)

    about: dict[str, object] = {"node": str(wanted), "seq": number, "time": None}
    begin = time.monotonic()
    try:
        far = wanted.peer is not None
        answer = _ask_peer(master, wanted, "node.ping", NodePing) if far else asyncio.run(here())
    except RmpaError as error:
        options.show(about | {"error": str(error)}, f"{wanted}: seq={number} {error}")
        return False
    taken = time.monotonic() - begin if far else answer.time
    there = f" ({answer.time * 1e3:.3f} ms there)" if far else ""
    text = f"{wanted} ({answer.uri}): seq={number} time={taken * 1e3:.3f} ms{there} pid={answer.pid}"
    options.show(about | {"time": taken, "node_time": answer.time, "uri": answer.uri, "pid": answer.pid}, text)
    return True


@graph_verb(
    argument("nodes", nodes, nargs=-1, metavar="NODE..."),
    flag("-a --all everything", "All of this module but /rosout and the agent's own."),
)
def node_kill(nodes: tuple[str, ...], everything: bool, options: Options) -> int:
    """Ask nodes to end, and wait until they have ended.

    The peer's agent ends a node of a peer, if `[nodes] kill` of its rmpa.toml allows it. Exits 1 if a node still
    runs after 3 s, with the reason.

    ---
    `rosnode kill` of a proxy, /rmpa/PEER/node, ends the peer's node too, and prints "killed" even where that was
    refused. `rosnode kill -a` ends nodes of this module only.

    Examples:
      rmpa node kill /talker
      rmpa node kill joystick:/joy_node base:/driver
      rmpa node kill --all                    every node of this module
    """
    master = options.master()
    found = [(str(wanted), _kill(master, wanted)) for wanted in _named(master, nodes, everything=everything)]
    if options.as_json:
        print_json([{"node": node, "killed": not error, "error": error or None} for node, (error, _) in found])
    for node, (error, code) in found:
        if error:
            print_error(f"{node}: {error}", code)
        elif not options.as_json:
            print_text(f"killed {node}")
    return int(any(error for _, (error, _) in found))


def _kill(master: Master, wanted: GraphName) -> tuple[str, str]:
    """End a node; return why it lives on, with the code, or empty texts."""

    async def here() -> bool:
        uri = await master.node_uri(await master.graph(), wanted.name)
        return await end_node(wanted.name, uri, CALLER_ID, "user request")

    try:
        if wanted.peer is not None:
            gone = _ask_peer(master, wanted, "node.kill", dict[str, bool]).get("gone", False)
        elif is_own(wanted.name):
            return "it is the agent itself; end `rmpa up` instead", "refused"
        else:
            gone = asyncio.run(here())
    except RmpaError as error:
        return str(error), error.code
    still = f"it was asked to end, and still runs after {ros_limits.NODE_KILL_WAIT:g} s"
    return ("", "") if gone else (still, "node-killed")


@graph_verb(
    argument("namespace", nodes, default=""),
    flag("-v --verbose", "With module, address, and counts of topics and services."),
    selection_options,
)
def node_list(namespace: str, verbose: bool, selection: Selection, options: Options) -> None:
    """List the nodes of this module and of its peers, all or those of a NAMESPACE.

    Each linked peer is asked for its nodes, including those of which nothing crosses. A node of a peer is written
    PEER:/node. A node that cannot be reached is named on stderr.

    ---

    Examples:
      rmpa node list
      rmpa node list -v /camera
      rmpa node list joystick:/
    """
    master, graph = options.graph()
    wanted = read_name(namespace or "/", "node")
    found: list[_Line] = []
    if wanted.peer is None:
        found += [(None, line) for line in _own(master, graph, with_uris=verbose or options.as_json)]
    found += _of_peers(master, graph, wanted.peer)
    every = [
        (peer, line)
        for peer, line in found
        if wanted.contains(line.name, (peer,)) and selection.wants(line.name, (peer,))
    ]
    shown = selection.first(every, lambda one: one[0] is not None)  # this module's own are the first
    here = _module_of(master) if options.as_json or verbose else None

    def text() -> Iterator[Text]:
        about = by_module("nodes", [peer is not None for peer, _ in every])
        lines: Text = (paint(str(GraphName(line.name, peer)), "cyan" if peer else None) for peer, line in shown)
        if verbose:
            lines = Table("NODE, MODULE, >PUB, >SUB, >SRV, URI", [_row(peer, line, here) for peer, line in shown])
        filters = "rmpa node list MODULE:/, /NAMESPACE, --match '*driver*'"
        yield selection.framed(every, "nodes", about, filters, lines)

    options.show([_json(peer, line, here) for peer, line in shown], text())
    for peer, line in shown:
        if line.problem:
            warn(f"{GraphName(line.name, peer)} cannot be reached at {line.uri}: {line.problem}", "node-unreachable")


def _own(master: Master, graph: Graph, *, with_uris: bool) -> list[NodeLine]:
    """The nodes of the graph without the proxies; the master is asked for addresses only where they are shown."""
    snapshot = master.snapshot(topics=(), peers=False)
    problems = {info.node: info.problem for info in (snapshot.unreachable if snapshot is not None else ())}
    names = [node for node in graph.nodes if proxied_peer(node) is None]
    asked = names if with_uris else [name for name in names if name in problems]
    uris: dict[str, str] = {}
    if asked:
        answer = asyncio.run(call(master.uri, "system.multicall", lookup_calls(CALLER_ID, asked, ())))
        uris = read_lookups(answer, asked, ())[0]
    lines = list_nodes(graph.publishers, graph.subscribers, graph.services, uris, problems)
    return [line for line in lines if proxied_peer(line.name) is None]


def _json(peer: str | None, line: NodeLine, here: str | None) -> dict[str, object]:
    about = {"name": line.name, "peer": peer, "module": peer if peer is not None else here, "uri": line.uri or None}
    counts = {"publications": line.publications, "subscriptions": line.subscriptions, "services": line.services}
    return {**about, **counts, "problem": line.problem or None}


def _row(peer: str | None, line: NodeLine, here: str | None) -> list[str]:
    counts = map(str, (line.publications, line.subscriptions, line.services))
    return [str(GraphName(line.name, peer)), peer or here or "-", *counts, line.uri or "-"]


@graph_verb(argument("node", nodes))
def node_info(node: str, options: Options) -> None:
    """Show a node's module, address, process, topics and services, and whether it answers.

    ---

    Examples:
      rmpa node info /talker
      rmpa node info joystick:/joy_node --json
    """
    master = options.master()
    wanted = _read_node(node)

    async def here() -> NodeFacts:
        return await master.node_facts(await master.graph(), wanted.name)

    facts = _ask_peer(master, wanted, "node.info", NodeFacts) if wanted.peer is not None else asyncio.run(here())
    module = wanted.peer or _module_of(master)

    def text() -> Iterator[str]:
        yield f"Node: {wanted}"
        yield f"Module: {module or 'none, for no agent runs at this master'}"
        yield f"URI: {facts.uri}"
        yield f"Pid: {facts.pid if facts.pid is not None else 'it does not answer'}"
        for title, topics in (("Publications", facts.publications), ("Subscriptions", facts.subscriptions)):
            yield from ("", f"{title}:" + ("" if topics else " none"))
            yield from (f" * {topic} [{kind if kind != '*' else 'unknown type'}]" for topic, kind in topics.items())
        yield from ("", "Services:" + ("" if facts.services else " none"))
        yield from (f" * {service}" for service in facts.services)
        if facts.problem:
            warn(facts.problem, "node-unreachable")

    about = {"name": facts.name, "peer": wanted.peer, "module": module, "uri": facts.uri, "pid": facts.pid}
    reached = {"reachable": not facts.problem, "problem": facts.problem or None}
    ends = {"publications": facts.publications, "subscriptions": facts.subscriptions, "services": facts.services}
    options.show({**about, **reached, **ends}, text())


@graph_verb(argument("node", nodes), argument("logger", default=""), argument("level", default=""))
def node_log_level(node: str, logger: str, level: str, options: Options) -> None:
    """Show the levels of a node's loggers, or set one.

    Without LOGGER the LEVEL (debug, info, warn, error or fatal) is that of the node's own code: the logger rosout of
    rospy, ros of roscpp. The agent of a peer is PEER:/rmpa. A level applies until the node ends.

    ---
    In a secured mesh the peer needs a [[permission]] log.

    Examples:
      rmpa node log-level /talker
      rmpa node log-level base:/driver debug
      rmpa node log-level base:/rmpa rmpa.mesh debug
    """
    master, wanted = options.master(), _read_node(node)
    if not level and logger.lower() in LEVELS:
        logger, level = "", logger
    level = level.lower()
    if logger and not level:
        raise ConfigError("LEVEL", f"{logger!r} is not a level", f"write LOGGER and one of {', '.join(LEVELS)}")
    if level and level not in LEVELS:
        raise ConfigError("LEVEL", f"{level!r} is not a level", f"use one of {', '.join(LEVELS)}")
    if wanted.peer is not None:
        with master.client(CONTROL_HANDLER_TIMEOUT) as client:
            args = {"peer": wanted.peer, "node": wanted.name, "logger": logger, "level": level}
            levels = client.pass_on("log_level", dict[str, str], **args)
    else:
        levels = asyncio.run(_levels(master, wanted.name, logger, level))
    about = {"node": wanted.name, "peer": wanted.peer, "loggers": levels}
    if level:
        options.show(about, f"{' and '.join(levels)} of {wanted}: {level}")
    elif levels:
        options.show(about, Table("LOGGER, LEVEL", sorted(levels.items())))
    else:
        options.show(about, f"{wanted} has no loggers")


async def _levels(master: Master, node: str, logger: str, level: str) -> dict[str, str]:
    reply = await call_api(master.uri, "lookupService", CALLER_ID, f"{node}/get_loggers")
    api = await master.node_uri(await master.graph(), node)
    if reply.code != 1 or not isinstance(reply.value, str):
        raise RmpaError(f"{node} has no loggers: it does not provide {node}/get_loggers", code="unknown-name")
    if level:
        return await set_level(reply.value, node, CALLER_ID, logger, level)
    return await read_levels(reply.value, api, node, CALLER_ID)
