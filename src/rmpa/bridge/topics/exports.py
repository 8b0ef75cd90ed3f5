"""Which local sources are offered to which peers, and which of them flow (on demand, one copy for each peer).

A source is connected while at least one peer wants it::

    idle ──open──► connecting ──described──► live
      ▲               │ refused, lost          │ lost, restarted, gone
      └───────────────┴────────────────────────┘  every route of it: Closed(reason)

A peer that lost a route opens it again: the receiving side retries. A reliable route outlives its link: it is
suspended, its source stays connected, and the peer's next ``OpenRoute`` continues it (``link_away``).

Messages to and from peers carry wire names (``bridge.proxies``). Everything else here is keyed by local names.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import msgspec

from rmpa.bridge.messages import (
    Advertise,
    CloseRoute,
    Description,
    Message,
    OpenRoute,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
    is_crossing_name,
    is_crossing_type,
)
from rmpa.bridge.offers import Effects, OfferBook
from rmpa.bridge.policy import Local, PolicyDecision
from rmpa.config.peer_rules import Access
from rmpa.core.contract import Contract, Durability, Reliability, combine
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.bridge.messages import Origin


@dataclass(frozen=True, slots=True)
class LocalSource(Local):
    """A source of the local graph: its message type, its node's slave API, and its origin if it is relayed."""

    type: str
    uri: str
    origin: Origin | None = None


@dataclass(slots=True)
class ExportRoute:
    """A source on its way to one peer.

    Args:
        number: The route's id; 0 while it is suspended: its peer has no link.
        contract: The contract in force: the stronger terms of both ends.
        asked: The contract that the peer asked for.
        name: The peer's name.
        instance: The peer's run, as 32 hexadecimal digits.
        live: Whether data is sent on it yet.
        position: Epoch and last message that the peer has of the source, by this or another path; ``None``: nothing.
        unknown: Whether an earlier run of the peer's module may have missed messages.
        shared: Whether the publisher was connected before.
    """

    number: int
    contract: Contract
    asked: Contract
    name: str
    instance: str
    live: bool = False
    position: tuple[int, int] | None = None
    unknown: bool = False
    shared: bool = False

    @property
    def outage(self) -> float:
        """For how many seconds its messages are kept without a link."""
        return self.contract.resume_window if self.reliable else mesh_limits.SILENT_GRACE

    @property
    def reliable(self) -> bool:
        """Whether each message is kept until the peer has it."""
        return self.contract.reliability is Reliability.RELIABLE


@dataclass(slots=True)
class _Flow:
    """A source that at least one peer has opened: its node's slave API, and its route to each peer by number."""

    uri: str
    routes: dict[int, ExportRoute] = field(default_factory=dict)
    description: Description | None = None


class Exports(OfferBook[Source, LocalSource, TopicOffer]):
    """The outbound half of topics.

    Attributes:
        _routes: The open source of each route id, for each linked peer.
        _cut: The run of each named peer that had no link when a route of it ended, so that it may miss messages.
    """

    kind, warning, access, owner = "topics", "sources.too_many", Access.SUBSCRIBE, "the node"

    def __init__(self, out: Effects) -> None:
        super().__init__(out)
        self._routes: dict[int, dict[int, Source]] = {}
        self._flows: dict[Source, _Flow] = {}
        self._cut: OrderedDict[tuple[str, Source], str] = OrderedDict()

    # --- for others ----------------------------------------------------------------------------------------------

    def topics_for(self, peer: int) -> int:
        """How many topics a peer was told."""
        told = self.peers.get(peer)
        return len({source.topic for source in told.offers}) if told is not None else 0

    def source(self, peer: int, route: int) -> Source | None:
        """The source that a peer has open on a route."""
        return self._routes.get(peer, {}).get(route)

    def routes(self, source: Source) -> Mapping[int, ExportRoute]:
        """The routes of a source by peer, with the suspended ones."""
        flow = self._flows.get(source)
        return flow.routes if flow is not None else {}

    def flowing(self, source: Source) -> tuple[int, ...]:
        """The peers to which a source's data is sent now."""
        return tuple(peer for peer, route in self.routes(source).items() if route.live and route.number)

    def contract(self, source: Source, peer: int) -> Contract | None:
        """The contract of a source's open route to a peer; ``None`` if there is no such route."""
        route = self.routes(source).get(peer)
        return route.contract if route is not None and route.number else None

    def absent(self, source: Source) -> dict[int, Contract]:
        """The peers to which a source has suspended routes, with the contract of each."""
        return {peer: route.contract for peer, route in self.routes(source).items() if not route.number}

    def description(self, source: Source) -> Description | None:
        """The header of a source's publisher, while the source is connected; else ``None``."""
        flow = self._flows.get(source)
        return flow.description if flow is not None else None

    # --- the offers ----------------------------------------------------------------------------------------------

    def judge(self, key: Source, local: LocalSource) -> PolicyDecision:
        """Decide whether a source may cross at all."""
        if not (is_crossing_type(local.type) and is_crossing_name(key.topic) and is_crossing_name(key.node)):
            return PolicyDecision(False, f"no peer takes the type {local.type!r}, or the name of the topic or node")
        node = key.node if local.origin is None else local.origin.node
        return self._out.context.policy.judge(key.topic, local.type, node)

    def name_of(self, key: Source) -> str:
        """The topic."""
        return key.topic

    def offer_for(self, key: Source, local: LocalSource, wire: str) -> TopicOffer:
        """As of ``OfferBook``."""
        return TopicOffer(wire, key.node, local.type, local.origin)

    def _message(self, added: tuple[TopicOffer, ...], removed: tuple[Source, ...], full: bool, more: bool) -> Message:
        return Advertise(added, removed, full, more)

    def reload(self) -> Iterator[None]:
        """Judge by new rules. Routes that they end, end at once: a slow peer is told of the topics later."""
        context = self._out.context
        for source, flow in list(self._flows.items()):
            ours = context.contracts.of(source.topic, self.offered[source].type)
            for peer, route in list(flow.routes.items()):
                contract = combine(ours, route.asked, self.offered[source].type)
                if why := context.gate.why_not(Access.SUBSCRIBE, route.name, source.topic):
                    self._ended_for(peer, source, why)
                elif not contract.same_route(route.contract):
                    self._ended_for(peer, source, "its contract has changed here")
                else:
                    route.contract = contract
        return super().reload()

    # --- links ---------------------------------------------------------------------------------------------------

    def link_up(self, peer: int, name: str = "", instance: str = "") -> None:
        """As of ``OfferBook``; the routes of the new link have numbers of their own."""
        self._routes[peer] = {}
        super().link_up(peer, name, instance)

    def link_away(self, peer: int, *, briefly: bool = False) -> Iterator[None]:
        """Suspend the reliable routes of a peer that may come back, and end its other routes, one with each item.

        With ``briefly`` the link fell silent, and all routes are suspended. A suspended route that the peer has not
        opened again over this link starts its outage anew.
        """
        self.peers.pop(peer, None)
        self._routes.pop(peer, None)
        for source, flow in list(self._flows.items()):
            if (route := flow.routes.get(peer)) is None:
                continue
            if route.live and (route.reliable or briefly):
                route.number = 0
                self._do.suspend_route(source, peer, route.outage)
            else:
                self.end_route(source, peer)
            yield

    def link_down(self, peer: int) -> Iterator[None]:  # type: ignore[override] # ends routes too
        """End a peer's open and suspended routes, one with each item."""
        self.peers.pop(peer, None)
        self._routes.pop(peer, None)
        for source in list(self._flows):
            if self.end_route(source, peer) is not None:
                yield

    def outage(self, peer: int) -> float:
        """The longest time, in seconds, for which messages are kept for a peer without a link; 0 if none are."""
        away = (route for flow in self._flows.values() if (route := flow.routes.get(peer)) and not route.number)
        return max((route.outage for route in away if route.reliable), default=0.0)

    def given_up(self, source: Source, peer: int) -> None:
        """End a suspended route, whose messages are not kept any more."""
        if (route := self.routes(source).get(peer)) is not None and not route.number:
            self.end_route(source, peer)

    # --- routes --------------------------------------------------------------------------------------------------

    def opened(self, peer: int, message: OpenRoute) -> None:
        """Open a route that a peer asks for, or answer with ``RouteClosed`` and the reason."""
        routes, number, limit = self._routes[peer], message.route, self.limit
        if number in routes:
            self._out.warn("route.doubled", str(peer), f"a peer opens route {number} twice; the second is ignored")
            return
        asked = Source(message.topic, message.node)
        source = self.local(peer, asked)
        flow = self._flows.get(source) if source is not None else None
        before = flow.routes.get(peer) if flow is not None else None
        if len(routes) >= limit:
            why = f"more topics are open on one link than limits.topics = {limit} there"
        elif source is None:
            self._asked_in_vain(peer, asked.topic)
            why = f"{asked}: not published here, or policy keeps it home"
        elif before is not None and before.number:
            # One copy for each peer: otherwise a peer could multiply the traffic of this module at will.
            why = f"{source} is open on another route of this link"
        else:
            routes[number] = source
            local = self.offered[source]
            if flow is None:
                flow = self._flows[source] = _Flow(local.uri)
                self._do.outbound.connect(source, local.uri)
            route = flow.routes[peer] = self._route(peer, source, message)
            route.shared = flow.description is not None
            self._start(source, flow)
            return
        self._out.send(peer, RouteClosed(number, why))

    def _route(self, peer: int, source: Source, message: OpenRoute) -> ExportRoute:
        """The route that a peer asks for."""
        told, asked, kind = self.peers[peer], message.contract, self.offered[source].type
        contract = combine(self._out.context.contracts.of(source.topic, kind), asked, kind)
        route = ExportRoute(message.route, contract, asked, told.name, told.instance)
        route.unknown = self._cut.pop((told.name, source), told.instance) != told.instance
        route.position = (message.epoch, message.after) if message.epoch else None
        return route

    def position(self, source: Source) -> tuple[int, int] | None:
        """What a peer has of a source whose publisher is not connected yet; a relay's own route begins behind it."""
        waiting = (route.position for route in self.routes(source).values() if not route.live)
        return min((position for position in waiting if position is not None), default=None)

    def closed(self, peer: int, message: CloseRoute) -> None:
        """End a route that a peer closes; one that is not open is ignored, since both ends may close it at once."""
        if (source := self._routes[peer].pop(message.route, None)) is not None:
            self.end_route(source, peer)

    def described(self, source: Source, description: Description) -> None:
        """Start the routes of a source whose publisher has answered with its header."""
        if (flow := self._flows.get(source)) is not None:
            flow.description = description
            self._start(source, flow)

    def lost(self, source: Source, reason: str, lasts: Mapping[int, int] | None = None) -> None:
        """End the routes of a source whose publisher hung up, refused or does not answer.

        Args:
            source: The source.
            reason: What happened, for users.
            lasts: By peer: the last message of each route.
        """
        self._end(source, reason, lasts or {})

    def _start(self, source: Source, flow: _Flow) -> None:
        """Begin to send on the routes that wait for the publisher's header, once it is known."""
        if (about := flow.description) is None:
            return
        for peer, route in flow.routes.items():
            if route.live:
                continue
            route.live = True
            latching = about.latching or route.contract.durability is Durability.TRANSIENT_LOCAL
            told = msgspec.structs.replace(about, latching=latching)
            begin, unset = self._do.outbound.begins(source, peer, route), msgspec.UNSET
            opened = RouteOpened(route.number, told, route.contract, begin.epoch, begin.first)
            if begin.goes_on:
                opened = msgspec.structs.replace(opened, following=begin.first)
            else:
                opened = msgspec.structs.replace(opened, unknown=route.unknown or unset, shared=route.shared or unset)
            self._out.send(peer, opened)
            self._do.add_route(source, peer, route, begin)

    def end_route(self, source: Source, peer: int) -> ExportRoute | None:
        """End the route to one peer, if there is one; a source without any is disconnected."""
        flow = self._flows.get(source)
        if flow is None or (route := flow.routes.pop(peer, None)) is None:
            return None
        self._forget(source, peer, route)
        if not flow.routes:
            del self._flows[source]
            self._do.outbound.disconnect(source)
        return route

    def _forget(self, source: Source, peer: int, route: ExportRoute) -> None:
        if route.number:
            self._routes.get(peer, {}).pop(route.number, None)
        elif route.reliable:
            self._cut[route.name, source] = route.instance
            if len(self._cut) > mesh_limits.LOSSES_REMEMBERED:
                self._cut.popitem(last=False)
        if route.live:
            self._do.remove_route(source, peer, route.number)

    def _ended_for(self, peer: int, key: Source, why: str = "") -> None:
        if (route := self.end_route(key, peer)) is not None and route.number:
            why = why or "it is not offered here any more, or by another name"
            self._out.send(peer, RouteClosed(route.number, why))

    def _ended(self, key: Source, reason: str) -> None:
        flow, local = self._flows.get(key), self.offered.get(key)
        if flow is not None and (local is None or flow.uri != local.uri):
            self._end(key, reason)

    def _end(self, source: Source, reason: str, lasts: Mapping[int, int] | None = None) -> None:
        """End all routes of a source; ``lasts`` as for ``lost`` if its publisher is not connected any more."""
        flow = self._flows.pop(source, None)
        for peer, route in flow.routes.items() if flow is not None else ():
            last = lasts.get(peer) if lasts is not None else None
            if lasts is None:
                last = self._do.outbound.last(source, peer)
            self._forget(source, peer, route)
            if route.number:
                self._out.send(peer, RouteClosed(route.number, reason, msgspec.UNSET if last is None else last))
        if flow is not None and lasts is None:
            self._do.outbound.disconnect(source)
