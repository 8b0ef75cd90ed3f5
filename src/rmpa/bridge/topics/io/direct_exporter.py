"""The publisher's side of direct transport for topics: grants subscribers of peers a connection to a local node."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

from rmpa.bridge import limits
from rmpa.bridge.direct import requests
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet, reply_of, unmet_by_contract, unmet_by_trust
from rmpa.bridge.direct.direct_route import Interruptions
from rmpa.bridge.direct.io.nodes import end_from
from rmpa.bridge.direct.publisher_side import DirectGrants, EndConnections, Granted, Retry, WithdrawGrant
from rmpa.bridge.direct.requests import DirectClosed, RetryDirect
from rmpa.bridge.messages import Source
from rmpa.bridge.permission_gate import OPEN_GATE, Needs, PermissionGate
from rmpa.bridge.policy import is_own
from rmpa.bridge.session.peer_proxies import ProxyCallbacks
from rmpa.bridge.topics.audience import compares_names
from rmpa.config.permission_rules import Access
from rmpa.core.contract import combine
from rmpa.ros.master.effects import GraphChange, RegistrationKind
from rmpa.ros.wire.tcpros import ANY

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.bridge.direct.io.endpoints import LocalEndpoints
    from rmpa.bridge.direct.publisher_side import GrantAction
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.bridge.topics.exports import Exports
    from rmpa.core.contract import Contracts
    from rmpa.core.counters import Counters
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.slave_node import SlaveNode

_log = logging.getLogger(__name__)


class DirectExporter:
    """Answers the peers' requests for direct connections, and withdraws what was granted.

    Args:
        core: The local core.
        exports: Knows what is offered to each peer.
        contracts: The contracts of this module; replaced by ``reload``.
        endpoints: Finds the ports of local nodes.
        sessions: The peers.
        rpc: Carries the requests.
        counters: Count ``direct.granted``, ``direct.withdrawn``, ``direct.ended``.
        gate: Whether the mesh is secured.
    """

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
        self._gate = gate
        self._core = core
        self._exports = exports
        self._contracts = contracts
        self._endpoints = endpoints
        self._sessions = sessions
        self._rpc = rpc
        self._counters = counters
        self.grants = DirectGrants(self._changed)
        """The grants in force."""
        self.interruptions = Interruptions()
        """When peers' subscribers were without a grant because their link was lost."""
        self._standing: dict[tuple[int, str, str], set[Source]] = {}
        """By peer, subscriber and topic: the granted sources for which the subscriber's proxy is registered."""
        self._expiries: dict[int, asyncio.TimerHandle] = {}
        rpc.on_request(requests.OPEN, self._open, Needs((Access.SUBSCRIBE,), "the topic: only what is offered"))
        rpc.on_notification(requests.CLOSE, self._close, Needs((), "what was granted to the peer itself"))

    def reload(self, contracts: Contracts) -> None:
        """Take new contracts, and withdraw the grants that they do not allow."""
        self._contracts = contracts
        self._act(self.grants.retry_all())
        self._act(self.grants.judge_again(self._unmet_by_rules, secured=self._gate.on))

    def graph_changed(self, change: GraphChange) -> None:
        """Compare the grants with a registration that came or went; the exports have not looked at it yet."""
        if change.kind is RegistrationKind.SUBSCRIBER and not is_own(change.node):
            if change.added:
                self._act(self.grants.local_subscriber(change.name, change.node))
            else:
                self._act(self.grants.local_subscriber_gone(change.name))
        elif change.kind is RegistrationKind.PUBLISHER:
            source = Source(change.name, change.node)
            if not change.added:
                self._endpoints.forget(change.api)
                self.grants.gone(source)
            else:
                self._act(self.grants.published(source, change.api))

    def policy_changed(self) -> None:
        """Withdraw the grants for sources that are not offered any more to their peers."""
        self._act(self.grants.judge_again(self._unmet_by_rules, secured=self._gate.on))

    def link_up(self, session: PeerSession) -> None:
        """Let the peer ask again for what it uses; the other grants from before its link end a little later."""
        self.grants.link_up(session.peer)
        loop = asyncio.get_running_loop()
        expire = loop.call_later(limits.DIRECT_ADOPT, lambda: self._act(self.grants.expire(session.peer)))
        self._expiries[session.peer] = expire

    def link_down(self, session: PeerSession, *, crashed: bool) -> None:
        """End the publishers' connections to a peer that cannot be reached.

        A peer that left in order, or whose agent alone has died, has nodes that go on. So do the nodes of another
        module on that host.
        On this machine no connection outlives its process, and the nodes of all modules have the same address.
        """
        if (expiry := self._expiries.pop(session.peer, None)) is not None:
            expiry.cancel()
        now = asyncio.get_running_loop().time()
        for source, peer, subscriber, _ in self.grants if not crashed else ():
            if peer == session.peer:
                self.interruptions.begin(session.link.name, source, subscriber, now)
        shared = any(other.address == session.address for other in self._sessions.reachable() if other is not session)
        if session.link.silent and not crashed and not session.same_machine and not shared:
            self._act(self.grants.unreachable(session.peer))

    def gone(self, session: PeerSession) -> None:
        """Forget the grants of a peer."""
        if (expiry := self._expiries.pop(session.peer, None)) is not None:
            expiry.cancel()
        self._act(self.grants.peer_gone(session.peer))

    async def close(self) -> None:
        """Cancel the questions to local nodes; direct connections go on."""
        for expiry in self._expiries.values():
            expiry.cancel()
        self._expiries.clear()
        await self._endpoints.close()

    # --- the local graph --------------------------------------------------------------------------------------------

    def _changed(self, peer: int, source: Source, subscriber: str, granted: bool) -> None:
        """Has the proxy of a peer's subscriber stand in the graph as a subscriber while it is granted."""
        key = (peer, subscriber, source.topic)
        sources = self._standing.setdefault(key, set())
        before = bool(sources)
        (sources.add if granted else sources.discard)(source)
        if not sources:
            del self._standing[key]
        session = self._sessions.get(peer)
        if session is None or before == bool(sources):
            return  # with the session its proxies go
        held, topic = f"subscriber of {source.topic}", source.topic
        if sources:
            user = ProxyCallbacks(lambda proxy: self._stand(topic, proxy), lambda proxy: self._go(topic, proxy))
            session.proxies.hold(subscriber, held, user)
        else:
            session.proxies.release(subscriber, held)

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

    # --- requests --------------------------------------------------------------------------------------------------

    async def _open(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        asked = requests.read_open(args)
        found = await self._find(session, asked)
        if isinstance(found, Unmet):
            _log.debug("< %s: %s of %s is relayed: %s", session.link.name, asked.source, asked.subscriber, found.text)
        return reply_of(found)

    async def _find(self, session: PeerSession, asked: requests.OpenDirect) -> Grant | Unmet:
        source = asked.source
        unmet = self._unmet(session, source, asked)
        if unmet is not None:
            return self._refused(session, asked, unmet)
        uri = self._uri(source)
        found = await self._endpoints.of_topic(session, source.node, uri, source.topic)
        if isinstance(found, Unmet):
            return self._refused(session, asked, found)
        # The graph may have changed meanwhile.
        unmet = self._unmet(session, source, asked)
        if unmet is None and self._uri(source) != uri:
            unmet = Unmet(Condition.NODE, f"{source.node} has restarted just now")
        if unmet is not None:
            return self._refused(session, asked, unmet)
        granted = Granted(asked.contract, found.port, uri)
        self.grants.grant(session.peer, source, asked.subscriber, granted)
        now = asyncio.get_running_loop().time()
        self.interruptions.end(session.link.name, source, asked.subscriber, now)
        self._counters.add("direct.granted")
        _log.debug("< %s: %s connects to %s directly", session.link.name, asked.subscriber, source)
        return found

    def _refused(self, session: PeerSession, asked: requests.OpenDirect, unmet: Unmet) -> Unmet:
        # A peer is not told of a topic that it may not have. Of one that it may have, the advertisement tells it.
        hidden = self._gate.on and self._exports.local(session.peer, asked.source) is None
        self._act(self.grants.refused(session.peer, asked.source, asked.subscriber, hidden=hidden))
        return unmet

    def _uri(self, source: Source) -> str:
        """The slave API of a publisher now; the exports learn a new one a little later."""
        return self._core.publishers(source.topic).get(source.node, "")

    def _unmet(self, session: PeerSession, source: Source, asked: requests.OpenDirect) -> Unmet | None:
        unmet = self._unmet_by_rules(source, session.peer, Granted(asked.contract, 0, ""))
        if unmet is not None:
            return unmet
        if not self._uri(source):
            return Unmet(Condition.OFFERED, f"{source.node} has just left")
        subscribers = self._core.subscribers(source.topic)
        return self.grants.judge(session.peer, source, asked.subscriber, subscribers)

    def _unmet_by_rules(self, source: Source, peer: int, granted: Granted) -> Unmet | None:
        """The condition that a source does not meet for a peer, whatever the subscriber's name is."""
        local = self._exports.local(peer, source)
        if local is None:
            return Unmet(Condition.OFFERED, f"{source} is not offered")
        if local != source:
            return Unmet(Condition.NAME, f"it is {local.topic} in the publisher's module")
        offered = self._exports.offered[source]
        if offered.origin is not None:
            return Unmet(Condition.OWN_SOURCE, "it comes by a relay")
        if compares_names(offered.type):
            return Unmet(Condition.ACTION, f"actions compare the names of the nodes at {offered.type}")
        where = "the publisher's module"
        contract = combine(self._contracts.of(source.topic, offered.type), granted.asked)
        return unmet_by_contract(contract, where) or self._unmet_by_trust(peer, where)

    def _unmet_by_trust(self, peer: int, where: str) -> Unmet | None:
        session = self._sessions.get(peer)
        same_machine = session is not None and session.same_machine
        return unmet_by_trust(self._gate, where, same_machine=same_machine)

    def _close(self, session: PeerSession, args: dict[str, Any]) -> None:
        closed = requests.read_close(args)
        if closed.broken and self.grants.has(session.peer, closed.source, closed.subscriber):
            self._endpoints.forget(self._uri(closed.source))
            self._core.suspect(closed.node)
        self._act(self.grants.release(session.peer, closed.source, closed.subscriber))

    # --- carrying out ----------------------------------------------------------------------------------------------

    def _act(self, actions: Iterable[GrantAction]) -> None:
        for action in actions:
            session = self._sessions.get(action.peer)
            if session is None:
                continue
            match action:
                case EndConnections() if session.same_machine:
                    pass  # all nodes of this machine have one address
                case EndConnections():
                    self._counters.add("direct.ended")
                    if problem := end_from(action.port, session.address):
                        text = "! %s: connections of local nodes to it may hang: they cannot be ended (%s)"
                        _log.info(text, session.link.name, problem)
                case WithdrawGrant(source=source) if session.linked:
                    self._counters.add("direct.withdrawn")
                    closed = DirectClosed(
                        source.topic,
                        source.node,
                        action.subscriber,
                        action.unmet.condition.value,
                        action.unmet.text,
                    )
                    self._rpc.notify(session, requests.CLOSED, requests.write(closed))
                case Retry(source=source) if session.linked:
                    again = RetryDirect(source.topic, source.node)
                    self._rpc.notify(session, requests.RETRY, requests.write(again))
                case _:
                    pass
