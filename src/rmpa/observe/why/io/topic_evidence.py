"""What this agent knows of a topic on its path: for its own user, and for the agent at the other end."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from rmpa.bridge.messages import Source
from rmpa.bridge.policy import Policy, is_own
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import Access
from rmpa.config.values import did_you_mean
from rmpa.core.contract import Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_global_name
from rmpa.observe import limits as observe_limits
from rmpa.observe.why.diagnosis import (
    ProxyState,
    PublisherReport,
    SubscriberConnection,
    TopicAtPublisher,
    TopicAtSubscriber,
)
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.routes import RemoteTopic
    from rmpa.config.settings import Settings
    from rmpa.observe.io.snapshot_builder import SnapshotBuilder
    from rmpa.observe.peer_info import PeerInfo
    from rmpa.ros.core.api import Core


class TopicEvidence:
    """Reads what the rooms know of one topic; changes nothing.

    Args:
        settings: The agent's.
        core: Its ROS core.
        bridge: Its bridge.
        snapshots: Its snapshots.
    """

    def __init__(self, settings: Settings, core: Core, bridge: Bridge, snapshots: SnapshotBuilder) -> None:
        self._core = core
        self._bridge = bridge
        self._snapshots = snapshots
        self.reload(settings)

    def reload(self, settings: Settings) -> None:
        """Use other settings from now on."""
        self._policy = Policy(settings.policy, settings.peers, settings.time)

    def own(self, topic: str) -> dict[str, str]:
        """The module's own publishers of a topic, and their addresses."""
        return {node: uri for node, uri in self._core.publishers(topic).items() if not is_own(node)}

    def there(self, peer: str, topic: str) -> tuple[str, str]:
        """The names of a topic of a peer here and at the peer.

        A user may write either: a name that no topic of the peer can have here is taken for the peer's own.
        """
        names = self._bridge.topics.names.of(peer)
        wires = names.wires_of(topic)
        return (topic, wires[0]) if wires else (names.local_name(topic), topic)

    def here(self, session: PeerSession | None, peer: PeerInfo | None, topic: str) -> TopicAtSubscriber:
        """What is known here of a topic that a peer publishes.

        Args:
            session: The session whose link carries it, if one does.
            peer: The module of its publishers.
            topic: Its name here.
        """
        snapshot = self._snapshots.build(frozenset({topic}))
        if session is None or peer is None:
            return TopicAtSubscriber(snapshot, topic)
        proxies = {}
        publishers, standing = self._core.publishers(topic), dict(session.proxies)
        for number, source in list(self._bridge.topics.imports.at(topic)):
            entry = self._bridge.topics.imports.get(number, source)
            if number != session.peer or entry is None:
                continue
            if (entry.origin.instance if entry.origin else session.link.identity.instance.hex()) != peer.instance:
                continue
            node = source.node
            name = session.proxies.name(node)
            proxies[node] = ProxyState(
                name=name,
                permission=self._permission(session.link.name, entry),
                denied=entry.denied,
                registered=node in standing and publishers.get(name) == standing[node].node.uri,
                conflict=entry.conflict,
                connections=self._connections(session, source),
                mismatches=self._bridge.topics.mismatches(source),
            )
        return TopicAtSubscriber(snapshot, topic, session.link.name, proxies)

    def _permission(self, peer: str, entry: RemoteTopic) -> str:
        """The rule about who publishes a peer's topic; empty if trust is off."""
        gate = self._bridge.gate
        if not gate.on:
            return ""
        module, relay = (peer, "") if entry.origin is None else (entry.origin.name, peer)
        return gate.judge(Access.PUBLISH, module, entry.topic, relay=relay).rule

    def _connections(self, session: PeerSession, source: Source) -> tuple[SubscriberConnection, ...]:
        publication = self._bridge.topics.of(session).publication(source)
        return tuple(
            SubscriberConnection(
                number=link.number,
                node=printable(link.other),
                held=not link.connected,
                messages=link.messages,
                waiting=link.waiting,
                dropped=link.dropped,
            )
            for link in (publication.connections() if publication is not None else ())
        )

    async def answer(self, session: PeerSession, args: dict[str, Any]) -> TopicAtPublisher:
        """The reply to ``why.topic``.

        Args:
            session: The peer that asks.
            args: ``topic``: its name on the wire; ``instance``: the instance id of its module, if this module only
                relays it.
        """
        wire = name_in(args, "topic")
        instance = args.get("instance") or ""
        asker = session.link.name
        names = self._bridge.topics.names.of(asker)
        state = self._core.state()
        sources: list[PublisherReport] = []
        subscribers: list[str] = []
        topics = [topic for topic in names.locals_of(wire) if self._may_know(asker, topic)]
        if not topics:
            return TopicAtPublisher(permitted=False)
        for topic in topics:
            nodes = self._relayed(topic, instance) if instance else list(self.own(topic))
            sources += [self._report(session, Source(topic, node), wire) for node in nodes]
            subscribers += [node for node in state.subscribers.get(topic, {}) if not is_own(node)]
        return TopicAtPublisher(
            sources=tuple(sources[: observe_limits.WHY_SOURCES_MAX]),
            subscribers=tuple(subscribers[: observe_limits.WHY_SOURCES_MAX]),
            similar="" if sources else await self._similar(session.link.name, wire),
            permitted=True if self._bridge.gate.on else None,
        )

    def _may_know(self, asker: str, topic: str) -> bool:
        """Whether a peer may subscribe to a topic, and so be told of it."""
        return self._bridge.gate.judge(Access.SUBSCRIBE, asker, topic).allowed

    async def _similar(self, asker: str, wire: str) -> str:
        """The topic of this module whose name on the wire is most like this one; empty if none is."""
        names, state = self._bridge.topics.names.of(asker), self._core.state()
        known = {
            names.wire_name(topic)
            for topic, nodes in yielding_to_data(list(state.publishers.items()))
            if not all(map(is_own, nodes)) and self._may_know(asker, topic)
        }
        # In a thread: comparing thousands of names takes longer than a message may wait.
        return await asyncio.to_thread(did_you_mean, wire, known) or ""

    def _relayed(self, topic: str, instance: object) -> list[str]:
        """The proxies of the nodes of a module whose topic this one relays."""
        offered = self._bridge.topics.exports.offered
        return [
            node
            for node in self._core.publishers(topic)
            if (local := offered.get(Source(topic, node))) is not None
            and local.origin is not None
            and local.origin.instance == instance
        ]

    def _report(self, session: PeerSession, source: Source, wire: str) -> PublisherReport:
        exports = self._bridge.topics.exports
        local = exports.offered.get(source)
        kind = local.type if local is not None else self._core.type_of(source.topic)
        node = source.node if local is None or local.origin is None else local.origin.node
        decision = self._policy.judge(source.topic, kind, node)
        if decision.allowed:
            special = self._policy.judge_for(session.link.name, source.topic, kind, wire)
            decision = special if special.rule else decision
        flow = self._bridge.topics.outbound.flows.get(source)
        numbering = self._bridge.topics.outbound.numbering(source, session.peer)
        contract = exports.contract(source, session.peer)
        reliable = contract is not None and contract.reliability is Reliability.RELIABLE
        return PublisherReport(
            node=source.node,
            topic=source.topic,
            type=kind,
            crosses=decision.allowed,
            rule=decision.rule,
            offered=exports.offer(session.peer, source) is not None,
            route="open" if session.peer in exports.flowing(source) else "opening" if contract is not None else "",
            messages=flow.messages if flow is not None else 0,
            dropped=flow.dropped if flow is not None and not reliable else 0,
            lost=numbering.lost if numbering is not None else 0,
            oversized=flow.oversized if flow is not None else 0,
            oversized_bytes=flow.oversized_bytes if flow is not None else 0,
            beyond=self._bridge.topics.imports.limit_settings.topics if exports.is_beyond(source) else 0,
            unreachable="" if flow is not None and flow.messages else self._unreachable(source.node),
        )

    def _unreachable(self, node: str) -> str:
        found = self._core.unreachable().get(node)
        return f"{found.api}: {found.problem}" if found is not None else ""


def name_in(args: dict[str, Any], key: str) -> str:
    """The argument ``key`` of a peer's request, a ROS name.

    Raises:
        RemoteProtocolError: It is not a ROS name.
    """
    name = args.get(key)
    if not isinstance(name, str) or len(name) > config_limits.CROSSING_NAME_MAX or not is_global_name(name):
        raise RemoteProtocolError(f"the question names no {key}")
    return name
