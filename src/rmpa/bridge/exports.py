"""Which local sources are offered to which peers, and which are flowing (one copy a peer, on demand).

Sans-I/O: the driver tells what the local graph holds, what peers ask for and what became of the connections to
local publishers; it gets back actions.

A source is connected while at least one peer wants it::

    idle ──open──► connecting ──described──► live
      ▲               │ refused, lost          │ lost, restarted, gone
      └───────────────┴────────────────────────┘  every route of it: Closed(reason)

Who lost a route asks again: the one that wants the data is the one that retries. A reliable route outlives its
link: it is suspended, its source stays connected, and the peer's next ``Open`` goes on where it was (``link_away``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import msgspec

from rmpa.bridge.actions import Action, AddRoute, Connect, Disconnect, RemoveRoute, Send, SuspendRoute, Warn
from rmpa.bridge.messages import (
    Advertise,
    Close,
    Closed,
    Description,
    Offer,
    Open,
    Opened,
    Source,
    is_crossing_name,
    is_crossing_type,
)
from rmpa.core import limits
from rmpa.core.contract import Contract, Contracts, Durability, Reliability, combine

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.policy import Policy


@dataclass(frozen=True, slots=True)
class LocalSource:
    """A source of the local graph: its message type and its node's slave API."""

    type: str
    uri: str


@dataclass(slots=True)
class _Route:
    """One peer's wish for a source.

    Args:
        contract: What holds for it.
        live: Whether data goes there yet.
        epoch: Of a reliable route, else 0.
        after: Where a suspended one goes on.
    """

    contract: Contract
    live: bool = False
    epoch: int = 0
    after: int | None = None


@dataclass(slots=True)
class _Flow:
    """A source that some peer wants."""

    uri: str
    routes: dict[tuple[int, int], _Route] = field(default_factory=dict)
    """By (peer, route)."""
    away: dict[int, _Route] = field(default_factory=dict)
    """Suspended, by peer."""
    description: Description | None = None

    @property
    def wanted(self) -> bool:
        return bool(self.routes or self.away)


class Exports:
    """The outbound half of the bridge.

    Args:
        policy: What may cross.
        contracts: What our side promises.
    """

    def __init__(self, policy: Policy, contracts: Contracts | None = None) -> None:
        self._policy = policy
        self._contracts = contracts if contracts is not None else Contracts()
        self._epochs = 0
        self._local: dict[Source, LocalSource] = {}
        self._peers: dict[int, dict[int, Source]] = {}
        self._flows: dict[Source, _Flow] = {}

    @property
    def offered(self) -> Mapping[Source, LocalSource]:
        """What peers are told of."""
        return self._local

    def flowing(self, source: Source) -> tuple[int, ...]:
        """The peers that a source goes to now."""
        flow = self._flows.get(source)
        return tuple(peer for (peer, _), route in flow.routes.items() if route.live) if flow else ()

    def contract(self, source: Source, peer: int) -> Contract | None:
        """What holds for a source's route to a peer, while there is one."""
        flow = self._flows.get(source)
        return next((route.contract for (p, _), route in flow.routes.items() if p == peer), None) if flow else None

    def description(self, source: Source) -> Description | None:
        """What is known of a source's messages, while it flows."""
        flow = self._flows.get(source)
        return flow.description if flow else None

    def graph(self, sources: Mapping[Source, LocalSource]) -> list[Action]:
        """The local graph changed: ``sources`` is all that it publishes now, proxies left out."""
        crossing = [
            source
            for source, local in sources.items()
            if is_crossing_type(local.type)
            and is_crossing_name(source.topic)
            and is_crossing_name(source.node)
            and self._policy.judge(source.topic, local.type, source.node).allowed
        ]
        actions: list[Action] = []
        if len(crossing) > limits.TOPICS_PER_PEER_MAX:
            crossing = sorted(crossing)[: limits.TOPICS_PER_PEER_MAX]
            text = f"more than {limits.TOPICS_PER_PEER_MAX} sources would cross; the rest stays home: deny some"
            actions.append(Warn("sources.too_many", "local", text))
        new = {source: sources[source] for source in crossing}
        old, self._local = self._local, new
        removed = tuple(s for s in old if s not in new)
        # A type that changed is removed and offered again; a new address alone is nobody's business but ours.
        added = tuple(
            Offer(s.topic, s.node, local.type)
            for s, local in new.items()
            if s not in old or old[s].type != local.type
        )
        for source in [s for s, flow in self._flows.items() if s not in new or new[s].uri != flow.uri]:
            why = "the node has gone" if source not in new else "the node has restarted"
            actions += self._end(source, why)
        if added or removed:
            actions += [Send(peer, Advertise(added=added, removed=removed)) for peer in self._peers]
        return actions

    def link_up(self, peer: int) -> list[Action]:
        """A link is up: tell all we have."""
        self._peers[peer] = {}
        offers = tuple(Offer(s.topic, s.node, local.type) for s, local in self._local.items())
        return [Send(peer, Advertise(added=offers, full=True))]

    def link_down(self, peer: int) -> list[Action]:
        """A peer is gone for good, and all its routes, suspended ones too."""
        actions: list[Action] = []
        for route, source in self._peers.pop(peer, {}).items():
            actions += self._remove(source, peer, route)
        for source, flow in list(self._flows.items()):
            if flow.away.pop(peer, None) is not None:
                actions += [RemoveRoute(source, peer, 0), *self._disconnect(source, flow)]
        return actions

    def link_away(self, peer: int) -> tuple[list[Action], bool]:
        """A link is gone, but its peer may come back.

        Returns:
            What to do, and whether a reliable route waits for the peer: if none does, ``link_down`` it.
        """
        actions: list[Action] = []
        for number, source in self._peers.pop(peer, {}).items():
            flow = self._flows.get(source)
            route = flow.routes.get((peer, number)) if flow is not None else None
            if flow is None or route is None or not (route.live and route.epoch):
                actions += self._remove(source, peer, number)
                continue
            del flow.routes[peer, number]
            flow.away[peer] = route
            actions.append(SuspendRoute(source, peer))
        return actions, self.waits_for(peer)

    def waits_for(self, peer: int) -> bool:
        """Whether a reliable route waits for a peer without a link."""
        return any(peer in flow.away for flow in self._flows.values())

    def opened(self, peer: int, message: Open) -> list[Action]:
        """A peer asks for a source."""
        routes = self._peers[peer]
        if message.route in routes:
            return [
                Warn("route.doubled", str(peer), f"a peer opens route {message.route} twice; the second is ignored")
            ]
        if len(routes) >= limits.ROUTES_PER_LINK_MAX:
            return [Send(peer, Closed(message.route, f"more than {limits.ROUTES_PER_LINK_MAX} routes on one link"))]
        source = message.source
        local = self._local.get(source)
        if local is None:
            return [Send(peer, Closed(message.route, f"{source}: not published here, or policy keeps it home"))]
        flow = self._flows.get(source)
        if flow is not None and any(other == peer for other, _ in flow.routes):
            # One copy a peer: more would let it multiply what we send at will.
            return [Send(peer, Closed(message.route, f"{source} is open on another route of this link"))]
        routes[message.route] = source
        route = self._route(message, local, flow.away.pop(peer, None) if flow is not None else None)
        if flow is None:
            flow = self._flows[source] = _Flow(local.uri)
            flow.routes[peer, message.route] = route
            return [Connect(source, local.type, local.uri)]
        flow.routes[peer, message.route] = route
        if flow.description is None:
            return []
        return self._start(source, flow, flow.description)

    def _route(self, message: Open, local: LocalSource, away: _Route | None) -> _Route:
        """The wish of a peer; it goes on where a suspended one was if it names that one's epoch."""
        contract = combine(self._contracts.of(message.topic, local.type), message.contract)
        if contract.reliability is not Reliability.RELIABLE:
            return _Route(contract)
        if away is not None and away.epoch == message.epoch:
            return _Route(contract, epoch=away.epoch, after=message.after)
        self._epochs += 1
        return _Route(contract, epoch=self._epochs)

    def closed(self, peer: int, message: Close) -> list[Action]:
        """A peer wants no more of a route; one that is not open is none of our worry (it crossed ours)."""
        source = self._peers[peer].pop(message.route, None)
        return self._remove(source, peer, message.route) if source is not None else []

    def described(self, source: Source, description: Description) -> list[Action]:
        """The local publisher has answered with its header."""
        flow = self._flows.get(source)
        if flow is None:
            return []
        flow.description = description
        return self._start(source, flow, description)

    def lost(self, source: Source, reason: str) -> list[Action]:
        """The local publisher hung up, refused or does not answer."""
        return self._end(source, reason, connected=False)

    def _start(self, source: Source, flow: _Flow, description: Description) -> list[Action]:
        actions: list[Action] = []
        for (peer, number), route in flow.routes.items():
            if route.live:
                continue
            route.live = True
            about = description
            if route.contract.durability is Durability.TRANSIENT_LOCAL and not about.latching:
                about = msgspec.structs.replace(about, latching=True)
            actions += [
                Send(peer, Opened(number, about, route.contract, route.epoch)),
                AddRoute(source, peer, number, route.contract, route.epoch, route.after),
            ]
        return actions

    def _remove(self, source: Source, peer: int, route: int) -> list[Action]:
        flow = self._flows.get(source)
        if flow is None:
            return []
        gone = flow.routes.pop((peer, route), None)
        actions: list[Action] = [RemoveRoute(source, peer, route)] if gone is not None and gone.live else []
        return actions + self._disconnect(source, flow)

    def _disconnect(self, source: Source, flow: _Flow) -> list[Action]:
        """Leave a source that nobody wants any more."""
        if flow.wanted:
            return []
        del self._flows[source]
        return [Disconnect(source)]

    def _end(self, source: Source, reason: str, *, connected: bool = True) -> list[Action]:
        flow = self._flows.pop(source, None)
        if flow is None:
            return []
        actions: list[Action] = []
        actions += [RemoveRoute(source, peer, 0) for peer in flow.away]
        for (peer, number), route in flow.routes.items():
            self._peers[peer].pop(number, None)
            if route.live:
                actions.append(RemoveRoute(source, peer, number))
            actions.append(Send(peer, Closed(number, reason)))
        if connected:
            actions.append(Disconnect(source))
        return actions
