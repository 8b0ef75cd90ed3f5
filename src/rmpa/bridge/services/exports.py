"""Which services of the local graph are offered to peers, and which of them each peer has open to call.

Sans-I/O, like ``bridge.topics.exports`` for topics. The driver passes in changes of the local graph, peers' requests,
and what servers said of their services; it gets back actions. A peer opens a service once for all of its clients::

    open ──server known──► ServiceOpened, ServeRoute ──closed, gone, restarted──► EndRoute
      │                                                                              ▲
      └──► Probe ──described──► …      ──refused──► ServiceClosed                    │ link down
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.actions import Send
from rmpa.bridge.messages import (
    AdvertiseServices,
    CloseService,
    OpenService,
    ServiceClosed,
    ServiceOffer,
    ServiceOpened,
    is_crossing_name,
)
from rmpa.bridge.offers import CataloguePeer, OfferCatalogue, Portion
from rmpa.bridge.policy import OPEN_GATE, PermissionGate, may_have
from rmpa.bridge.services.bodies import (
    EndRoute,
    ExportAction,
    LocalService,
    Probe,
    ServerGone,
    ServeRoute,
    ServiceAbout,
)
from rmpa.config.peer_rules import Access
from rmpa.config.settings import LimitSettings
from rmpa.core.errors import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.bridge.context import ServiceRules
    from rmpa.bridge.messages import Origin


# One service of one peer, and the states in which it can be called or not. Pure.


class ServiceRouteState(Enum):
    """Whether a service of a peer can be called now."""

    IDLE = auto()
    """No route is open or asked for."""
    OPENING = auto()
    """The route is asked for, and the peer has not answered."""
    OPEN = auto()
    """The service can be called."""


_S = ServiceRouteState
TRANSITIONS: Final[Mapping[ServiceRouteState, frozenset[ServiceRouteState]]] = {
    _S.IDLE: frozenset({_S.OPENING}),
    _S.OPENING: frozenset({_S.OPEN, _S.IDLE}),
    _S.OPEN: frozenset({_S.IDLE}),
}


@dataclass(slots=True)
class RemoteService:
    """One service of one peer.

    Args:
        wire: Its name on the wire.
        node: Its node, in the peer's graph.
        name: Its name here.
        shown: Whether it is in the local graph.
        hidden: Why it is not in the local graph, or empty.
        denied: Whether it is hidden because no permission lets its module serve it here.
        state: Whether it can be called now.
        route: The route of its replies while it is asked for or open; else 0.
        requests: The route of its requests while it is open; else 0.
        due: While it is asked for: when the peer's answer is overdue, in monotonic seconds.
        about: What its server said of it; ``None`` while that is unknown.
        problem: Why it could not be opened or was closed last, or empty.
        origin: Its module and node, if the peer relays it.
    """

    wire: str
    node: str
    name: str
    shown: bool = False
    hidden: str = ""
    denied: bool = False
    state: ServiceRouteState = ServiceRouteState.IDLE
    route: int = 0
    requests: int = 0
    due: float = 0.0
    about: ServiceAbout | None = None
    problem: str = ""
    origin: Origin | None = None


@dataclass(slots=True)
class _ServiceRoute:
    """A route to a service that one peer has asked for.

    Args:
        service: The service's local name.
        timeout: Seconds that the peer allows for each call.
        requests: The route that requests come in on; 0 until it is open.
    """

    service: str
    timeout: float
    requests: int = 0


@dataclass(slots=True)
class _Callers:
    """The routes of one linked peer.

    Args:
        sessions: The routes that it has asked for, by its own route number.
        routes: Counts the route numbers that this module chooses for requests of this peer. They are even; the odd
            ones are for replies to this module's own calls.
    """

    sessions: dict[int, _ServiceRoute] = field(default_factory=dict)
    routes: int = 0


_Peer = CataloguePeer[str, LocalService, ServiceOffer, str]
_Portion = Portion[str, ServiceOffer, str]
_DEFAULT_LIMITS: Final = LimitSettings()


class ServiceExports:
    """The outbound half: services of this module, called by peers.

    Args:
        rules: What may cross, and under which names.
        limit_settings: How many services are offered.
        gate: Decides which services each peer may call.
    """

    def __init__(
        self,
        rules: ServiceRules,
        limit_settings: LimitSettings = _DEFAULT_LIMITS,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._gate = gate
        self._rules = rules
        self._catalogue: OfferCatalogue[str, LocalService, ServiceOffer, str] = OfferCatalogue(
            "services",
            limit_settings.services,
            offer=self._offer,
            wire=lambda offer: offer.service,
            # Another server under the same name: what peers know of it may no longer be true.
            renewed=lambda before, now: before != now,
        )
        self.seen: dict[str, LocalService] = {}
        """The server of every service of the local graph, whether the service crosses or not."""
        self._about: dict[str, ServiceAbout] = {}
        self._peers: dict[int, _Callers] = {}

    @property
    def offered(self) -> Mapping[str, LocalService]:
        """The servers of the services that are offered to peers."""
        return self._catalogue.offered

    @property
    def beyond(self) -> int:
        """The count of services that are offered to no peer because there are too many (``limits.services``)."""
        return self._catalogue.beyond

    def local(self, peer: int, wire: str) -> str | None:
        """The local service that is offered to a peer by a name on the wire; ``None`` if there is none."""
        known = self._catalogue.peer(peer)
        service = known.by_wire.get(wire) if known is not None else None
        if known is None or service is None or service not in self.offered:
            return None
        # After new rules, the peer is told of the services a little later.
        return service if self._gate.judge(Access.CALL, known.name, service).allowed else None

    def about(self, service: str) -> ServiceAbout | None:
        """What a service's server has said of it; ``None`` while that is unknown."""
        return self._about.get(service)

    def callers(self, service: str) -> tuple[int, ...]:
        """The numbers of the peers that have a service open."""
        return tuple(
            number
            for number, peer in self._peers.items()
            if any(session.service == service and session.requests for session in peer.sessions.values())
        )

    @property
    def pending(self) -> bool:
        """Whether there is something to ``advertise``."""
        return self._catalogue.pending

    # --- the local graph ---------------------------------------------------------------------------------------

    def graph(self, service: str, server: LocalService | None) -> list[ExportAction]:
        """Set a service's present server, or that it has none; ``advertise`` sends the change to the peers.

        Args:
            service: The service's local name.
            server: Its server; ``None`` where there is none, or only a proxy that is not relayed.
        """
        if self.seen.get(service) == server:
            return []
        if server is None:
            del self.seen[service]
        else:
            self.seen[service] = server
        return self._judge(service)

    def apply_rules(
        self, rules: ServiceRules, limit_settings: LimitSettings = _DEFAULT_LIMITS
    ) -> Iterator[list[ExportAction]]:
        """Replace the rules; routes of services that the new rules still allow stay open.

        Returns:
            The actions for one service after the other; each service is judged when its item is requested.
        """
        self._rules, self._catalogue.limit = rules, limit_settings.services
        for known in self._catalogue.peers():
            self._catalogue.note_all(known)
        return self._rejudge()

    def _rejudge(self) -> Iterator[list[ExportAction]]:
        yield self._end_denied()
        for service in tuple(self.seen):
            yield self._judge(service)

    def _end_denied(self) -> list[ExportAction]:
        """End the routes that no permission allows any more."""
        actions: list[ExportAction] = []
        for number, peer in self._peers.items():
            known = self._catalogue.peer(number)
            if known is None or not self._gate.on:
                continue
            for route, session in list(peer.sessions.items()):
                if why := self._gate.why_not(Access.CALL, known.name, session.service):
                    actions += self._drop(number, peer, route, why)
        return actions

    def _judge(self, service: str) -> list[ExportAction]:
        server, before = self.seen.get(service), self.offered.get(service)
        reason = "its server has gone"
        if server is not None and not self._crosses(service, server):
            server, reason = None, "a rule keeps it home now"
        if server is None:
            if not self._catalogue.remove(service):
                return []
            self._catalogue.note(service)
            actions = self._end(service, reason)
            if (waiting := self._catalogue.next_beyond()) is not None:
                actions += self._judge(waiting[0])
            return actions
        if server == before:
            return []
        if not self._catalogue.put(service, server):
            return [self._catalogue.warning("services.too_many")]
        self._catalogue.note(service)
        return self._end(service, "its server has restarted") if before is not None else []

    def _crosses(self, service: str, server: LocalService) -> bool:
        named = is_crossing_name(service) and is_crossing_name(server.node)
        node = server.node if server.origin is None else server.origin.node
        return named and self._rules.judge(service, node).allowed

    def _end(self, service: str, reason: str) -> list[ExportAction]:
        """End all routes to a service whose server left, was replaced, or may no longer be called."""
        self._about.pop(service, None)
        actions: list[ExportAction] = []
        for number, peer in self._peers.items():
            for route, session in list(peer.sessions.items()):
                if session.service == service:
                    actions += self._drop(number, peer, route, f"{service}: {reason}")
        return [*actions, ServerGone(service)]

    # --- advertising -------------------------------------------------------------------------------------------

    def link_up(self, peer: int, name: str, instance: str = "") -> list[ExportAction]:
        """Begin the advertisement to a peer; ``advertise`` goes on with it.

        What came from this very run of the peer is not offered to it.

        Args:
            peer: The peer's number.
            name: The peer's name.
            instance: The peer's run, as 32 hexadecimal digits.
        """
        self._peers[peer] = _Callers()
        return _told_portion(peer, self._catalogue.link_up(peer, name, instance, judged=False))

    def link_down(self, peer: int) -> list[ExportAction]:
        """End all routes of a peer whose link is gone."""
        self._catalogue.link_down(peer)
        gone = self._peers.pop(peer, None)
        sessions = gone.sessions.items() if gone is not None else ()
        return [EndRoute(peer, route, s.requests) for route, s in sessions if s.requests]

    def advertise(self, ready: Callable[[int], bool] = lambda _: True) -> list[ExportAction]:
        """At most one message for each peer that has changes to be sent and is ready; call again while ``pending``.

        Args:
            ready: ``(peer)``: whether a message may be sent to this peer now.
        """
        return [
            action for peer, portion in self._catalogue.portions(ready) for action in _told_portion(peer, portion)
        ]

    def _offer(self, known: _Peer, service: str, server: LocalService) -> ServiceOffer | None:
        """The offer of a service to one peer; ``None`` if that peer may not have it."""
        if server.origin is not None and not may_have(known.instance, server.origin):
            return None
        wire = self._rules.wire_name(known.name, service)
        if not is_crossing_name(wire) or not self._rules.judge_for(known.name, service, wire).allowed:
            return None
        if not self._gate.admits(Access.CALL, known.name, service):
            return None
        return ServiceOffer(wire, server.node, server.origin)

    # --- their calls -------------------------------------------------------------------------------------------

    def opened(self, number: int, message: OpenService) -> list[ExportAction]:
        """Handle a peer's request to open a service.

        Raises:
            RemoteProtocolError: The peer's route is in use.
        """
        peer = self._peers[number]
        if message.route in peer.sessions:
            raise RemoteProtocolError(f"route {message.route} is opened twice, for {message.service} now")
        if len(peer.sessions) >= self._catalogue.limit:
            text = f"more services are open on one link than limits.services = {self._catalogue.limit} over there"
            return [Send(number, ServiceClosed(message.route, text))]
        service = self.local(number, message.service)
        server = self.offered.get(service) if service is not None else None
        if service is None or server is None:
            self._report_denied(number, message.service)
            text = f"{message.service} is not provided here, or policy keeps it home"
            return [Send(number, ServiceClosed(message.route, text))]
        waiting = any(
            s.service == service and not s.requests for p in self._peers.values() for s in p.sessions.values()
        )
        peer.sessions[message.route] = _ServiceRoute(service, message.timeout)
        if service in self._about:
            return self._start(service)
        return [] if waiting else [Probe(service, server)]

    def _report_denied(self, number: int, wire: str) -> None:
        """Report a service that a peer asks for without permission; the answer is as if there were none."""
        known = self._catalogue.peer(number)
        if known is not None and self._gate.on:
            self._gate.admits(Access.CALL, known.name, self._rules.own_name(known.name, wire))

    def closed(self, number: int, message: CloseService) -> list[ExportAction]:
        """Handle a peer's message that it will not call a service any more.

        A route that is not open is ignored: this module's own ``ServiceClosed`` may have crossed the peer's message.
        """
        session = self._peers[number].sessions.pop(message.route, None)
        if session is None or not session.requests:
            return []
        return [EndRoute(number, message.route, session.requests)]

    def described(self, service: str, server: LocalService, about: ServiceAbout) -> list[ExportAction]:
        """Store what a server said of its service, and open the routes that waited for it.

        Ignored if the service has another server by now.
        """
        if self.offered.get(service) != server:
            return []  # the service has another server by now
        self._about[service] = about
        return self._start(service)

    def refused(self, service: str, server: LocalService, reason: str) -> list[ExportAction]:
        """Close the routes that wait for a server that does not answer, or refuses.

        Ignored if the service has another server by now.
        """
        if self.offered.get(service) != server:
            return []
        actions: list[ExportAction] = []
        for number, peer in self._peers.items():
            for route, session in list(peer.sessions.items()):
                if session.service == service and not session.requests:
                    actions += self._drop(number, peer, route, reason)
        return actions

    def _start(self, service: str) -> list[ExportAction]:
        about, server = self._about[service], self.offered[service]
        actions: list[ExportAction] = []
        for number, peer in self._peers.items():
            for route, session in peer.sessions.items():
                if session.service != service or session.requests:
                    continue
                peer.routes += 2
                session.requests = limits.SERVICE_ROUTES + peer.routes
                actions += [
                    ServeRoute(number, route, session.requests, service, server, session.timeout),
                    Send(
                        number,
                        ServiceOpened(
                            route, session.requests, about.type, about.md5, about.request_type, about.response_type
                        ),
                    ),
                ]
        return actions

    def _drop(self, number: int, peer: _Callers, route: int, reason: str) -> list[ExportAction]:
        session = peer.sessions.pop(route)
        closed = Send(number, ServiceClosed(route, reason[: limits.CONTROL_TEXT_MAX]))
        return [EndRoute(number, route, session.requests), closed] if session.requests else [closed]


def _told_portion(peer: int, portion: _Portion) -> list[ExportAction]:
    """Makes the message of a portion, if there is one."""
    if not portion.is_news:
        return []
    message = AdvertiseServices(tuple(portion.added), tuple(portion.removed), portion.full, portion.more)
    return [Send(peer, message)]
