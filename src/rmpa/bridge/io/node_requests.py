"""The peers' requests about this module's nodes: list, describe, ping and end them."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.io.proxy_kills import KILL
from rmpa.bridge.permission_gate import OPEN_GATE, Needs, PermissionGate
from rmpa.bridge.policy import OWN_NODE, is_own
from rmpa.bridge.proxy_names import proxied_node
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import Access
from rmpa.config.values import did_you_mean
from rmpa.core.errors import RmpaError
from rmpa.core.identity import is_global_name, matches
from rmpa.ros.core.liveness import end_node, node_connections, ping_node
from rmpa.ros.environment import NodeEnd, NodeFacts, NodeLine, NodePing, describe_node, list_nodes
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.ros.core.api import Core

_log = logging.getLogger(__name__)

LIST: Final = "node.list"
"""The request for a module's own nodes."""
INFO: Final = "node.info"
"""The request for the facts about a ``node``: ``NodeFacts``."""
PING: Final = "node.ping"
"""The request to ping a ``node``."""
_VISIBLE: Final = Needs(
    (Access.SUBSCRIBE, Access.PUBLISH, Access.CALL),
    "what the node publishes, subscribes to and provides: the rest is left out, and nodes of which nothing is left",
)
REPLIES: Final[dict[str, object]] = {LIST: tuple[NodeLine, ...], INFO: NodeFacts, PING: NodePing, KILL: NodeEnd}
"""The type of each response; ``KILL`` ends a ``node``, where ``nodes.kill`` allows it."""


class NodeRequests:
    """Answers the peers' requests about this module's nodes.

    Args:
        settings: The agent's settings.
        core: The local core.
        asks: Receives the requests.
        gate: Decides which nodes each peer may end.
    """

    def __init__(self, settings: Settings, core: Core, asks: PeerRpc, gate: PermissionGate = OPEN_GATE) -> None:
        self._gate = gate
        self._settings = settings
        self._core = core
        asks.on_request(LIST, self._list, _VISIBLE)
        asks.on_request(INFO, self._info, _VISIBLE)
        asks.on_request(PING, self._ping, _VISIBLE)
        asks.on_request(KILL, self._kill, Needs((Access.KILL,), "the node"))

    def reload(self, settings: Settings) -> None:
        """Take new settings."""
        self._settings = settings

    def _list(self, asker: PeerSession, _args: dict[str, Any]) -> tuple[NodeLine, ...]:
        state, peer = self._core.state(), asker.link.name
        problems = {node: found.problem for node, found in self._core.unreachable().items()}
        publishers, subscribers, services = self._tables(peer)
        found = list_nodes(publishers, subscribers, services, state.nodes, problems, yielding_to_data)
        return tuple(line for line in found if not is_own(line.name))

    def _tables(self, peer: str) -> list[Mapping[str, Collection[str]]]:
        """The nodes by published topic, by subscribed topic and by service: by those that a peer may have."""
        state = self._core.state()
        tables: list[Mapping[str, Collection[str]]] = [state.publishers, state.subscribers, state.services]
        if not self._gate.on:
            return tables
        return [
            {
                name: nodes
                for name, nodes in yielding_to_data(list(table.items()))
                if self._gate.judge(access, peer, name).allowed
            }
            for access, table in zip((Access.SUBSCRIBE, Access.PUBLISH, Access.CALL), tables, strict=True)
        ]

    def visible(self, peer: str) -> Collection[str]:
        """The nodes that a peer is told of: those of which it may have something."""
        if not self._gate.on:
            return self._core.state().nodes
        return {node for table in self._tables(peer) for nodes in yielding_to_data(table.values()) for node in nodes}

    async def _info(self, asker: PeerSession, args: dict[str, Any]) -> NodeFacts:
        self._own(args, self.visible(asker.link.name))
        return self._permitted(asker.link.name, await self.info(args))

    async def info(self, args: Mapping[str, object]) -> NodeFacts:
        """The facts about the ``node`` of this module that a request names.

        Raises:
            RmpaError: There is no such node.
        """
        node, uri = self._own(args)
        state = self._core.state()
        facts = describe_node(node, uri, state.publishers, state.subscribers, state.services, state.types)
        try:
            answer = await ping_node(node, uri, OWN_NODE)
        except RmpaError as error:
            return msgspec.structs.replace(facts, problem=str(error))
        names = {address: name for name, address in state.nodes.items()}
        connections = await node_connections(uri, OWN_NODE, names)
        return msgspec.structs.replace(facts, pid=answer.pid, connections=connections)

    def _permitted(self, asker: str, facts: NodeFacts) -> NodeFacts:
        """The facts about a node, without the names of what a peer may not have."""

        def may(access: Access, name: str) -> bool:
            return self._gate.judge(access, asker, name).allowed

        connections = facts.connections
        if connections is not None:
            needed = {True: Access.PUBLISH, False: Access.SUBSCRIBE}
            connections = tuple(one for one in connections if may(needed[one.inbound], one.topic))
        return msgspec.structs.replace(
            facts,
            publications={name: kind for name, kind in facts.publications.items() if may(Access.SUBSCRIBE, name)},
            subscriptions={name: kind for name, kind in facts.subscriptions.items() if may(Access.PUBLISH, name)},
            services=tuple(name for name in facts.services if may(Access.CALL, name)),
            connections=connections,
        )

    async def _ping(self, asker: PeerSession, args: dict[str, Any]) -> NodePing:
        node, uri = self._own(args, self.visible(asker.link.name))
        return await ping_node(node, uri, OWN_NODE)

    async def _kill(self, asker: PeerSession, args: dict[str, Any]) -> NodeEnd:
        peer = asker.link.name
        named = str(args.get("node"))[: config_limits.CROSSING_NAME_MAX]
        if why := self._gate.why_not(Access.KILL, peer, named):
            raise RmpaError(why)  # before whether there is such a node
        nodes = [node for node in self._core.state().nodes if self._gate.judge(Access.KILL, peer, node).allowed]
        node, uri = self._own(args, nodes)
        who = f"{peer}'s {str(args.get('by', ''))[: bridge_limits.ASK_NAME_MAX]}"
        here = self._settings.name
        if not any(matches(glob, node) for glob in self._settings.nodes.kill):
            _log.warning("! %s may not end %s: no glob of nodes.kill fits", who, node)
            raise RmpaError(f"no glob of nodes.kill in the rmpa.toml of {here} fits {node}; allow it there")
        _log.warning("= %s ends %s", who, node)
        gone = await end_node(node, uri, OWN_NODE, f"killed by {who}")
        self._core.suspect(node)  # roscpp does not unregister when it ends in a hurry
        return NodeEnd(gone=gone)

    def _own(self, args: Mapping[str, object], told: Collection[str] | None = None) -> tuple[str, str]:
        """The node of this module that a request names, and its slave API.

        Args:
            args: The request's.
            told: The nodes that may be told of; ``None``: all.

        Raises:
            RmpaError: There is no such node.
        """
        here = self._settings.name
        node = args.get("node")
        if not isinstance(node, str) or len(node) > config_limits.CROSSING_NAME_MAX or not is_global_name(node):
            raise RmpaError("the question names no node")
        if is_own(node):
            origin = proxied_node(node)
            whose = f"it is {origin[0]}'s {origin[1]}: ask there" if origin is not None else "it is its agent"
            raise RmpaError(f"{node} is no node of {here}: {whose}")
        nodes = self._core.state().nodes
        known = nodes if told is None else told
        if node not in known or node not in nodes:
            near = did_you_mean(node, [name for name in known if not is_own(name)])
            raise RmpaError(f"{here} has no node {node}" + (f"; did you mean {near}?" if near else ""))
        return node, nodes[node]
