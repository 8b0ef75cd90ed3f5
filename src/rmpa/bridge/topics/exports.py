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
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.data.export import ExportRoute
from rmpa.bridge.messages import (
    Advertise,
    CloseRoute,
    OpenRoute,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
)
from rmpa.bridge.offers import TopicBook
from rmpa.bridge.policy import Local
from rmpa.config.peer_rules import Access
from rmpa.core.contract import Durability, combine
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.bridge.data.export import ExportFlow
    from rmpa.bridge.data.route_sender import RouteSender
    from rmpa.bridge.messages import Description, Origin
    from rmpa.bridge.topics.part import Topics


@dataclass(frozen=True, slots=True)
class LocalSource(Local):
    """A source of the local graph: its message type, its node's slave API, and its origin if it is relayed."""

    type: str
    uri: str
    origin: Origin | None = None


class Exports(TopicBook[LocalSource, TopicOffer, ExportRoute]):
    """The outbound half of topics.

    Attributes:
        flows: The sources that the agent is connected to, each with its routes by peer.
        _cut: The run of each named peer that had no link when a route of it ended, so that it may miss messages.
    """

    counter, access, owner, message = "sources.too_many", Access.SUBSCRIBE, "the node", Advertise
    _out: Topics

    def __init__(self, out: Topics) -> None:
        super().__init__(out)
        self.flows: dict[Source, ExportFlow] = {}
        self._cut: OrderedDict[tuple[str, Source], str] = OrderedDict()

    def topics_for(self, peer: int) -> int:
        """How many topics a peer was told."""
        told = self.peers.get(peer)
        return len({source.topic for source in told.offers}) if told is not None else 0

    def routes(self, source: Source) -> Mapping[int, ExportRoute]:
        """The routes of a source by peer, with the suspended ones."""
        flow = self.flows.get(source)
        return flow.routes if flow is not None else {}

    def of(self, peer: int) -> list[ExportRoute]:
        """The routes to a peer, with the suspended ones."""
        return [flow.routes[peer] for flow in self.flows.values() if peer in flow.routes]

    def senders(self, peer: int) -> list[RouteSender]:
        """The senders of the routes that a linked peer has open."""
        told = self.peers.get(peer)
        routes = told.routes.values() if told is not None else ()
        return [route.sender for route in routes if route.sender is not None]

    def description(self, source: Source) -> Description | None:
        """The header of a source's publisher, while the source is connected; else ``None``."""
        flow = self.flows.get(source)
        return flow.description if flow is not None else None

    def offer_for(self, key: Source, local: LocalSource, wire: str) -> TopicOffer:
        """As of ``OfferBook``."""
        return TopicOffer(wire, key.node, local.type, local.origin)

    def reload(self) -> Iterator[None]:
        """Judge by new rules. Routes that they end, end at once: a slow peer is told of the topics later."""
        context = self._out.context
        for source, flow in list(self.flows.items()):
            ours = context.contracts.of(source.topic, self.offered[source].type)
            for route in list(flow.routes.values()):
                contract = combine(ours, route.asked, self.offered[source].type)
                if why := context.gate.why_not(Access.SUBSCRIBE, route.session.name, source.topic):
                    self._refuse(route, why)
                elif not contract.same_route(route.contract):
                    self._refuse(route, "its contract has changed here")
                else:
                    route.contract = contract
        return super().reload()

    def link_away(self, peer: int, *, briefly: bool = False) -> Iterator[None]:
        """Suspend the reliable routes of a peer that may come back, and end its other routes, one with each item.

        With ``briefly`` the link fell silent, and all routes are suspended. A suspended route that the peer has not
        opened again over this link starts its outage anew.
        """
        self.link_down(peer)
        for route in self.of(peer):
            if route.sender is not None and (route.reliable or briefly):
                route.number = 0
                self._out.outbound.suspend(route)
            else:
                self._end_route(route)
            yield

    def gone(self, peer: int) -> Iterator[None]:
        """End a peer's open and suspended routes, one with each item."""
        self.link_down(peer)
        for route in self.of(peer):
            self._end_route(route)
            yield

    def outage(self, peer: int) -> float:
        """The longest time, in seconds, for which messages are kept for a peer without a link; 0 if none are."""
        return max((route.outage for route in self.of(peer) if not route.number and route.reliable), default=0.0)

    def given_up(self, route: ExportRoute) -> None:
        """End a suspended route, whose messages are not kept any more."""
        if not route.number:
            self._end_route(route)

    def opened(self, peer: int, message: OpenRoute) -> None:
        """Open a route that a peer asks for, or answer with ``RouteClosed`` and the reason."""
        told, number, limit = self.peers[peer], message.route, self.limit
        if number in told.routes:
            self._out.warn("route.doubled", str(peer), f"a peer opens route {number} twice; the second is ignored")
            return
        asked = Source(message.topic, message.node)
        source = self.local(peer, asked)
        before = self.routes(source).get(peer) if source is not None else None
        if len(told.routes) >= limit:
            why = f"more topics are open on one link than limits.topics = {limit} there"
        elif source is None:
            self._asked_in_vain(peer, asked.topic)
            why = f"{asked}: not published here, or policy keeps it home"
        elif before is not None and before.number:
            # One copy for each peer: otherwise a peer could multiply the traffic of this module at will.
            why = f"{source} is open on another route of this link"
        else:
            self._open(before or ExportRoute(told.session, source), message)
            return
        self._out.send(peer, RouteClosed(number, why))

    def _open(self, route: ExportRoute, message: OpenRoute) -> None:
        """Open a new or suspended route, at once or when its publisher has answered."""
        source, session, local = route.source, route.session, self.offered[route.source]
        flow = self.flows.get(source)
        if flow is None:
            flow = self.flows[source] = self._out.outbound.connect(source, local.uri)
        ours, asked = self._out.context.contracts.of(source.topic, local.type), message.contract
        unknown = self._cut.pop((session.name, source), session.instance) != session.instance
        route.open(message, combine(ours, asked, local.type), unknown=unknown, shared=flow.description is not None)
        self.peers[session.peer].routes[route.number] = flow.routes[session.peer] = route
        if flow.description is not None:
            self._begin(route, flow, flow.description)

    def position(self, source: Source) -> tuple[int, int] | None:
        """What a peer has of a source whose publisher is not connected yet; a relay's own route begins behind it."""
        waiting = (route.position for route in self.routes(source).values() if route.sender is None)
        return min((position for position in waiting if position is not None), default=None)

    def closed(self, peer: int, message: CloseRoute) -> None:
        """End a route that a peer closes; one that is not open is ignored, since both ends may close it at once."""
        if (route := self.route(peer, message.route)) is not None:
            self._end_route(route)

    def described(self, source: Source, description: Description) -> None:
        """Begin to send on the routes of a source whose publisher has answered with its header."""
        if (flow := self.flows.get(source)) is not None:
            flow.description = description
            for route in flow.routes.values():
                if route.sender is None:
                    self._begin(route, flow, description)

    def _begin(self, route: ExportRoute, flow: ExportFlow, about: Description) -> None:
        """Tell a peer that its route is open, and begin to send."""
        latching = about.latching or route.contract.durability is Durability.TRANSIENT_LOCAL
        told = msgspec.structs.replace(about, latching=latching)
        begin, unset = flow.begins(route), msgspec.UNSET
        opened = RouteOpened(route.number, told, route.contract, begin.epoch, begin.first)
        if begin.goes_on:
            opened = msgspec.structs.replace(opened, following=begin.first)
        else:
            opened = msgspec.structs.replace(opened, unknown=route.unknown or unset, shared=route.shared or unset)
        self._out.send(route.peer, opened)
        self._out.outbound.begin(flow, route, begin)

    def _end_route(self, route: ExportRoute) -> None:
        """End the route to one peer, unless it has ended; a source without any is disconnected."""
        flow = self.flows.get(route.source)
        if flow is None or flow.routes.get(route.peer) is not route:
            return
        self._forget(flow, route)
        if not flow.routes and self.flows.get(route.source) is flow:  # its end may have been waited for
            del self.flows[route.source]
            self._out.outbound.disconnect(route.source, flow)

    def _forget(self, flow: ExportFlow, route: ExportRoute) -> None:
        del flow.routes[route.peer]
        if route.number:
            if (told := self.peers.get(route.peer)) is not None:
                told.routes.pop(route.number, None)
        elif route.reliable:
            self._cut[route.session.name, route.source] = route.session.instance
            if len(self._cut) > mesh_limits.LOSSES_REMEMBERED:
                self._cut.popitem(last=False)
        if route.sender is not None:
            self._out.outbound.end(flow, route)

    def _refuse(self, route: ExportRoute, why: str) -> None:
        """End a route, and say why."""
        number = route.number
        self._end_route(route)
        if number:
            self._out.send(route.peer, RouteClosed(number, why))

    def _ended_for(self, peer: int, key: Source) -> None:
        if (route := self.routes(key).get(peer)) is not None:
            self._refuse(route, "it is not offered here any more, or by another name")

    def _ended(self, key: Source, reason: str) -> None:
        flow, local = self.flows.get(key), self.offered.get(key)
        if flow is not None and (local is None or flow.uri != local.uri):
            self.lost(key, reason)

    def lost(self, source: Source, reason: str) -> None:
        """End the routes of a source whose publisher has gone or refused, or that is offered no more.

        The peers are told last: what they open then connects the source anew.
        """
        if (flow := self.flows.pop(source, None)) is None:
            return
        closed = []
        for route in list(flow.routes.values()):
            if route.number:
                last = flow.last(route)
                text = reason[: limits.CONTROL_TEXT_MAX]
                closed.append((route.peer, RouteClosed(route.number, text, msgspec.UNSET if last is None else last)))
            self._forget(flow, route)
        self._out.outbound.disconnect(source, flow)
        for peer, message in closed:
            self._out.send(peer, message)
