"""Finds the node that a user names: in the master's graph, or at a peer through the agent."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Final, TypeVar

from rmpa.bridge.proxy_names import proxied_node
from rmpa.cli.master import TopicName, read_topic
from rmpa.cli.output import printable, warn
from rmpa.config.values import did_you_mean
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.observe import limits
from rmpa.observe.io.control_client import ControlClient
from rmpa.observe.snapshot import Snapshot, UnreachableInfo
from rmpa.ros.http.client import call, call_api
from rmpa.ros.master.survey import lookup_calls, read_lookups
from rmpa.ros.node_info import NodeLine, PeerNodes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.cli.master import Graph, Master

_T = TypeVar("_T")
_CALLER_ID: Final = "/rmpa_node"


def read_node(text: str) -> TopicName:
    """Read ``NODE`` or ``PEER:NODE``; the name of a proxy means the node that it stands for.

    Raises:
        ConfigError: It is no node's name.
    """
    wanted = read_topic(text, "node")
    proxy = proxied_node(wanted.topic) if wanted.peer is None else None
    return wanted if proxy is None else TopicName(proxy[1], proxy[0])


def nodes_of(graph: Graph) -> list[str]:
    """The names of all nodes, in order."""
    tables = (graph.publishers, graph.subscribers, graph.services)
    return sorted({node for table in tables for nodes in table.values() for node in nodes})


async def find_uri(master: Master, graph: Graph, name: str) -> str:
    """The slave API of a node of a master's graph.

    Raises:
        RmpaError: There is no such node; the nearest one is offered.
    """
    reply = await call_api(master.uri, "lookupNode", _CALLER_ID, name)
    if reply.code == 1 and isinstance(reply.value, str):
        return reply.value
    near = did_you_mean(name, [node for node in nodes_of(graph) if proxied_node(node) is None])
    raise RmpaError(f"no node {name}; " + (f"did you mean {near}?" if near else "`rmpa node list` shows all"))


async def uris_of(master: Master, names: Sequence[str]) -> dict[str, str]:
    """The slave APIs of many nodes at once, of those that are there."""
    answer = await call(master.uri, "system.multicall", lookup_calls(_CALLER_ID, names, ()))
    return read_lookups(answer, names, ())[0]


def troubles(master: Master) -> tuple[UnreachableInfo, ...]:
    """The nodes of the graph that the master's agent cannot connect to; none where it has no agent."""
    snapshot = _brief(master)
    return snapshot.unreachable if snapshot is not None else ()


def module_of(master: Master) -> str | None:
    """The name of the master's agent, if it has one."""
    snapshot = _brief(master)
    return snapshot.agent.name if snapshot is not None else None


def _brief(master: Master) -> Snapshot | None:
    if master.agent is not None:
        with contextlib.suppress(RmpaError), ControlClient(master.agent) as client:
            return client.call("snapshot", Snapshot, topics=())
    return None


def ask_peer(master: Master, wanted: TopicName, what: str, kind: type[_T]) -> _T:
    """Ask the agent of a node's module, through the agent of this one.

    Raises:
        UnreachableError: This master is no agent's.
        RmpaError: There is no such peer, it does not answer, or it says no.
    """
    if master.agent is None:
        remedy = "name the agent with --agent, or run `rmpa up`: only an agent knows peers"
        raise UnreachableError("agent", f"{master.uri} ({master.source})", remedy)
    with ControlClient(master.agent, timeout=limits.CONTROL_HANDLER_TIMEOUT) as client:
        try:
            return client.call("node", kind, what=what, peer=wanted.peer, node=wanted.topic)
        except PeerRefused as error:
            # Not this agent says no, but the peer's, whose name is in the text.
            raise RmpaError(f"{error.reason}; {error.remedy}" if error.remedy else error.reason) from None


def peers_nodes(master: Master, graph: Graph, peer: str | None) -> list[tuple[str | None, NodeLine]]:
    """The nodes of all peers, or of one: as they tell, or else as far as this graph shows them.

    Raises:
        RmpaError: The peer that was named is not linked.
    """
    if master.agent is None:
        shown = [proxied_node(node) for node in nodes_of(graph)]
        return [(one[0], NodeLine(name=one[1])) for one in shown if one is not None and peer in (None, one[0])]
    with ControlClient(master.agent, timeout=limits.CONTROL_HANDLER_TIMEOUT) as client:
        told = client.call("node", tuple[PeerNodes, ...], what="node.list", peer=peer)
    for one in told:
        if one.problem:
            warn(printable(f"{one.peer} does not tell its nodes, only those that stand here: {one.problem}"))
    return [(one.peer, line) for one in sorted(told, key=lambda one: one.peer) for line in one.nodes]
