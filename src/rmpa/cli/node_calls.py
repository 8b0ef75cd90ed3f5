"""``rmpa node ping|kill``: calls to the nodes themselves."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import click

from rmpa.bridge.policy import is_own
from rmpa.cli.graph import Graph, read_graph, require_peer
from rmpa.cli.node_names import ask_peer, find_uri, read_node
from rmpa.cli.options import FiniteRange, GraphOptions, completes, graph_options
from rmpa.cli.output import print_json, print_line, printable
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.ros import limits
from rmpa.ros.core.liveness import end_node, ping_node
from rmpa.ros.environment import NodeEnd, NodePing

if TYPE_CHECKING:
    from rmpa.cli.graph import GraphName
    from rmpa.cli.master import Master

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
            gone = ask_peer(master, wanted, "node.kill", NodeEnd).gone
        elif is_own(wanted.name):
            return _Killed(str(wanted), "it is the agent itself; end `rmpa up` instead")
        else:
            gone = asyncio.run(_kill_here(master, wanted.name))
    except RmpaError as error:
        return _Killed(str(wanted), str(error))
    still = f"it was asked to end, and is still there after {limits.NODE_KILL_WAIT:g} s"
    return _Killed(str(wanted), "" if gone else still)


async def _kill_here(master: Master, name: str) -> bool:
    return await end_node(name, await _uri(master, name), CALLER_ID, "user request")
