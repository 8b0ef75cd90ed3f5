"""``rmpa node ping|kill``: calls to the nodes themselves."""

from __future__ import annotations

import asyncio
import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import click

from rmpa.bridge.policy import is_own
from rmpa.cli.master import choose_master, read_graph
from rmpa.cli.node_names import ask_peer, find_uri, nodes_of, read_node
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import print_json, print_line, printable
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.ros import limits
from rmpa.ros.core.node_calls import end_node, ping_node
from rmpa.ros.node_info import NodeEnd, NodePing

if TYPE_CHECKING:
    from rmpa.cli.master import Master, TopicName

CALLER_ID: Final = "/rmpa_node"
_ROSOUT: Final = "/rosout"


def _named(master: Master, names: tuple[str, ...], *, everything: bool) -> list[TopicName]:
    """The nodes that a command is about: those named, or all of this module but the agent's own.

    Raises:
        ConfigError: Neither or both were said.
    """
    if everything is bool(names):
        raise ConfigError("NODE", "name some nodes, or say --all", "one of both")
    if names:
        return [read_node(name) for name in names]
    graph = asyncio.run(read_graph(master))
    return [read_node(node) for node in nodes_of(graph) if not is_own(node) and node != _ROSOUT]


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
@click.argument("node", default="")
@click.option("-c", "--count", type=click.IntRange(1), help="Stop after so many. [default: at Ctrl-C]")
@click.option(
    "-i", "--interval", type=click.FloatRange(0.01), default=1.0, show_default=True, help="Seconds between."
)
@click.option("-a", "--all", "everything", is_flag=True, help="Each node of this module, once.")
@json_option
@agent_option
@master_option
def ping(
    node: str,
    count: int | None,
    interval: float,
    everything: bool,
    as_json: bool,
    agent: str | None,
    master: str | None,
) -> int:
    """Ask whether a node answers, and how fast: a call of its slave API.

    A node of a peer is asked by the peer's agent: the time is that of the whole way there, and in brackets that of
    the call on its own machine. Exits 1 if one did not answer at all.
    """
    chosen = choose_master(master, agent, os.environ)
    found = _named(chosen, (node,) if node else (), everything=everything)
    if everything:
        silent = [one for one in found if not _ping(chosen, one, 1, as_json=as_json)]
        return int(bool(silent))
    answered = sent = 0
    try:
        while count is None or sent < count:
            if sent:
                time.sleep(interval)
            sent += 1
            answered += _ping(chosen, found[0], sent, as_json=as_json)
    except KeyboardInterrupt:
        pass
    return 0 if answered else 1


def _ping(master: Master, wanted: TopicName, number: int, *, as_json: bool) -> bool:
    """One attempt; whether it was answered."""
    begin = time.monotonic()
    try:
        if wanted.peer is not None:
            answer = ask_peer(master, wanted, "node.ping", NodePing)
        else:
            answer = asyncio.run(_ping_here(master, wanted.topic))
    except RmpaError as error:
        if as_json:
            print_json({"node": str(wanted), "seq": number, "time": None, "error": str(error)}, flush=True)
        else:
            print_line(printable(f"{wanted}: seq={number} {error}"))
        return False
    taken = time.monotonic() - begin if wanted.peer is not None else answer.time
    if as_json:
        about = {"node": str(wanted), "seq": number, "time": taken, "node_time": answer.time}
        print_json(about | {"uri": answer.uri, "pid": answer.pid}, flush=True)
    else:
        there = f" ({answer.time * 1e3:.3f} ms there)" if wanted.peer is not None else ""
        text = f"{wanted} ({answer.uri}): seq={number} time={taken * 1e3:.3f} ms{there} pid={answer.pid}"
        print_line(printable(text))
    return True


async def _ping_here(master: Master, name: str) -> NodePing:
    return await ping_node(name, await _uri(master, name), CALLER_ID)


@dataclass(frozen=True, slots=True)
class _Killed:
    """What became of one node; ``error`` is empty if it has ended."""

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
@click.argument("nodes", nargs=-1, metavar="NODE...")
@click.option("-a", "--all", "everything", is_flag=True, help="All of this module but /rosout and the agent's own.")
@json_option
@agent_option
@master_option
def kill(nodes: tuple[str, ...], everything: bool, as_json: bool, agent: str | None, master: str | None) -> int:
    """Ask nodes to end, and wait until they have.

    A node of a peer is ended by the peer's agent, if `[nodes] kill` of its rmpa.toml lets it. Exits 1 if one lives
    on.
    """
    chosen = choose_master(master, agent, os.environ)
    found = [_kill(chosen, wanted) for wanted in _named(chosen, nodes, everything=everything)]
    if as_json:
        print_json([{"node": one.node, "killed": not one.error, "error": one.error or None} for one in found])
    for one in found:
        if one.error:
            click.echo(printable(f"rmpa: {one.node}: {one.error}"), err=True)
        elif not as_json:
            click.echo(printable(f"killed {one.node}"))
    return int(any(one.error for one in found))


def _kill(master: Master, wanted: TopicName) -> _Killed:
    try:
        if wanted.peer is not None:
            gone = ask_peer(master, wanted, "node.kill", NodeEnd).gone
        elif is_own(wanted.topic):
            return _Killed(str(wanted), "it is the agent itself; end `rmpa up` instead")
        else:
            gone = asyncio.run(_kill_here(master, wanted.topic))
    except RmpaError as error:
        return _Killed(str(wanted), str(error))
    still = f"it was asked to end, and is still there after {limits.NODE_KILL_WAIT:g} s"
    return _Killed(str(wanted), "" if gone else still)


async def _kill_here(master: Master, name: str) -> bool:
    return await end_node(name, await _uri(master, name), CALLER_ID, "user request")
