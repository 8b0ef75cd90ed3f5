"""Nodes across modules: the control socket's op ``node``, and the peers' questions about this module's nodes."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.io.node_shutdown import KILL
from rmpa.bridge.policy import OWN_NODE, is_own
from rmpa.bridge.proxy_names import proxied_node
from rmpa.config import limits as config_limits
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.core.names import is_global_name, matches
from rmpa.ros.core.node_calls import end_node, ping_node
from rmpa.ros.node_info import NodeEnd, NodeFacts, NodeLine, NodePing, PeerNodes, describe_node, list_nodes
from rmpa.runtime.event_loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.io.bridge import Bridge
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.ros.core.api import Core

_log = logging.getLogger(__name__)

LIST: Final = "node.list"
"""The question to a peer: its module's own nodes (``NodeLine``, a list)."""
INFO: Final = "node.info"
"""The question to a peer: what is known of its ``node`` (``NodeFacts``)."""
PING: Final = "node.ping"
"""The question to a peer: does its ``node`` answer (``NodePing``)."""
QUESTIONS: Final = (LIST, INFO, PING, KILL)


class NodeRequests:
    """Answers questions about this module's nodes, and passes those about others' on.

    Args:
        settings: The agent's.
        core: Its ROS core.
        bridge: Its bridge.
        attached: Finds the linked peer that a user names; raises if there is none.
    """

    def __init__(
        self, settings: Settings, core: Core, bridge: Bridge, attached: Callable[[str], PeerSession]
    ) -> None:
        self._settings = settings
        self._core = core
        self._bridge = bridge
        self._attached = attached
        bridge.asks.on(LIST, self._list)
        bridge.asks.on(INFO, self._info)
        bridge.asks.on(PING, self._ping)
        bridge.asks.on(KILL, self._kill)

    def reload(self, settings: Settings) -> None:
        """Other settings hold from now on."""
        self._settings = settings

    # --- the control socket --------------------------------------------------------------------------------------

    async def ask(self, args: dict[str, object]) -> Any:
        """Pass a question on to a peer, ``{peer, what, node}``; or without a peer: list the nodes of all peers.

        Raises:
            ConfigError: It is no question of ours.
            UnreachableError: There is no such peer.
            PeerRefused: The peer says no.
        """
        what, peer = str(args.get("what", "")), args.get("peer")
        if what not in QUESTIONS:
            near = did_you_mean(what, QUESTIONS)
            raise ConfigError("what", f"{what!r} is no question", f"did you mean {near}?" if near else "")
        if peer is None:
            everyone = list(self._bridge.attached())
            return await asyncio.gather(*(self._list_of(attached) for attached in everyone))
        attached = self._attached(str(peer))
        if what == LIST:
            return [await self._list_of(attached)]
        question = {"node": str(args.get("node", "")), "by": OWN_NODE, "reason": "user request"}
        return await self._bridge.asks.ask(attached, what, question, bridge_limits.NODE_KILL_TIMEOUT)

    async def _list_of(self, attached: PeerSession) -> PeerNodes:
        peer = attached.link.name
        try:
            value = await self._bridge.asks.ask(attached, LIST, {})
            return PeerNodes(peer=peer, nodes=msgspec.convert(value, tuple[NodeLine, ...]))
        except (RmpaError, msgspec.ValidationError) as error:
            nodes = tuple(NodeLine(name=node) for node, _ in attached.proxies)
            return PeerNodes(peer=peer, nodes=nodes, problem=str(error))

    # --- the peers' questions ------------------------------------------------------------------------------------

    def _list(self, _asker: PeerSession, _args: dict[str, Any]) -> tuple[NodeLine, ...]:
        state = self._core.state()
        problems = {node: found.problem for node, found in self._core.unreachable().items()}
        tables = (state.publishers, state.subscribers, state.services)
        found = list_nodes(*tables, state.nodes, problems, yielding_to_data)
        return tuple(line for line in found if not is_own(line.name))

    async def _info(self, _asker: PeerSession, args: dict[str, Any]) -> NodeFacts:
        node, uri = self._own(args)
        state = self._core.state()
        facts = describe_node(node, uri, state.publishers, state.subscribers, state.services, state.types)
        try:
            answer = await ping_node(node, uri, OWN_NODE)
        except RmpaError as error:
            return msgspec.structs.replace(facts, problem=str(error))
        return msgspec.structs.replace(facts, pid=answer.pid)

    async def _ping(self, _asker: PeerSession, args: dict[str, Any]) -> NodePing:
        node, uri = self._own(args)
        return await ping_node(node, uri, OWN_NODE)

    async def _kill(self, asker: PeerSession, args: dict[str, Any]) -> NodeEnd:
        node, uri = self._own(args)
        who = f"{asker.link.name}'s {str(args.get('by', ''))[: bridge_limits.ASK_NAME_MAX]}"
        here = self._settings.name
        if not any(matches(glob, node) for glob in self._settings.nodes.kill):
            _log.warning("! %s may not end %s: no glob of nodes.kill fits", who, node)
            raise RmpaError(f"no glob of nodes.kill in the rmpa.toml of {here} fits {node}; allow it there")
        _log.warning("= %s ends %s", who, node)
        gone = await end_node(node, uri, OWN_NODE, f"killed by {who}")
        self._core.suspect(node)  # roscpp's leaves its registrations behind if it ends in a hurry
        return NodeEnd(gone=gone)

    def _own(self, args: dict[str, Any]) -> tuple[str, str]:
        """The node of this module that a question names, and its slave API.

        Raises:
            RmpaError: There is none of that name.
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
        if node not in nodes:
            near = did_you_mean(node, [name for name in nodes if not is_own(name)])
            raise RmpaError(f"{here} has no node {node}" + (f"; did you mean {near}?" if near else ""))
        return node, nodes[node]
