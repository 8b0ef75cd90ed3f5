"""Which services of the local graph the peers are told of, and which of them they have open to call.

Sans-I/O, like ``bridge.topics.exports`` for topics: the driver tells what the local graph provides, what peers ask
for and
what a server said of itself; it gets back actions. A peer opens a service once, however many clients it has there::

    open ──server known──► ServiceOpened, ServeRoute ──closed, gone, restarted──► EndRoute
      │                                                                              ▲
      └──► Probe ──described──► …      ──refused──► ServiceClosed                    │ link down
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.actions import Send, Warn
from rmpa.bridge.catalogue.offers import CataloguePeer, OfferCatalogue
from rmpa.bridge.messages import (
    AdvertiseServices,
    CloseService,
    OpenService,
    ServiceClosed,
    ServiceOffer,
    ServiceOpened,
    is_crossing_name,
)
from rmpa.bridge.relay import may_have
from rmpa.config.settings import LimitSettings
from rmpa.core.errors import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.bridge.catalogue.peer_limits import Beyond
    from rmpa.bridge.messages import Origin
    from rmpa.bridge.services.rules import ServiceRules


@dataclass(frozen=True, slots=True)
class LocalService:
    """A service's server in the local graph: its node, its ``rosrpc://`` address, and its origin if relayed."""

    node: str
    uri: str
    origin: Origin | None = None


@dataclass(frozen=True, slots=True)
class ServiceAbout:
    """What a server says of its service, as far as a peer must know it."""

    type: str
    md5: str
    request_type: str = ""
    response_type: str = ""


@dataclass(frozen=True, slots=True)
class Probe:
    """Ask a local server what its service is; the answer comes by ``described`` or ``refused``."""

    service: str
    server: LocalService


@dataclass(frozen=True, slots=True)
class ServeRoute:
    """Calls of a peer come on the route ``requests``; replies go out on ``route``.

    Args:
        peer: The caller.
        route: The caller's id.
        requests: Ours.
        service: The service's local name.
        server: The node that provides it.
        timeout: Seconds that the caller waits for each.
    """

    peer: int
    route: int
    requests: int
    service: str
    server: LocalService
    timeout: float


@dataclass(frozen=True, slots=True)
class EndRoute:
    """No more calls come on a route, and no replies are waited for."""

    peer: int
    route: int
    requests: int


@dataclass(frozen=True, slots=True)
class ServerGone:
    """A server left, or is another one now: let go of what is connected to it."""

    service: str


ExportAction = Send | Warn | Probe | ServeRoute | EndRoute | ServerGone


@dataclass(slots=True)
class _ServiceRoute:
    """One peer's wish to call a service.

    Args:
        service: Its local name.
        timeout: What the caller allows each call.
        requests: The route that calls come on; 0 until it is open.
    """

    service: str
    timeout: float
    requests: int = 0


@dataclass(slots=True)
class _Callers:
    """What one linked peer calls.

    Args:
        sessions: What it has open, by its own route.
        routes: Counts our routes: even ones, the odd ones are for our own calls.
    """

    sessions: dict[int, _ServiceRoute] = field(default_factory=dict)
    routes: int = 0


_Peer = CataloguePeer[str, LocalService, ServiceOffer, str]
_DEFAULT_LIMITS: Final = LimitSettings()


class ServiceExports:
    """The outbound half: our services, called by peers.

    Args:
        rules: What may cross, and under which names.
        limit_settings: How much is offered.
    """

    def __init__(self, rules: ServiceRules, limit_settings: LimitSettings = _DEFAULT_LIMITS) -> None:
        self._rules = rules
        self._catalogue: OfferCatalogue[str, LocalService, ServiceOffer, str] = OfferCatalogue(
            "services",
            limit_settings.services,
            offer=self._offer,
            wire=lambda offer: offer.service,
            # Another server behind the same name: what peers know of it may no longer be true.
            renewed=lambda before, now: before != now,
        )
        self._seen: dict[str, LocalService] = {}
        self._about: dict[str, ServiceAbout] = {}
        self._peers: dict[int, _Callers] = {}

    @property
    def seen(self) -> Mapping[str, LocalService]:
        """Every service of the local graph that was told of, whether it crosses or not."""
        return self._seen

    @property
    def offered(self) -> Mapping[str, LocalService]:
        """What peers are told of."""
        return self._catalogue.offered

    @property
    def beyond(self) -> Beyond:
        """What is offered to no peer because there is too much (``limits.services``)."""
        return self._catalogue.beyond

    def about(self, service: str) -> ServiceAbout | None:
        """What is known of a service of ours."""
        return self._about.get(service)

    def callers(self, service: str) -> tuple[int, ...]:
        """The peers that have it open."""
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
        """Set the server that a service has now, proxies left out; peers are told by ``advertise``."""
        if self._seen.get(service) == server:
            return []
        if server is None:
            del self._seen[service]
        else:
            self._seen[service] = server
        return self._judge(service)

    def apply_rules(
        self, rules: ServiceRules, limit_settings: LimitSettings = _DEFAULT_LIMITS
    ) -> Iterator[list[ExportAction]]:
        """Other rules hold from now on; what they do not touch goes on.

        Returns:
            What is to be done for one service after the other, looked at when it is asked for.
        """
        self._rules, self._catalogue.limit = rules, limit_settings.services
        for known in self._catalogue.peers():
            self._catalogue.note_all(known)
        return (self._judge(service) for service in tuple(self._seen))

    def _judge(self, service: str) -> list[ExportAction]:
        server, before = self._seen.get(service), self.offered.get(service)
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
        """Its server is no longer what it was: end all routes to it."""
        self._about.pop(service, None)
        actions: list[ExportAction] = []
        for number, peer in self._peers.items():
            for route, session in list(peer.sessions.items()):
                if session.service == service:
                    actions += self._drop(number, peer, route, f"{service}: {reason}")
        return [*actions, ServerGone(service)]

    # --- telling -----------------------------------------------------------------------------------------------

    def link_up(self, peer: int, name: str, instance: str = "") -> list[ExportAction]:
        """A link is up: ``advertise`` begins with all we have, but for what came from that very run of the peer."""
        self._peers[peer] = _Callers()
        first = self._catalogue.link_up(peer, name, instance, judged=False)
        return [Send(peer, AdvertiseServices(tuple(first.added), tuple(first.removed), full=True, more=first.more))]

    def link_down(self, peer: int) -> list[ExportAction]:
        """A link is gone, and all its routes."""
        self._catalogue.link_down(peer)
        gone = self._peers.pop(peer, None)
        sessions = gone.sessions.items() if gone is not None else ()
        return [EndRoute(peer, route, s.requests) for route, s in sessions if s.requests]

    def advertise(self, ready: Callable[[int], bool] = lambda _: True) -> list[ExportAction]:
        """One message for each peer that has not heard everything and is ready; call again while ``pending``."""
        return [
            Send(peer, AdvertiseServices(tuple(portion.added), tuple(portion.removed), more=portion.more))
            for peer, portion in self._catalogue.portions(ready)
            if portion.is_news
        ]

    def _offer(self, known: _Peer, service: str, server: LocalService) -> ServiceOffer | None:
        """What a peer is to know of a service, if it may at all."""
        if server.origin is not None and not may_have(known.instance, server.origin):
            return None
        wire = self._rules.wire_name(known.name, service)
        if not is_crossing_name(wire) or not self._rules.judge_for(known.name, service, wire).allowed:
            return None
        return ServiceOffer(wire, server.node, server.origin)

    # --- their calls -------------------------------------------------------------------------------------------

    def opened(self, number: int, message: OpenService) -> list[ExportAction]:
        """A peer wants to call a service.

        Raises:
            RemoteProtocolError: Its route is in use.
        """
        peer = self._peers[number]
        if message.route in peer.sessions:
            raise RemoteProtocolError(f"route {message.route} is opened twice, for {message.service} now")
        if len(peer.sessions) >= self._catalogue.limit:
            text = f"more services are open on one link than limits.services = {self._catalogue.limit} over there"
            return [Send(number, ServiceClosed(message.route, text))]
        known = self._catalogue.peer(number)
        service = known.by_wire.get(message.service) if known is not None else None
        server = self.offered.get(service) if service is not None else None
        if service is None or server is None:
            text = f"{message.service} is not provided here, or policy keeps it home"
            return [Send(number, ServiceClosed(message.route, text))]
        waiting = any(
            s.service == service and not s.requests for p in self._peers.values() for s in p.sessions.values()
        )
        peer.sessions[message.route] = _ServiceRoute(service, message.timeout)
        if service in self._about:
            return self._start(service)
        return [] if waiting else [Probe(service, server)]

    def closed(self, number: int, message: CloseService) -> list[ExportAction]:
        """A peer will not call it any more; one that is not open is none of our worry (it crossed ours)."""
        session = self._peers[number].sessions.pop(message.route, None)
        if session is None or not session.requests:
            return []
        return [EndRoute(number, message.route, session.requests)]

    def described(self, service: str, server: LocalService, about: ServiceAbout) -> list[ExportAction]:
        """A server has said what its service is."""
        if self.offered.get(service) != server:
            return []  # it is another one by now
        self._about[service] = about
        return self._start(service)

    def refused(self, service: str, reason: str) -> list[ExportAction]:
        """A server does not answer, or refuses: the peers that wait for it are told."""
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
