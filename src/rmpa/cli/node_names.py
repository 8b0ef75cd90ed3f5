"""Finds the node that a user names: in the master's graph, or at a peer by asking the agent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.bridge.proxies import proxied_node, proxied_peer
from rmpa.cli.graph import GraphName, read_name, unknown_name
from rmpa.cli.output import warn
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.observe import limits
from rmpa.observe.control_client import ControlClient
from rmpa.ros.environment import NodeLine, PeerNodes
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.master.mirror import lookup_calls, read_lookups

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rmpa.cli.graph import Graph
    from rmpa.cli.master import Master
    from rmpa.observe.snapshot import UnreachableInfo

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
    with ControlClient(master.agent, timeout=limits.CONTROL_HANDLER_TIMEOUT) as client:
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
    with ControlClient(master.agent, timeout=limits.CONTROL_HANDLER_TIMEOUT) as client:
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
