"""What nodes subscribe to, told to the peers: each graph shows the whole robot, as that of one roscore does.

A topic that only has a subscriber, such as ``/cmd_vel`` of a base that waits for commands, is known everywhere by it.
Subscriptions cross under the rules, names, limits and permissions of topics: a peer is told of one if it may publish
the topic here, and it is shown at the proxy of its node. No connection is made by it: messages take the routes of
their publishers, and a publisher counts the connections that it has.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.graph_part import GraphPart, go_on
from rmpa.bridge.messages import (
    Notification,
    Source,
    SubscriptionChanges,
    SubscriptionOffer,
    convert,
    is_crossing_name,
)
from rmpa.bridge.offers import TopicBook
from rmpa.bridge.peer_offers import ImportBook, Remote
from rmpa.bridge.policy import Local, Needs, Place
from rmpa.bridge.topics.direct import MEASURING
from rmpa.config.peer_rules import Access
from rmpa.core.facts import CROWDED
from rmpa.core.identity import is_own
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.wire.slave_api import BusConnection
from rmpa.ros.wire.tcpros import ANY
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.messages import Message, Origin
    from rmpa.bridge.sessions import PeerSession
    from rmpa.ros.node.slave_node import SlaveNode

# The notification of what the sender's nodes subscribe to: ``SubscriptionChanges``.
SUBSCRIPTIONS: Final = "subscriptions"


@dataclass(frozen=True, slots=True)
class LocalSubscription(Local):
    """A subscription in the local graph: its type, ``*`` for any, and its origin if it is relayed."""

    type: str
    origin: Origin | None = None


def _told(*changes: Any) -> Message:
    return Notification(SUBSCRIPTIONS, msgspec.structs.asdict(SubscriptionChanges(*changes)))


class SubscriptionOffers(TopicBook[LocalSubscription, SubscriptionOffer, None]):
    """What nodes of this module subscribe to. A key's ``node`` is the subscriber."""

    counter, access, owner = "subscriptions.too_many", Access.PUBLISH, "the subscriber"
    message, reports, any_type = staticmethod(_told), False, True

    def offer_for(self, key: Source, local: LocalSubscription, wire: str) -> SubscriptionOffer:
        """As of ``OfferBook``."""
        return SubscriptionOffer(wire, key.node, local.type, local.origin)


class SubscriptionImports(ImportBook[Source, Remote[Source], SubscriptionOffer]):
    """What nodes of peers subscribe to, and what of it is in the local graph."""

    kind, access = "topics", Access.SUBSCRIBE
    _out: Subscriptions

    def topics(self, peer: int) -> frozenset[str]:
        """The topics here that the peer's own nodes subscribe to, whether that is shown or not."""
        known = self._peers.get(peer)
        entries = known.entries.values() if known is not None else ()
        return frozenset(entry.name for entry in yielding_to_data(list(entries)) if entry.origin is None)

    def _entry(self, peer: int, offer: SubscriptionOffer) -> Remote[Source]:
        source, name = offer.source, self.name_here(peer, offer.topic, offer.origin)
        return Remote(peer=peer, wire=source, name=name, node=offer.node, type=offer.type, origin=offer.origin)

    def _went(self, entry: Remote[Source], reason: str) -> None:  # noqa: ARG002 - as of ImportBook
        if entry.shown:
            self._hide(entry)

    def _rejudge_all(self, now: float) -> Iterator[None]:  # noqa: ARG002 - as of ImportBook
        for entry in [entry for known in self._peers.values() for entry in known.entries.values()]:
            known = self._peers.get(entry.peer)
            if known is not None and known.entries.get(entry.wire) is entry:
                name = self.name_here(entry.peer, entry.wire.topic, entry.origin)
                if name != entry.name and entry.shown:
                    self._hide(entry)
                entry.name = name
                self._judge(entry)
            yield

    def _judge(self, entry: Remote[Source]) -> None:
        known, (why, entry.cause) = self._peers[entry.peer], self._why_hidden(entry)
        known.wait(entry, crowded=entry.cause == CROWDED)
        if entry.shown and why:
            self._hide(entry)
        elif not entry.shown and not why:
            known.show(entry)
            self._out.show(entry)

    def _hide(self, entry: Remote[Source]) -> None:
        known = self._peers[entry.peer]
        known.hide(entry)
        self._out.hide(entry)
        for waiting in known.admitted(self._out.context.settings.limits.nodes):
            self._judge(waiting)

    def _why_hidden(self, entry: Remote[Source]) -> tuple[str, str]:
        """Why a subscription is not in the local graph, and the cause (see ``Remote``); empty if it may be."""
        origin, topic = entry.origin, entry.name
        if origin is not None and (why := self.ways.why_not(entry.peer, origin)):
            return why, ""
        node = entry.node if origin is None else origin.node
        decision = self._out.context.policy.judge(topic, entry.type or ANY, node)
        if why := self._kept_out(entry, decision, entry.wire.topic):
            return why, ""
        if not is_crossing_name(topic):
            return f"its name here would be {topic}, which is too long", ""
        return self._no_place(entry)


class ShownSubscription:
    """A peer's subscription at the proxy of its node; it is registered, and connects to nothing.

    For ROS's tools, which compare the registrations with the connections that nodes name, it is connected to the
    publishers of other modules: what these have between them is not known here. See ``SubscribedTopic``.

    Args:
        part: The part.
        entry: The subscription.
    """

    def __init__(self, part: Subscriptions, entry: Remote[Source]) -> None:
        self.topic, self.type_name = entry.name, entry.type or ANY
        self.node: SlaveNode | None = None
        self.release: Callable[[], None]
        self._part, self._peer = part, entry.peer

    def ready(self, node: SlaveNode) -> None:
        """Register it: its proxy exists."""
        self.node = node
        node.add_subscription(self)
        self.register()

    def left(self, node: SlaveNode) -> None:
        """Unregister it."""
        self.node = None
        node.remove_subscription(self)
        self._part.core.call("unregisterSubscriber", node.name, self.topic, node.uri)

    def register(self) -> None:
        """Register it at the core; without effect once it has left."""
        if self.node is not None:
            self._part.core.call("registerSubscriber", self.node.name, self.topic, self.type_name, self.node.uri)

    def connections(self) -> list[BusConnection]:
        """As of ``SubscribedTopic``."""
        numbers = count(1)
        return [
            BusConnection(next(numbers), uri, "i", self.topic, True, f"by the agents, from {node}", 0, 0)
            for node, uri in self._part.core.publishers(self.topic).items()
            if is_own(node) or self._part.flows(Source(self.topic, node), self._peer)
        ]

    def update(self, uris: Iterable[str]) -> None:
        """As of ``SubscribedTopic``: the agents connect."""

    def close(self) -> None:
        """As of ``SubscribedTopic``."""


class Subscriptions(GraphPart):
    """The subscriptions of all modules, in both directions.

    Args:
        bridge: The core, the peers and the rules.
    """

    verb = "subscribes"
    exports: SubscriptionOffers
    imports: SubscriptionImports

    def __init__(self, bridge: Bridge) -> None:
        super().__init__(bridge, SubscriptionOffers, SubscriptionImports)
        self.core = bridge.core
        self._shown: dict[Remote[Source], ShownSubscription] = {}
        needs = Needs((Access.SUBSCRIBE,), "the topics: of others the subscription is not shown")
        bridge.rpc.on_notification(SUBSCRIPTIONS, self._told_by_peer, needs)

    def flows(self, source: Source, peer: int) -> bool:
        """Whether a topic of a node of this module goes to a peer, by the agents or directly."""
        topics = self.bridge.topics
        granted = (owner for owner, _, _ in topics.direct_exports.of(source.topic, source.node))
        return peer in topics.exports.routes(source) or peer in granted

    def _told_by_peer(self, session: PeerSession, args: dict[str, Any]) -> None:
        changes = convert(SUBSCRIPTIONS, args, SubscriptionChanges)
        self._advertisements.append((session, self._apply(session, session.link, changes)))
        self.schedule()
        while len(self._advertisements) > limits.SUBSCRIPTIONS_WAITING:
            go_on(self._advertisements)

    def graph_changed(self, change: GraphChange) -> None:
        """Have the topic of a registration looked at."""
        if change.kind is RegistrationKind.SUBSCRIBER:
            self.look((change.name,))

    def reconcile(self) -> None:
        """Register missing subscriptions again: the core has been restarted."""
        compared, subscribers = self.look_again(), self.core.state().subscribers
        for shown in yielding_to_data(list(self._shown.values())) if compared else ():
            if shown.node is not None and shown.node.name not in subscribers.get(shown.topic, ()):
                shown.register()

    def _names(self) -> Iterable[str]:
        return (*self.exports.topics, *self.core.state().subscribers)

    def _look_at(self, name: str) -> None:
        """Offer the subscriptions of this module's nodes to a topic, and those that this agent relays."""
        unreachable, found = self.core.unreachable(), {}
        for node in self.core.subscribers(name):
            origin = self.bridge.relay.origin((_place(name), node)) if is_own(node) else None
            gone = node in unreachable and unreachable[node].withdrawn
            if origin is not None or not (is_own(node) or node.startswith(MEASURING) or gone):
                found[node] = LocalSubscription(self.core.type_of(name, node), origin)
        self.exports.look(name, found)

    def _relayed(self, entry: Remote[Any], proxy: str) -> tuple[Source, Place]:
        return Source(_place(entry.name), entry.node), (_place(entry.name), proxy)

    def show(self, entry: Remote[Source]) -> None:
        """Register a peer's subscription at the proxy of its node, in a later turn of the loop."""
        if (session := self.bridge.sessions.get(entry.peer)) is not None:
            proxies, node = self.bridge.sessions.proxies(session, entry.node, entry.origin)
            self.pass_on(entry)
            shown, key = ShownSubscription(self, entry), _place(entry.wire.topic)
            self._shown[entry] = shown
            shown.release = lambda: proxies.release(node, key)
            proxies.hold(node, key, shown.ready, shown.left)

    def hide(self, entry: Remote[Source]) -> None:
        """Remove a peer's subscription from the local graph, in a later turn of the loop."""
        self.bridge.relay.gone(entry.peer, Source(_place(entry.name), entry.node))
        if (shown := self._shown.pop(entry, None)) is not None:
            shown.release()


def _place(topic: str) -> str:
    """What ``policy.Relay`` and proxies know a subscription by, unlike the topic itself."""
    return f"subscription {topic}"
