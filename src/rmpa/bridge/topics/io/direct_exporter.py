"""The publisher's side of direct transport for topics: grants subscribers of peers a connection to a local node.

A rospy publisher keeps one connection for each caller id: a second subscriber of that name closes the first one's
connection without a word (docs/design/ros-traps.md, trap 12). Therefore a name is granted once for each source, and
not at all while a local node of that name subscribes to the topic.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.bridge.direct.conditions import Condition, Grant, Unmet, unmet_by_contract
from rmpa.bridge.direct.grants import Grants
from rmpa.bridge.direct.paths import Interruptions
from rmpa.bridge.messages import Source
from rmpa.bridge.permission_gate import OPEN_GATE, Needs, PermissionGate
from rmpa.bridge.policy import is_own
from rmpa.bridge.session.peer_proxies import ProxyCallbacks
from rmpa.bridge.topics.audience import compares_names
from rmpa.config.peer_rules import Access
from rmpa.core.contract import combine
from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.wire.tcpros import ANY

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.direct.io.endpoints import LocalEndpoints
    from rmpa.bridge.direct.requests import DirectAsk, Want
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.bridge.topics.exports import Exports
    from rmpa.core.contract import Contracts
    from rmpa.core.counters import Counters
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.slave_node import SlaveNode


class DirectExporter(Grants):
    """The direct connections of peers' subscribers to local publishers.

    Args:
        core: The local core.
        exports: Knows what is offered to each peer.
        contracts: The contracts of this module; replaced by ``reload``.
        endpoints: Finds the ports of local nodes.
        sessions: The peers.
        rpc: Carries the requests.
        counters: Count ``direct.granted`` and ``direct.ended``.
        gate: Whether the mesh is secured.
    """

    kind = "topic"

    def __init__(
        self,
        core: Core,
        exports: Exports,
        contracts: Contracts,
        endpoints: LocalEndpoints,
        sessions: PeerSessions,
        rpc: PeerRpc,
        counters: Counters,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        super().__init__(sessions, rpc, counters, gate)
        rpc.on_request("direct.topic", self._ask, Needs((Access.SUBSCRIBE,), "the topic: only what is offered"))
        rpc.on_notification("direct.topic_release", self._released, Needs((), "what was granted to the peer itself"))
        self._core = core
        self._exports = exports
        self._contracts = contracts
        self._endpoints = endpoints
        self.interruptions = Interruptions()
        """When peers' subscribers were without a grant because their link was lost."""
        self._standing: dict[tuple[int, str, str], set[str]] = {}
        """By peer, subscriber and topic: the granted nodes for which the subscriber's proxy is registered."""

    def reload(self, contracts: Contracts) -> None:
        """Take new contracts, and end what they do not allow."""
        self._contracts = contracts
        self.judge_again()

    def graph_changed(self, change: GraphChange) -> None:
        """Have peers ask again for what a registration that came or went touches."""
        if change.kind is RegistrationKind.SUBSCRIBER and not is_own(change.node):
            self._again(lambda want: (want.name, want.user) == (change.name, change.node))
        elif change.kind is RegistrationKind.PUBLISHER:
            self._endpoints.forget(change.api)
            self._again(lambda want: (want.name, want.node) == (change.name, change.node))

    def link_down(self, session: PeerSession, *, crashed: bool) -> None:
        """As of ``Grants``."""
        now = asyncio.get_running_loop().time()
        for peer, want, _ in self if not crashed else ():
            if peer == session.peer:
                self.interruptions.begin(session.link.name, want, now)
        super().link_down(session, crashed=crashed)

    async def close(self) -> None:
        """Cancel the questions to local nodes; direct connections go on."""
        await self._endpoints.close()

    # --- the local graph --------------------------------------------------------------------------------------------

    def _changed(self, session: PeerSession, want: Want, *, granted: bool) -> None:
        """Has the proxy of a peer's subscriber stand in the graph as a subscriber while it is granted."""
        key = (session.peer, want.user, want.name)
        nodes = self._standing.setdefault(key, set())
        before = bool(nodes)
        (nodes.add if granted else nodes.discard)(want.node)
        if not nodes:
            del self._standing[key]
        if granted:
            self.interruptions.end(session.link.name, want, asyncio.get_running_loop().time())
        if before == bool(nodes):
            return
        held, topic = f"subscriber of {want.name}", want.name
        if nodes:
            user = ProxyCallbacks(lambda proxy: self._stand(topic, proxy), lambda proxy: self._go(topic, proxy))
            session.proxies.hold(want.user, held, user)
        else:
            session.proxies.release(want.user, held)

    def _stand(self, topic: str, proxy: SlaveNode) -> None:
        self._core.call("registerSubscriber", proxy.name, topic, ANY, proxy.uri)

    def _go(self, topic: str, proxy: SlaveNode) -> None:
        self._core.call("unregisterSubscriber", proxy.name, topic, proxy.uri)

    def reconcile(self, subscribers: Mapping[str, Mapping[str, str]]) -> None:
        """Register missing subscribers again: the core has been restarted."""
        for peer, subscriber, topic in list(self._standing):
            session = self._sessions.get(peer)
            proxy = session.proxies.get(subscriber) if session is not None else None
            if proxy is not None and proxy.name not in subscribers.get(topic, {}):
                self._stand(topic, proxy)

    # --- conditions -------------------------------------------------------------------------------------------------

    def _uri(self, want: Want) -> str:
        """The slave API of a publisher now; the exports learn a new one a little later."""
        return self._core.publishers(want.name).get(want.node, "")

    async def _find(self, session: PeerSession, want: Want) -> Grant | Unmet:
        uri = self._uri(want)
        found = await self._endpoints.of_topic(session, want.node, uri, want.name)
        if self._uri(want) not in {uri, ""}:
            return Unmet(Condition.NODE, f"{want.node} has restarted just now")
        return found

    def _broke(self, want: Want) -> None:
        self._endpoints.forget(self._uri(want))
        self._core.suspect(want.node)

    def _unmet(self, session: PeerSession, asked: DirectAsk) -> Unmet | None:
        if asked.contract is None:
            raise RemoteProtocolError("direct transport: a topic is asked for without a contract")
        source, where = Source(asked.name, asked.node), "the publisher's module"
        local = self._exports.local(session.peer, source)
        if local is None:
            return Unmet(Condition.OFFERED, f"{source} is not offered")
        if local != source:
            return Unmet(Condition.NAME, f"it is {local.topic} in the publisher's module")
        offered = self._exports.offered[source]
        if offered.origin is not None:
            return Unmet(Condition.OWN_SOURCE, "it comes by a relay")
        if compares_names(offered.type):
            return Unmet(Condition.ACTION, f"actions compare the names of the nodes at {offered.type}")
        contract = combine(self._contracts.of(source.topic, offered.type), asked.contract)
        unmet = unmet_by_contract(contract, where) or self._unmet_by_trust(session, where)
        if unmet is not None:
            return unmet
        if not self._uri(asked.want):
            return Unmet(Condition.NODE, f"{source.node} has just left")
        if asked.user in self._core.subscribers(source.topic):
            return Unmet(Condition.CALLER_ID, f"a node {asked.user} of the publisher's module subscribes too")
        return None
