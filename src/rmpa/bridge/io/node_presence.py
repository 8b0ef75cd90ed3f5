"""Nodes of which nothing crosses: each peer is told of them, and they stand in every graph by their proxies.

Topics and services bring the proxies of their nodes. A node that only subscribes, or whose services stay home, would
not be known to ``rosnode`` in the other modules. Its proxy is registered with one service of its own,
``~get_loggers``, as every ROS node has it: no publisher, relay or subscriber takes notice of that.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.messages import is_crossing_name
from rmpa.bridge.permission_gate import Needs
from rmpa.bridge.policy import Policy, is_own
from rmpa.bridge.session.part import Part
from rmpa.bridge.session.peer_proxies import ProxyCallbacks
from rmpa.bridge.topics.io.direct_importer import MEASURING
from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.node.service_server import ServiceEndpoint
from rmpa.ros.node.slave_node import GET
from rmpa.ros.wire.tcpros import LENGTH

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from rmpa.bridge.services.io.part import Services
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.bridge.topics.io.part import Topics
    from rmpa.config.settings import Settings
    from rmpa.ros.core.api import Core
    from rmpa.ros.master.parameters import GraphChange
    from rmpa.ros.node.service_server import ServiceCall
    from rmpa.ros.node.slave_node import SlaveNode

NODES: Final = "nodes"
"""The notification of the sender's nodes of which nothing crosses: ``nodes``, their names."""
_HELD: Final = "node"
_EVERYWHERE: Final = "/rosout"
"""Every module has this node."""
_NO_LOGGERS: Final = LENGTH.pack(0)


class NodePresence(Part):
    """The part of the bridge that tells of nodes and shows those of peers.

    Args:
        core: The local core.
        sessions: The peers.
        rpc: Sends and receives the notifications.
        topics: The part with the topics' plans.
        services: The part with the services' plans.
        settings: The agent's settings: ``limits.nodes`` bounds how many are shown of one peer, and told to it.
        visible: ``(peer) -> nodes``: which nodes a peer may know of.
    """

    def __init__(
        self,
        core: Core,
        sessions: PeerSessions,
        rpc: PeerRpc,
        topics: Topics,
        services: Services,
        settings: Settings,
        visible: Callable[[str], Collection[str]],
    ) -> None:
        self._core = core
        self._sessions = sessions
        self._rpc = rpc
        self._topics = topics
        self._services = services
        self._max = settings.limits.nodes
        self._policy = Policy(settings.policy, settings.peers, settings.time)
        self._visible = visible
        self._told: dict[int, tuple[str, ...]] = {}
        """What each linked peer was told, by the number of its session."""
        self._shown: dict[int, set[str]] = {}
        """The nodes that each peer has told of."""
        self._soon: asyncio.TimerHandle | None = None
        rpc.on_notification(NODES, self._told_by_peer, Needs((), "names of the peer's own nodes"))

    async def close(self) -> None:
        """Tell nothing any more."""
        if self._soon is not None:
            self._soon.cancel()

    def reload(self, settings: Settings) -> None:
        """Take other rules for peers, and another limit."""
        self._max = settings.limits.nodes
        self._policy = Policy(settings.policy, settings.peers, settings.time)
        self._later()

    def graph_changed(self, change: GraphChange) -> None:
        """Tell the peers soon, unless it was a proxy that came or went."""
        if not is_own(change.node):
            self._later()

    def reconcile(self) -> None:
        """Register missing proxies again: the core has been restarted."""
        services = self._core.state().services
        for peer, nodes in self._shown.items():
            session = self._sessions.get(peer)
            for node in nodes:
                proxy = session.proxies.get(node) if session is not None else None
                if proxy is not None and _service(proxy) not in services:
                    self._register(proxy)

    # --- to the peers -------------------------------------------------------------------------------------------

    def link_up(self, session: PeerSession) -> None:
        """Tell a peer with a new link."""
        self._told.pop(session.peer, None)
        self._later()

    def link_down(self, session: PeerSession) -> None:
        """Forget what a peer was told: it is told anew over its next link."""
        self._told.pop(session.peer, None)

    def _later(self) -> None:
        """In a moment: a node that starts registers its loggers first, and then perhaps a topic that crosses."""
        if self._soon is None:
            self._soon = asyncio.get_running_loop().call_later(limits.NODES_PAUSE, self._tell)

    def _tell(self) -> None:
        if self._soon is not None:
            self._soon.cancel()
            self._soon = None
        crossing = {source.node for source in self._topics.exports.offered}
        crossing |= {server.node for server in self._services.exports.offered.values()}
        nodes = [
            node
            for node in self._core.state().nodes
            if node not in crossing
            and node != _EVERYWHERE
            and not is_own(node)
            and not node.startswith(MEASURING)
            and is_crossing_name(node)
        ]
        for session in self._sessions.linked():
            peer = session.link.name
            visible = self._visible(peer)
            names = tuple(sorted(one for one in nodes if one in visible and self._passes(peer, one))[: self._max])
            if names != self._told.get(session.peer):  # over a new link also that there are none any more
                self._told[session.peer] = names
                self._rpc.notify(session, NODES, {"nodes": list(names)})

    def _passes(self, peer: str, node: str) -> bool:
        """Whether the rules for a peer let a node's name cross, as they do its topics and services."""
        return self._policy.judge_for(peer, node, wire=node).allowed

    # --- of the peers -------------------------------------------------------------------------------------------

    def _told_by_peer(self, session: PeerSession, args: dict[str, Any]) -> None:
        told = args.get("nodes")
        names: list[Any] = told[: self._max] if isinstance(told, list) else [None]
        if not all(isinstance(name, str) and is_crossing_name(name) for name in names):
            raise RemoteProtocolError(f"{NODES} has no list of nodes' names")
        wanted = {name for name in names if self._passes(session.link.name, name)}
        shown = self._shown.setdefault(session.peer, set())
        for node in sorted(shown - wanted):
            session.proxies.release(node, _HELD)
        for node in sorted(wanted - shown):
            session.proxies.hold(node, _HELD, ProxyCallbacks(self._show, self._hide))
        self._shown[session.peer] = wanted

    def gone(self, session: PeerSession) -> None:
        """Forget a peer; its proxies go with its session."""
        self._told.pop(session.peer, None)
        for node in self._shown.pop(session.peer, ()):
            session.proxies.release(node, _HELD)

    def _show(self, proxy: SlaveNode) -> None:
        proxy.add_service(ServiceEndpoint(_service(proxy), proxy.name, _answer, description=GET))
        self._register(proxy)

    def _register(self, proxy: SlaveNode) -> None:
        self._core.call("registerService", proxy.name, _service(proxy), proxy.service_uri, proxy.uri)

    def _hide(self, proxy: SlaveNode) -> None:
        self._core.call("unregisterService", proxy.name, _service(proxy), proxy.service_uri)
        proxy.remove_service(_service(proxy))


def _service(proxy: SlaveNode) -> str:
    return f"{proxy.name}/get_loggers"


def _answer(call: ServiceCall) -> None:
    """No logger of a node of another module is set from here."""
    call.reply(True, _NO_LOGGERS)
