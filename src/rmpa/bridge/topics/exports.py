"""Which local sources are offered to which peers, and which of them flow (on demand, one copy for each peer).

Sans-I/O: the driver passes in the state of the local graph, the requests of the peers and the events of the
connections to local publishers. Each call returns the actions to carry out.

A source is connected while at least one peer wants it::

    idle ──open──► connecting ──described──► live
      ▲               │ refused, lost          │ lost, restarted, gone
      └───────────────┴────────────────────────┘  every route of it: Closed(reason)

A peer that lost a route opens it again: the receiving side retries. A reliable route outlives its link: it is
suspended, its source stays connected, and the peer's next ``OpenRoute`` continues it (``link_away``).

Messages to and from peers carry wire names (``bridge.proxies``). Everything else here is keyed by local names.

The cost of a change depends on the size of the change, not on the size of the graph. Changes are gathered for each
peer and advertised in portions of bounded size.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.bridge.actions import Action, AddRoute, Connect, Disconnect, RemoveRoute, Send, SuspendRoute, Warn
from rmpa.bridge.messages import (
    Advertise,
    CloseRoute,
    Description,
    OpenRoute,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
    is_crossing_name,
    is_crossing_type,
)
from rmpa.bridge.offers import CataloguePeer, OfferCatalogue
from rmpa.bridge.policy import OPEN_GATE, PermissionGate, may_have
from rmpa.bridge.proxies import Names
from rmpa.config.peer_rules import Access
from rmpa.config.settings import LimitSettings
from rmpa.core.contract import Contract, Contracts, Durability, Reliability, combine
from rmpa.core.identity import is_later, serial_add
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from rmpa.bridge.messages import Origin
    from rmpa.bridge.offers import Portion
    from rmpa.bridge.policy import Policy
    from rmpa.mesh.reliable import ReliableSender


@dataclass(frozen=True, slots=True)
class LocalSource:
    """A source of the local graph: its message type, its node's slave API, and its origin if it is relayed."""

    type: str
    uri: str
    origin: Origin | None = None


@dataclass(slots=True)
class _Route:
    """A route of a source that one peer has opened.

    Args:
        contract: The contract in force: the stronger terms of both ends.
        asked: The contract that the peer asked for.
        name: The peer's name.
        instance: The peer's run, as 32 hexadecimal digits.
        live: Whether data is sent on it yet.
        epoch: Identifies the numbering of a reliable route; 0 for best effort.
        after: Sequence of the last message that the peer has, if this continues a suspended route; else ``None``.
        unknown: Whether an earlier run of the peer's module may have missed messages.
    """

    contract: Contract
    asked: Contract
    name: str = ""
    instance: str = ""
    live: bool = False
    epoch: int = 0
    after: int | None = None
    unknown: bool = False


@dataclass(slots=True)
class _ExportedFlow:
    """A source that at least one peer has opened."""

    uri: str
    routes: dict[tuple[int, int], _Route] = field(default_factory=dict)
    """Open routes by (peer, route id)."""
    away: dict[int, _Route] = field(default_factory=dict)
    """Suspended routes by peer."""
    description: Description | None = None

    @property
    def wanted(self) -> bool:
        return bool(self.routes or self.away)


@dataclass(slots=True)
class _Topic:
    """One topic of the local graph.

    Args:
        seen: Its publishers by node, as ``Exports.graph`` last got them.
        crossing: Those that policy lets cross, including those beyond ``limits.topics``.
        rules: The number of the rules that they were judged by; ``apply_rules`` counts it up.
    """

    seen: Mapping[str, LocalSource]
    crossing: dict[Source, LocalSource] = field(default_factory=dict)
    rules: int = 0


_Peer = CataloguePeer[Source, LocalSource, TopicOffer, Source]
_NOTHING: Final = _Topic({})
_NO_NAMES: Final = Names()
_DEFAULT_LIMITS: Final = LimitSettings()


class Exports:
    """The outbound half of the bridge.

    Args:
        policy: Decides which sources may cross.
        contracts: The contracts that this module offers for its topics.
        names: Translates local names to the names at the peers.
        limit_settings: Bounds the number of offered topics.
        numbering: ``(source, peer)``: the sender of a reliable route; ``None`` if there is none.
        gate: Decides which topics each peer may have.
    """

    def __init__(
        self,
        policy: Policy,
        contracts: Contracts | None = None,
        names: Names = _NO_NAMES,
        limit_settings: LimitSettings = _DEFAULT_LIMITS,
        numbering: Callable[[Source, int], ReliableSender | None] = lambda *_: None,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._gate = gate
        self._numbering = numbering
        self._policy = policy
        self._limit_settings = limit_settings
        self._catalogue: OfferCatalogue[Source, LocalSource, TopicOffer, Source] = OfferCatalogue(
            "topics", limit_settings.topics, offer=self._offer, wire=lambda offer: offer.source
        )
        self._contracts = contracts if contracts is not None else Contracts()
        self._names = names
        self._rules = 0
        self._epochs = 0
        self._topics: dict[str, _Topic] = {}
        self._routes: dict[int, dict[int, Source]] = {}
        """The open source of each route id, for each linked peer."""
        self._flows: dict[Source, _ExportedFlow] = {}
        self._cut: OrderedDict[tuple[str, Source], str] = OrderedDict()
        """The run of each named peer that had no link when a route of it ended, so that it may miss messages."""

    @property
    def offered(self) -> Mapping[Source, LocalSource]:
        """The sources that are offered to peers, before the rules for single peers."""
        return self._catalogue.offered

    @property
    def beyond(self) -> int:
        """How many sources are offered to no peer because of ``limits.topics``."""
        return self._catalogue.beyond

    def is_beyond(self, source: Source) -> bool:
        """Whether a source is offered to no peer because of ``limits.topics``."""
        return self._catalogue.is_beyond(source)

    def offer(self, peer: int, source: Source) -> TopicOffer | None:
        """The offer of a source as it was advertised to a peer, with its wire name; ``None`` if it was not."""
        return self._catalogue.told(peer, source)

    def topics_for(self, peer: int) -> int:
        """How many topics a peer can open: those advertised to it, or all offered ones if no rule is for it."""
        known = self._catalogue.peer(peer)
        sources = known.told if known is not None and known.judged else self.offered
        return len({source.topic for source in sources})

    def local(self, peer: int, wire: Source) -> Source | None:
        """The local source that a peer means by a wire name; ``None`` if none is offered to it by that name."""
        known = self._catalogue.peer(peer)
        if known is None:
            return None
        source = known.by_wire.get(wire)
        if source is not None and not self._gate.judge(Access.SUBSCRIBE, known.name, source.topic).allowed:
            return None  # the rules have changed, and the peer is told so in a moment
        local = self.offered.get(wire if source is None else source)
        if source is None and local is not None and not known.judged and self._offer(known, wire, local) is not None:
            return wire  # its advertisement is on its way
        return source if local is not None else None

    def source(self, peer: int, route: int) -> Source | None:
        """The source that a peer has open on a route."""
        return self._routes.get(peer, {}).get(route)

    def flowing(self, source: Source) -> tuple[int, ...]:
        """The peers to which a source's data is sent now."""
        flow = self._flows.get(source)
        return tuple(peer for (peer, _), route in flow.routes.items() if route.live) if flow else ()

    def contract(self, source: Source, peer: int) -> Contract | None:
        """The contract of a source's open route to a peer; ``None`` if there is no such route."""
        flow = self._flows.get(source)
        return next((route.contract for (p, _), route in flow.routes.items() if p == peer), None) if flow else None

    def description(self, source: Source) -> Description | None:
        """The header of a source's publisher, while the source is connected; else ``None``."""
        flow = self._flows.get(source)
        return flow.description if flow else None

    @property
    def topics(self) -> Collection[str]:
        """The topics with publishers, as ``graph`` last reported them."""
        return self._topics.keys()

    @property
    def pending(self) -> bool:
        """Whether a peer has not received all changes yet, so that ``advertise`` has something to send."""
        return self._catalogue.pending

    def apply_rules(
        self, policy: Policy, contracts: Contracts, names: Names, limit_settings: LimitSettings = _DEFAULT_LIMITS
    ) -> list[Action]:
        """Takes new rules, and ends routes whose contract changes with them; other routes go on untouched.

        ``graph`` judges a topic by the new rules when it is called for it next; then ``advertise`` sends the changes.
        """
        self._policy, self._contracts, self._names, self._limit_settings = policy, contracts, names, limit_settings
        self._rules += 1
        self._catalogue.limit = limit_settings.topics
        for known in self._catalogue.peers():
            before, known.judged = known.judged, self._is_judged(known.name)
            if before or known.judged:
                self._catalogue.note_all(known)
        actions = self._end_denied()
        for source, flow in list(self._flows.items()):
            offered = contracts.of(source.topic, self.offered[source].type)
            for (peer_number, _), route in list(flow.routes.items()):
                contract = combine(offered, route.asked)
                if contract.same_route(route.contract):
                    route.contract = contract
                else:
                    actions += self._end_for(source, peer_number, "its contract has changed here")
        return actions

    def _end_denied(self) -> list[Action]:
        """Ends the routes that no permission allows any more, at once: a slow peer is told of the topics later."""
        actions: list[Action] = []
        for peer, routes in self._routes.items():
            known = self._catalogue.peer(peer)
            if known is None or not self._gate.on:
                continue
            for source in dict.fromkeys(routes.values()):
                if why := self._gate.why_not(Access.SUBSCRIBE, known.name, source.topic):
                    actions += self._end_for(source, peer, why)
        for source, flow in list(self._flows.items()):
            for peer, route in list(flow.away.items()):
                if not self._gate.judge(Access.SUBSCRIBE, route.name, source.topic).allowed:
                    actions += self.given_up(source, peer)
        return actions

    def graph(self, topic: str, publishers: Mapping[str, LocalSource]) -> list[Action]:
        """Set a topic's present publishers, by node, without proxies; ``advertise`` sends the changes."""
        before = self._topics.get(topic, _NOTHING)
        if before.seen == publishers and (before.rules == self._rules or not publishers):
            return []
        crossing = {
            source: local for node, local in publishers.items() if self._crosses(source := Source(topic, node), local)
        }
        if publishers:
            self._topics[topic] = _Topic(publishers, crossing, self._rules)
        else:
            del self._topics[topic]
        actions: list[Action] = []
        for source in before.crossing:
            if source not in crossing:
                actions += self._went(source)
        for source, local in crossing.items():
            actions += self._came(source, local)
        return actions

    def _crosses(self, source: Source, local: LocalSource) -> bool:
        node = source.node if local.origin is None else local.origin.node
        return (
            is_crossing_type(local.type)
            and is_crossing_name(source.topic)
            and is_crossing_name(source.node)
            and self._policy.judge(source.topic, local.type, node).allowed
        )

    def _came(self, source: Source, local: LocalSource) -> list[Action]:
        """Offers a source that is new, unchanged, or has another type or address."""
        before = self.offered.get(source)
        if not self._catalogue.put(source, local):
            return [self._catalogue.warning("sources.too_many")]
        if before is None or (before.type, before.origin) != (local.type, local.origin):
            self._catalogue.note(source)
        # A new address alone is not advertised.
        flow = self._flows.get(source)
        return self._end(source, "the node has restarted") if flow is not None and flow.uri != local.uri else []

    def _went(self, source: Source) -> list[Action]:
        if not self._catalogue.remove(source):
            return []
        self._catalogue.note(source)
        actions = self._end(source, "the node has gone")
        if (waiting := self._catalogue.next_beyond()) is not None:
            actions += self._came(*waiting)
        return actions

    def advertise(self, ready: Callable[[int], bool] = lambda _: True) -> list[Action]:
        """Returns one message for each ready peer that has changes to receive; call again while ``pending``."""
        return [
            action
            for peer, portion in self._catalogue.portions(ready)
            for action in self._told_portion(peer, portion)
        ]

    def _told_portion(self, peer: int, portion: Portion[Source, TopicOffer, Source]) -> list[Action]:
        """Makes the message of a portion, and ends routes of sources that the peer may not have any more."""
        actions: list[Action] = []
        for source in portion.ended:
            actions += self._end_for(source, peer, "it is not offered here any more, or by another name")
        known = self._catalogue.peer(peer)
        for source, offer, holder in portion.taken:
            name = known.name if known is not None else ""
            text = f"{source} would be {offer.topic} at {name}, as {holder.topic} is already: rename one"
            actions.append(Warn("names.taken", f"{peer} {source}", text))
        if portion.is_news:
            message = Advertise(tuple(portion.added), tuple(portion.removed), portion.full, portion.more)
            actions.append(Send(peer, message))
        return actions

    def _offer(self, known: _Peer, source: Source, local: LocalSource) -> TopicOffer | None:
        """The offer of a source for one peer; ``None`` if the peer may not know of it."""
        if local.origin is not None and not may_have(known.instance, local.origin):
            return None
        if not known.judged:
            return TopicOffer(source.topic, source.node, local.type, local.origin)
        wire = self._names.wire_name(known.name, source.topic)
        if not is_crossing_name(wire):
            return None
        if not self._policy.judge_for(known.name, source.topic, local.type, wire).allowed:
            return None
        if not self._gate.admits(Access.SUBSCRIBE, known.name, source.topic):
            return None
        return TopicOffer(wire, source.node, local.type, local.origin)

    def link_up(self, peer: int, name: str = "", instance: str = "") -> list[Action]:
        """Begins the full advertisement on a new link; ``advertise`` continues it.

        Args:
            peer: The peer's number.
            name: The peer's name, which selects the rules for it.
            instance: The peer's run, as 32 hexadecimal digits; its own sources are not relayed back to it.
        """
        self._routes[peer] = {}
        first = self._catalogue.link_up(peer, name, instance, judged=self._is_judged(name))
        return self._told_portion(peer, first)

    def _is_judged(self, name: str) -> bool:
        return self._gate.on or not self._names.of(name).plain or self._policy.has_rules_for(name)

    def link_down(self, peer: int) -> list[Action]:
        """Ends a peer's open and suspended routes."""
        actions: list[Action] = []
        self._catalogue.link_down(peer)
        for route, source in self._routes.pop(peer, {}).items():
            actions += self._remove(source, peer, route)
        for source in list(self._flows):
            actions += self.given_up(source, peer)
        return actions

    def link_away(self, peer: int) -> tuple[list[Action], bool]:
        """Suspends the reliable routes of a peer that may come back, and ends its other routes.

        Returns:
            The actions, and whether a reliable route waits for the peer; if none does, call ``link_down`` next.
        """
        # Suspended routes that the peer did not open again over this link start their outage anew.
        again = [(one, flow.away[peer].contract) for one, flow in self._flows.items() if peer in flow.away]
        actions: list[Action] = [SuspendRoute(one, peer, contract.outage) for one, contract in again]
        self._catalogue.link_down(peer)
        for number, source in self._routes.pop(peer, {}).items():
            flow = self._flows.get(source)
            route = flow.routes.get((peer, number)) if flow is not None else None
            if flow is None or route is None or not (route.live and route.epoch):
                actions += self._remove(source, peer, number)
                continue
            del flow.routes[peer, number]
            flow.away[peer] = route
            actions.append(SuspendRoute(source, peer, route.contract.outage))
        return actions, self.waits_for(peer)

    def given_up(self, source: Source, peer: int) -> list[Action]:
        """Ends a suspended route, whose messages are not kept any more."""
        flow = self._flows.get(source)
        if flow is None or (route := flow.away.pop(peer, None)) is None:
            return []
        self._note_cut(source, route)
        return [RemoveRoute(source, peer, 0), *self._disconnect(source, flow)]

    def _note_cut(self, source: Source, route: _Route) -> None:
        self._cut[route.name, source] = route.instance
        if len(self._cut) > mesh_limits.LOSSES_REMEMBERED:
            self._cut.popitem(last=False)

    def waits_for(self, peer: int) -> bool:
        """Whether a reliable route waits for a peer without a link."""
        return any(peer in flow.away for flow in self._flows.values())

    def outage(self, peer: int) -> float:
        """The longest time, in seconds, for which messages are kept for a peer without a link; 0 if none are."""
        return max(
            (flow.away[peer].contract.outage for flow in self._flows.values() if peer in flow.away), default=0.0
        )

    def absent(self, source: Source) -> dict[int, Contract]:
        """The peers to which a source has suspended routes, with the contract of each."""
        return {p: route.contract for p, route in flow.away.items()} if (flow := self._flows.get(source)) else {}

    def opened(self, peer: int, message: OpenRoute) -> list[Action]:
        """Opens a route that a peer asks for, or answers with ``RouteClosed`` and the reason."""
        routes = self._routes[peer]
        if message.route in routes:
            return [
                Warn("route.doubled", str(peer), f"a peer opens route {message.route} twice; the second is ignored")
            ]
        if len(routes) >= self._limit_settings.topics:
            text = f"more topics are open on one link than limits.topics = {self._limit_settings.topics} over there"
            return [Send(peer, RouteClosed(message.route, text))]
        source = self.local(peer, message.source)
        if source is None:
            self._report_denied(peer, message.source.topic)
            text = f"{message.source}: not published here, or policy keeps it home"
            return [Send(peer, RouteClosed(message.route, text))]
        local = self.offered[source]
        flow = self._flows.get(source)
        if flow is not None and any(other == peer for other, _ in flow.routes):
            # One copy for each peer: otherwise a peer could multiply the traffic of this module at will.
            return [Send(peer, RouteClosed(message.route, f"{source} is open on another route of this link"))]
        routes[message.route] = source
        away = flow.away.pop(peer, None) if flow is not None else None
        route = self._route(message, source.topic, local, away)
        known = self._catalogue.peer(peer)
        if known is not None:
            route.name, route.instance = known.name, known.instance
            route.unknown = self._cut.pop((known.name, source), known.instance) != known.instance
        if flow is None:
            flow = self._flows[source] = _ExportedFlow(local.uri)
            flow.routes[peer, message.route] = route
            return [Connect(source, local.type, local.uri)]
        flow.routes[peer, message.route] = route
        if flow.description is None:
            return []
        return self._start(source, flow, flow.description)

    def _report_denied(self, peer: int, wire: str) -> None:
        """Reports a topic that a peer asks for without permission; the answer is as if there were none."""
        known = self._catalogue.peer(peer)
        if known is not None and self._gate.on:
            local = next(iter(self._names.of(known.name).locals_of(wire)), wire)
            self._gate.admits(Access.SUBSCRIBE, known.name, local)

    def _route(self, message: OpenRoute, topic: str, local: LocalSource, away: _Route | None) -> _Route:
        """The route that a peer asks for; it continues a suspended one of the same epoch and contract."""
        asked = message.contract
        contract = combine(self._contracts.of(topic, local.type), asked)
        if contract.reliability is not Reliability.RELIABLE:
            return _Route(contract, asked)
        if away is not None and away.epoch == message.epoch and away.contract.same_route(contract):
            return _Route(contract, asked, epoch=away.epoch, after=message.after)
        self._epochs += 1
        return _Route(contract, asked, epoch=self._epochs)

    def closed(self, peer: int, message: CloseRoute) -> list[Action]:
        """Ends a route that a peer closes; one that is not open is ignored, since both ends may close it at once."""
        source = self._routes[peer].pop(message.route, None)
        return self._remove(source, peer, message.route) if source is not None else []

    def described(self, source: Source, description: Description) -> list[Action]:
        """Starts the routes of a source whose publisher has answered with its header."""
        flow = self._flows.get(source)
        if flow is None:
            return []
        flow.description = description
        return self._start(source, flow, description)

    def lost(self, source: Source, reason: str, lasts: Mapping[int, int] | None = None) -> list[Action]:
        """Ends the routes of a source whose publisher hung up, refused or does not answer.

        Args:
            source: The source.
            reason: What happened, for users.
            lasts: By peer: the last message of each reliable route.
        """
        return self._end(source, reason, lasts or {})

    def _start(self, source: Source, flow: _ExportedFlow, description: Description) -> list[Action]:
        actions: list[Action] = []
        for (peer, number), route in flow.routes.items():
            if route.live:
                continue
            route.live = True
            about = description
            if route.contract.durability is Durability.TRANSIENT_LOCAL and not about.latching:
                about = msgspec.structs.replace(about, latching=True)
            actions += [
                Send(peer, self._told(RouteOpened(number, about, route.contract, route.epoch), source, peer, route)),
                AddRoute(source, peer, number, route.contract, route.epoch, route.after),
            ]
        return actions

    def _told(self, opened: RouteOpened, source: Source, peer: int, route: _Route) -> RouteOpened:
        """Adds to an ``opened`` which message comes next of a numbering that goes on, or that some may be missed."""
        if route.after is None:
            return msgspec.structs.replace(opened, unknown=True) if route.unknown else opened
        if (numbering := self._numbering(source, peer)) is None:
            return opened
        # The peer may have kept messages whose acknowledgement was lost; these are not sent again.
        after, following = route.after, numbering.following
        return msgspec.structs.replace(
            opened, following=following if is_later(following, after) else serial_add(after, 1)
        )

    def _remove(self, source: Source, peer: int, route: int) -> list[Action]:
        flow = self._flows.get(source)
        if flow is None:
            return []
        gone = flow.routes.pop((peer, route), None)
        live = gone is not None and gone.live
        actions: list[Action] = [RemoveRoute(source, peer, route)] if live else []
        return actions + self._disconnect(source, flow)

    def _disconnect(self, source: Source, flow: _ExportedFlow) -> list[Action]:
        """Disconnects a source without open or suspended routes."""
        if flow.wanted:
            return []
        del self._flows[source]
        return [Disconnect(source)]

    def _end_for(self, source: Source, peer: int, reason: str) -> list[Action]:
        """Ends a source's routes to one peer; those to other peers go on."""
        flow = self._flows.get(source)
        if flow is None:
            return []
        actions: list[Action] = []
        for number in [number for owner, number in flow.routes if owner == peer]:
            self._routes[peer].pop(number, None)
            actions += [*self._remove(source, peer, number), Send(peer, RouteClosed(number, reason))]
        return actions + self.given_up(source, peer)

    def _end(self, source: Source, reason: str, lasts: Mapping[int, int] | None = None) -> list[Action]:
        """Ends all routes of a source; ``lasts`` as for ``lost`` if its publisher is not connected any more."""
        flow = self._flows.pop(source, None)
        if flow is None:
            return []
        actions: list[Action] = []
        for peer, route in flow.away.items():
            self._note_cut(source, route)
            actions.append(RemoveRoute(source, peer, 0))
        for (peer, number), route in flow.routes.items():
            self._routes[peer].pop(number, None)
            last = lasts.get(peer) if lasts is not None else None
            if lasts is None and (numbering := self._numbering(source, peer)) is not None:
                last = numbering.last
            if route.live:
                actions.append(RemoveRoute(source, peer, number))
            actions.append(Send(peer, RouteClosed(number, reason, msgspec.UNSET if last is None else last)))
        if lasts is None:
            actions.append(Disconnect(source))
        return actions
