"""Which services of the peers appear in the local graph, and which of them are open to be called.

Sans-I/O, like ``bridge.topics.imports`` for topics. The driver passes in the peers' messages, the services of the
local graph, and the services that local nodes want to call; it gets back actions.

A graph has one provider of each service, so one of several is shown: a local one always, else that of the peer with
the lowest GUID, and one that a gateway reaches outside the mesh only if there is no other. The others are hidden,
with the reason, and one of them is shown when the first one leaves. Each service of each peer is in one state of this
table::

    idle ──wanted──► opening ──opened──► open
      ▲                 │ closed, 5 s      │ closed, withdrawn, link down, released
      └─────────────────┴──────────────────┘

What the server of an opened service said of it is remembered until the service is withdrawn or advertised again.
Until then a client's probe is answered without a message to the peer.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain, islice
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge import offers as peer_limits
from rmpa.bridge.actions import Send, Warn
from rmpa.bridge.messages import (
    AdvertiseServices,
    CloseService,
    OpenService,
    ServiceClosed,
    ServiceOffer,
    ServiceOpened,
    is_crossing_name,
)
from rmpa.bridge.offers import NodePlaces, PeerOffers
from rmpa.bridge.policy import OPEN_GATE, PermissionGate, RelayPaths, is_outside
from rmpa.bridge.services.bodies import (
    EndedService,
    ForgetAbout,
    ImportAction,
    OpenedService,
    Provide,
    ServiceAbout,
    Withdraw,
)
from rmpa.bridge.services.exports import TRANSITIONS, RemoteService, ServiceRouteState
from rmpa.config.peer_rules import Access
from rmpa.config.settings import LimitSettings
from rmpa.core.errors import LocalProtocolError, RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    from rmpa.bridge.context import ServiceRules
    from rmpa.bridge.offers import Change


@dataclass(slots=True, kw_only=True)
class _ServiceImportPeer(PeerOffers[str, RemoteService, ServiceOffer]):
    """The services that one run of a peer offers; the things in ``nodes`` are the services' names here.

    Args:
        rank: The value of the peer's GUID; of several services of one name, that with the lowest rank is shown.
        routes: The services that are asked for or open, by their reply route.
        serial: Counts the route numbers that this module chooses for replies: odd ones; the even ones are for
            requests of the peer.
    """

    rank: int
    routes: dict[int, RemoteService] = field(default_factory=dict)
    serial: int = -1


_DEFAULT_LIMITS: Final = LimitSettings()


class ServiceImports:
    """The inbound half: services of the peers, called from this module.

    Args:
        rules: What may cross, and under which names; they apply at the receiving module too.
        limit_settings: How many services and nodes of one peer are taken.
        gate: Decides which services each module may have here.
    """

    def __init__(
        self,
        rules: ServiceRules,
        limit_settings: LimitSettings = _DEFAULT_LIMITS,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._gate = gate
        self._rules = rules
        self.limit_settings = limit_settings
        self._peers: dict[int, _ServiceImportPeer] = {}
        self.ways = RelayPaths(gate.may_relay)
        """The path by which each relayed module is reached."""
        self._local: dict[str, str] = {}
        # By the name here, then by peer: the services that have this name.
        self._claims: dict[str, dict[int, RemoteService]] = {}
        # By the name here: the peer whose service is shown. Of a name that many peers have, not all claims are read.
        self._shown: dict[str, int] = {}
        self._opening: dict[tuple[int, int], RemoteService] = {}

    def __iter__(self) -> Iterator[tuple[int, RemoteService]]:
        """The number of the peer and the service, for each service of each peer."""
        for number, peer in self._peers.items():
            for remote in peer.entries.values():
                yield number, remote

    def get(self, peer: int, service: str) -> RemoteService | None:
        """A peer's service by its name here; ``None`` if the peer offers none of this name."""
        return self._claims.get(service, {}).get(peer)

    def shown(self, service: str) -> tuple[int, RemoteService] | None:
        """The peer's service that is in the local graph by this name."""
        peer = self._shown.get(service)
        return None if peer is None else (peer, self._claims[service][peer])

    def peer_name(self, peer: int) -> str:
        """The name of a peer, for texts."""
        found = self._peers.get(peer)
        return found.name if found is not None else "a peer that is gone"

    def is_away(self, peer: int) -> bool:
        """Whether a peer has no link at this moment and may come back."""
        found = self._peers.get(peer)
        return found is not None and found.away

    def refused(self, peer: int) -> int:
        """The count of a peer's services beyond ``limits.services``."""
        return len(known.refused) if (known := self._peers.get(peer)) is not None else 0

    def refused_nodes(self, peer: int) -> Mapping[str, Collection[str]]:
        """The nodes of a peer that have no place here (``limits.nodes``), and their services."""
        return known.nodes.refused if (known := self._peers.get(peer)) is not None else {}

    # --- links -------------------------------------------------------------------------------------------------

    def link_up(self, peer: int, name: str, rank: int, instance: str = "") -> list[ImportAction]:
        """Add a linked peer, or note that a peer that was away has a link again.

        Args:
            peer: The peer's number.
            name: The peer's name.
            rank: The value of its GUID.
            instance: Its run, as 32 hexadecimal digits.
        """
        known = self._peers.get(peer)
        if known is None:
            self._peers[peer] = _ServiceImportPeer(name=name, nodes=NodePlaces(self.limit_settings.nodes), rank=rank)
        else:
            known.away = False
            known.serial = -1
            known.rank = rank
        return self._choose_of(self.ways.linked(peer, name, instance, rank)) if instance else []

    def unlinked(self, peer: int) -> list[ImportAction]:
        """Choose other paths to the modules that were reached by a peer that is gone.

        Call after ``gone``. A relay may still reach the peer itself, or modules that the peer relayed.
        """
        return self._choose_of(self.ways.unlinked(peer))

    def reached_here(self, instance: str, *, reached: bool) -> list[ImportAction]:
        """Set whether this module reaches another one outside the mesh; what relays bring of that one is hidden."""
        if reached:
            self.ways.reached_here.add(instance)
        else:
            self.ways.reached_here.discard(instance)
        return self._choose_of((instance,))

    def _choose_of(self, instances: Collection[str]) -> list[ImportAction]:
        """Choose again among the services of these modules: another path to them may be the best now."""
        if not instances:
            return []
        touched = [
            service
            for service, claims in self._claims.items()
            if any(remote.origin is not None and remote.origin.instance in instances for remote in claims.values())
        ]
        return [action for service in touched for action in self._choose(service)]

    def link_down(self, peer: int) -> list[ImportAction]:
        """Close the routes of a peer whose link is gone; its services stay in the graph until ``gone``."""
        known = self._peers.get(peer)
        if known is None:
            return []
        known.away = True
        actions: list[ImportAction] = []
        for route in list(known.routes):
            actions += self._end(peer, route, f"the link to {known.name} was lost")
        return actions

    def gone(self, peer: int) -> list[ImportAction]:
        """Remove a peer that does not come back, or not soon: its services leave the local graph."""
        known = self._peers.get(peer)
        if known is None:
            return []
        actions = self.link_down(peer)
        known.give_up()
        for wire in list(known.entries):
            actions += self._remove(peer, wire, f"{known.name} is gone")
        del self._peers[peer]
        return actions

    def keep(self, peer: int, services: Collection[str]) -> list[ImportAction]:
        """Remove the services of a peer without a link, except some shown ones that are called directly.

        Args:
            peer: The peer's number.
            services: The names here of those that stay until ``gone``, or until the peer has a link again.
        """
        known = self._peers.get(peer)
        if known is None:
            return []
        actions = self.link_down(peer)
        known.give_up()
        for wire, remote in list(known.entries.items()):
            if not remote.shown or remote.name not in services:
                actions += self._remove(peer, wire, f"{known.name} is gone")
        return actions

    # --- what peers offer --------------------------------------------------------------------------------------

    def portions(self, peer: int, message: AdvertiseServices) -> Iterator[Change[ServiceOffer, str]]:
        """Split an advertisement into portions for ``take_in``, each of which is applied quickly."""
        known, full, more = self._peers.get(peer), message.full, message.more
        if known is None:
            return iter(())
        return known.changes(message.added, message.removed, lambda offer: offer.service, full=full, more=more)

    def take_in(self, peer: int, change: Change[ServiceOffer, str]) -> list[ImportAction]:
        """Apply a portion of a peer's advertisement."""
        known = self._peers.get(peer)
        if known is None:
            return []
        actions: list[ImportAction] = []
        for wire in change.removed:
            known.refused.pop(wire, None)
            actions += self._remove(peer, wire, f"its server at {known.name} has gone")
        for offer in change.added:
            actions += self._offer(peer, known, offer)
        admitted = islice(self._admit(peer), limits.APPLIED_AT_ONCE)
        return actions + [action for one in admitted for action in one]

    def advertised(self, peer: int, message: AdvertiseServices) -> list[ImportAction]:
        """Apply a peer's advertisement as a whole."""
        return [action for change in self.portions(peer, message) for action in self.take_in(peer, change)]

    def _admit(self, peer: int) -> Iterator[list[ImportAction]]:
        """Take services that were refused beyond ``limits.services``, one at a time, while there is room."""
        while (known := self._peers.get(peer)) and (offer := known.admitted(self.limit_settings.services)):
            yield self._offer(peer, known, offer)

    def _offer(self, peer: int, known: _ServiceImportPeer, offer: ServiceOffer) -> list[ImportAction]:
        before = known.entries.get(offer.service)
        actions: list[ImportAction] = []
        if before is not None and (before.node, before.origin) == (offer.node, offer.origin):
            # The same offer again: the server was replaced, or the link is a new one; its type may have changed.
            before.about = None
            return [ForgetAbout(peer, before.name)] if before.shown else []
        if before is not None:
            actions += self._remove(peer, offer.service, f"another node of {known.name} provides it now")
        elif len(known.entries) >= self.limit_settings.services:
            known.refuse(offer.service, offer)
            text = peer_limits.warning(known.name, "services", self.limit_settings.services)
            return [Warn("services.too_many", known.name, text)]
        name = self._rules.local_name(offer.origin.name if offer.origin else known.name, offer.service)
        remote = known.entries[offer.service] = RemoteService(offer.service, offer.node, name, origin=offer.origin)
        if offer.origin is not None and self.ways.count(peer, offer.origin, 1):
            actions += self._choose_of({offer.origin.instance})
        if not is_crossing_name(name):
            remote.hidden = f"the rules of names make {name!r} of it"
            return actions
        others = self._claims.setdefault(name, {})
        if peer in others:
            remote.hidden = f"{others[peer].wire} of the same peer has this name here already"
            return actions
        others[peer] = remote
        return actions + self._claim(name, peer, remote)

    def _remove(self, peer: int, wire: str, reason: str) -> list[ImportAction]:
        known = self._peers[peer]
        remote = known.entries.pop(wire, None)
        if remote is None:
            return []
        known.nodes.leave(remote.node, remote.name)
        # Messages may have crossed: the route asked for last may be open at the peer, for another server perhaps.
        actions = self._release(peer, remote, reason)
        another_way = remote.origin is not None and self.ways.count(peer, remote.origin, -1)
        was_shown, remote.shown = remote.shown, False
        if was_shown:
            del self._shown[remote.name]
            actions.append(Withdraw(peer, remote.name, remote.node, reason))
            known.nodes.hide(remote.node)
        claims = self._claims.get(remote.name, {})
        if claims.get(peer) is remote:
            del claims[peer]
            if not claims:
                del self._claims[remote.name]
            elif was_shown:
                actions += self._choose(remote.name)
        if remote.origin is not None and another_way:
            actions += self._choose_of({remote.origin.instance})
        return actions + self._next_in(known)

    def _next_in(self, known: _ServiceImportPeer) -> list[ImportAction]:
        """Choose again among the services that were refused a node's place, as far as places are free."""
        actions: list[ImportAction] = []
        for refused in known.nodes.admitted():
            for name in refused:
                if name in self._claims:
                    actions += self._choose(name)
        return actions

    # --- which is shown ----------------------------------------------------------------------------------------

    def local(self, service: str, node: str | None) -> list[ImportAction]:
        """Set the node of this module that provides a service; it has precedence over the peers' ones.

        Args:
            service: The service's name here.
            node: The node; ``None`` if no node of this module provides it.
        """
        if node is None:
            self._local.pop(service, None)
        else:
            self._local[service] = node
        return self._choose(service) if service in self._claims else []

    def apply_rules(
        self, rules: ServiceRules, limit_settings: LimitSettings = _DEFAULT_LIMITS
    ) -> Iterator[list[ImportAction]]:
        """Replace the rules; services that they do not affect stay shown and open.

        Returns:
            The actions for one service after the other; each service is judged when its item is requested.
        """
        self._rules, self.limit_settings = rules, limit_settings
        for known in self._peers.values():
            known.nodes.limit = limit_settings.nodes
        offers = [(number, wire) for number, known in self._peers.items() for wire in known.entries]
        # A second time, for services whose new name was still the old name of another one.
        judged = (self._rejudge(number, wire, again=again) for again in (False, True) for number, wire in offers)
        return chain(judged, (actions for number in list(self._peers) for actions in self._admit(number)))

    def _rejudge(self, number: int, wire: str, *, again: bool) -> list[ImportAction]:
        known = self._peers.get(number)
        remote = known.entries.get(wire) if known is not None else None
        if known is None or remote is None:
            return []
        name = self._rules.local_name(remote.origin.name if remote.origin else known.name, wire)
        claimed = self._claims.get(remote.name, {}).get(number)
        if name != remote.name or (claimed is None and is_crossing_name(name)):
            actions = self._remove(number, wire, "a rule has another name for it now")
            return actions + self._offer(number, known, ServiceOffer(wire, remote.node, remote.origin))
        if again or claimed is not remote or next(iter(self._claims[name])) != number:
            return []  # the first claim to a name stands for all of them
        return self._choose(name)

    def _claim(self, service: str, number: int, remote: RemoteService) -> list[ImportAction]:
        """Choose after one more claim to a name; the others are not judged again if the one that is shown stays.

        Modules of one kind have the same names, so a name may have as many claims as there are modules.
        """
        first, local = self._shown.get(service), self._local.get(service)
        claims = self._claims[service]
        objection = self._objection(service, number, remote)
        if local is not None:
            remote.hidden = self._own_first(local)
        elif first is not None and self._preference(first, claims[first]) < self._preference(number, remote):
            remote.hidden = self._outranked(first)
        elif objection is not None:
            remote.hidden = objection
        else:
            return self._choose(service)
        return []

    @staticmethod
    def _own_first(local: str) -> str:
        return f"{local} of this module provides it itself"

    def _outranked(self, first: int) -> str:
        return f"{self._peers[first].name} provides it too, and is shown: its GUID is lower"

    def _choose(self, service: str) -> list[ImportAction]:
        """Choose the one service of this name that is shown, and hide those of the other peers."""
        claims = self._claims[service]
        local = self._local.get(service)
        seen: str | None = self._own_first(local) if local is not None else None
        new: tuple[int, RemoteService] | None = None
        left: list[_ServiceImportPeer] = []
        actions: list[ImportAction] = []
        for number in sorted(claims, key=lambda number: self._preference(number, claims[number])):
            remote = claims[number]
            nodes = self._peers[number].nodes
            # Judged only where it matters: a thousand modules may have this name.
            objection = self._objection(service, number, remote) if seen is None or remote.shown else None
            hidden = seen or objection
            nodes.leave(remote.node, service)
            if hidden is None and not nodes.free(remote.node):
                nodes.refuse(remote.node, service)
                hidden = f"{self._peers[number].name} has more nodes than limits.nodes = {nodes.limit} of this module"
            if hidden is None:
                new = (number, remote)
                seen = self._outranked(number)
            elif remote.shown:
                actions += self._hide(number, remote, hidden)
                left.append(self._peers[number])
            if hidden is not None:
                remote.hidden = hidden
        if new is not None and not new[1].shown:
            number, remote = new
            remote.shown, remote.hidden = True, ""
            self._shown[service] = number
            self._peers[number].nodes.show(remote.node)
            actions.append(Provide(number, service, remote.node))
        # Only now: the services that this chooses could take the place that was found free above.
        return actions + [action for known in left for action in self._next_in(known)]

    def _preference(self, number: int, remote: RemoteService) -> tuple[bool, int, int]:
        """Sorts the claims to a name: modules of this mesh before what gateways reach, then by GUID."""
        return remote.origin is not None and is_outside(remote.origin), self._peers[number].rank, number

    def _objection(self, service: str, number: int, remote: RemoteService) -> str | None:
        origin = remote.origin
        before, remote.denied = remote.denied, False
        if origin is not None and (why := self.ways.why_not(number, origin)):
            return why
        decision = self._rules.judge(service, remote.node if origin is None else origin.node)
        for name in (self._peers[number].name, *([origin.name] if origin is not None else ())):
            if decision.allowed:
                decision = self._rules.judge_for(name, service, remote.wire)
        if not decision.allowed:
            return f"policy: {decision.rule}"
        name = self._peers[number].name
        module, relay = (name, "") if origin is None else (origin.name, name)
        permission = self._gate.judge(Access.SERVE, module, service, relay=relay)
        if permission.allowed:
            return None
        remote.denied = True
        if not before:
            self._gate.refused(Access.SERVE, module, service, permission, relay=relay)
        return permission.rule

    def _hide(self, number: int, remote: RemoteService, reason: str) -> list[ImportAction]:
        actions = self._release(number, remote, reason)
        remote.shown = False
        if self._shown.get(remote.name) == number:
            del self._shown[remote.name]
        self._peers[number].nodes.hide(remote.node)
        return [*actions, Withdraw(number, remote.name, remote.node, reason)]

    # --- calling -----------------------------------------------------------------------------------------------

    def want(self, peer: int, service: str, now: float) -> list[ImportAction]:
        """Open a service that a local node wants to call, or whose type it wants to know.

        An ``OpenedService`` or ``EndedService`` follows; no action results if the route is asked for or open already.

        Raises:
            LocalProtocolError: The service is not shown, or its peer has no link: check before the call.
        """
        known, remote = self._peers.get(peer), self.get(peer, service)
        if known is None or remote is None or not remote.shown or known.away:
            raise LocalProtocolError(f"{service} of peer {peer} cannot be opened")
        if remote.state is not ServiceRouteState.IDLE:
            return []
        known.serial += 2
        remote.route = limits.SERVICE_ROUTES + known.serial
        remote.due = now + limits.ROUTE_OPEN_TIMEOUT
        known.routes[remote.route] = remote
        self._opening[peer, remote.route] = remote
        self._enter(remote, ServiceRouteState.OPENING)
        return [Send(peer, OpenService(remote.route, remote.wire, self._rules.timeout(service)))]

    def opened(self, peer: int, message: ServiceOpened) -> list[ImportAction]:
        """Handle a peer's answer that a service is open.

        A route that was given up meanwhile is ignored: this module's own ``CloseService`` may have crossed the peer's
        message.

        Raises:
            RemoteProtocolError: The route was open already.
        """
        known = self._peers.get(peer)
        remote = known.routes.get(message.route) if known is not None else None
        if remote is None:
            return []
        if remote.state is not ServiceRouteState.OPENING:
            raise RemoteProtocolError(f"route {message.route} of {remote.wire} is opened twice")
        del self._opening[peer, message.route]
        self._enter(remote, ServiceRouteState.OPEN)
        remote.requests = message.requests
        remote.problem = ""
        remote.about = ServiceAbout(message.type, message.md5, message.request_type, message.response_type)
        return [OpenedService(peer, remote.name, message.route, message.requests, remote.about)]

    def closed(self, peer: int, message: ServiceClosed) -> list[ImportAction]:
        """Handle a peer's message that a service cannot be called, or no longer; unknown routes are ignored."""
        known = self._peers.get(peer)
        if known is None or message.route not in known.routes:
            return []
        return self._end(peer, message.route, message.reason)

    def release(self, peer: int, service: str, reason: str = "no node calls it") -> list[ImportAction]:
        """Close the route of a service that is not needed now; the next call opens it again."""
        remote = self.get(peer, service)
        return self._release(peer, remote, reason) if remote is not None else []

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, in monotonic seconds; ``None``: no route is asked for."""
        return min((remote.due for remote in self._opening.values()), default=None)

    def handle_timer(self, now: float) -> list[ImportAction]:
        """Give up the routes that the peers have not opened in time."""
        actions: list[ImportAction] = []
        for (peer, _), remote in list(self._opening.items()):
            if remote.due <= now:
                text = f"the agent of {self.peer_name(peer)} does not answer"
                actions += self._release(peer, remote, text)
                remote.problem = text
        return actions

    def _release(self, peer: int, remote: RemoteService, reason: str) -> list[ImportAction]:
        if not remote.route:
            return []
        route, known = remote.route, self._peers[peer]
        actions = self._end(peer, route, reason)
        return actions if known.away else [Send(peer, CloseService(route)), *actions]

    def _end(self, peer: int, route: int, reason: str) -> list[ImportAction]:
        remote = self._peers[peer].routes.pop(route)
        self._opening.pop((peer, route), None)
        self._enter(remote, ServiceRouteState.IDLE)
        requests, remote.route, remote.requests = remote.requests, 0, 0
        remote.problem = reason
        return [EndedService(peer, remote.name, route, requests, reason)]

    def _enter(self, remote: RemoteService, state: ServiceRouteState) -> None:
        if state not in TRANSITIONS[remote.state]:
            raise LocalProtocolError(f"{remote.wire}: {remote.state.name} does not lead to {state.name}")
        remote.state = state
