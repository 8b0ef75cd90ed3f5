"""Which services of the local graph are offered to peers, and which of them each peer has open to call.

A peer opens a service once for all of its clients::

    open ──server known──► ServiceOpened, served ──closed, gone, restarted──► ended
      │                                                                         ▲
      └──► probe ──described──► …      ──refused──► ServiceClosed               │ link down
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.messages import (
    AdvertiseServices,
    CloseService,
    Message,
    OpenService,
    ServiceClosed,
    ServiceOffer,
    ServiceOpened,
    is_crossing_name,
)
from rmpa.bridge.offers import Effects, OfferBook
from rmpa.bridge.policy import PolicyDecision
from rmpa.bridge.services.bodies import LocalService
from rmpa.config.peer_rules import Access
from rmpa.core.errors import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.ros.wire.tcpros import ServiceDescription


@dataclass(slots=True)
class ServiceRoute:
    """A service that one peer has asked for.

    Args:
        service: The service's local name.
        timeout: Seconds that the peer allows for each call.
        requests: The route that requests come in on, of a number that this module has chosen; 0 until it is open.
    """

    service: str
    timeout: float
    requests: int = 0


class ServiceExports(OfferBook[str, LocalService, ServiceOffer]):
    """The outbound half: services of this module, called by peers.

    Attributes:
        about: What the servers of services have said of them.
        _routes: The routes that each linked peer has asked for, by the peer's own route numbers.
        _serial: Counts the routes of requests. They are even; the odd ones are for replies to this module's own
            calls.
    """

    kind, warning, access, owner = "services", "services.too_many", Access.CALL, "its server"
    renews = True  # behind another server what peers know of a service may not be true any more

    def __init__(self, out: Effects) -> None:
        super().__init__(out)
        self.about: dict[str, ServiceDescription] = {}
        self._routes: dict[int, dict[int, ServiceRoute]] = {}
        self._serial = 0

    def callers(self, service: str) -> tuple[int, ...]:
        """The numbers of the peers that have a service open."""
        return tuple(dict.fromkeys(peer for peer, _, route in self._of(service) if route.requests))

    def _of(self, service: str) -> list[tuple[int, int, ServiceRoute]]:
        """The routes to a service: each with its peer and the peer's number for it."""
        return [
            (peer, number, route)
            for peer, routes in self._routes.items()
            for number, route in routes.items()
            if route.service == service
        ]

    # --- the offers ----------------------------------------------------------------------------------------------

    def judge(self, key: str, local: LocalService) -> PolicyDecision:
        """Decide whether a service may cross at all."""
        if not (is_crossing_name(key) and is_crossing_name(local.node)):
            return PolicyDecision(False, "no peer takes the name of the service or node")
        return self._out.context.services.judge(key, local.node if local.origin is None else local.origin.node)

    def name_of(self, key: str) -> str:
        """The service."""
        return key

    def offer_for(self, key: str, local: LocalService, wire: str) -> ServiceOffer:  # noqa: ARG002 - as of OfferBook
        """As of ``OfferBook``."""
        return ServiceOffer(wire, local.node, local.origin)

    def _message(self, added: tuple[ServiceOffer, ...], removed: tuple[str, ...], full: bool, more: bool) -> Message:
        return AdvertiseServices(added, removed, full, more)

    def reload(self) -> Iterator[None]:
        """Judge by new rules; routes that no permission allows any more end at once."""
        gate = self._out.context.gate
        for peer, told in self.peers.items():
            for number, route in list(self._routes[peer].items()):
                if why := gate.why_not(Access.CALL, told.name, route.service):
                    self._close(peer, number, why)
        return super().reload()

    # --- links and calls -----------------------------------------------------------------------------------------

    def link_up(self, peer: int, name: str = "", instance: str = "") -> None:
        """As of ``OfferBook``; the peer has no service open."""
        self._routes[peer] = {}
        super().link_up(peer, name, instance)

    def link_down(self, peer: int) -> None:
        """End all routes of a peer whose link is gone."""
        super().link_down(peer)
        for route in self._routes.pop(peer, {}).values():
            if route.requests:
                self._do.serving.end_route(peer, route.requests)

    def opened(self, peer: int, message: OpenService) -> None:
        """Open a service for a peer, or answer with ``ServiceClosed`` and the reason.

        Raises:
            RemoteProtocolError: The peer's route is in use.
        """
        routes, number = self._routes[peer], message.route
        if number in routes:
            raise RemoteProtocolError(f"route {number} is opened twice, for {message.service} now")
        service = self.local(peer, message.service)
        if len(routes) >= self.limit:
            why = f"more services are open on one link than limits.services = {self.limit} over there"
        elif service is None:
            self._asked_in_vain(peer, message.service)
            why = f"{message.service} is not provided here, or policy keeps it home"
        else:
            probing = any(not route.requests for _, _, route in self._of(service))
            routes[number] = ServiceRoute(service, message.timeout)
            if service in self.about:
                self._start(service)
            elif not probing:
                self._do.serving.probe(service, self.offered[service])
            return
        self._out.send(peer, ServiceClosed(number, why))

    def closed(self, peer: int, message: CloseService) -> None:
        """End the route of a service that a peer will not call any more.

        A route that is not open is ignored: this module's own ``ServiceClosed`` may have crossed the peer's message.
        """
        route = self._routes[peer].pop(message.route, None)
        if route is not None and route.requests:
            self._do.serving.end_route(peer, route.requests)

    def described(self, service: str, server: LocalService, about: ServiceDescription) -> None:
        """Store what a server said of its service, and open the routes that waited for it.

        Ignored if the service has another server by now.
        """
        if self.offered.get(service) == server:
            self.about[service] = about
            self._start(service)

    def refused(self, service: str, server: LocalService, reason: str) -> None:
        """Close the routes that wait for a server that does not answer, or refuses; ignored as by ``described``."""
        for peer, number, route in self._of(service) if self.offered.get(service) == server else ():
            if not route.requests:
                self._close(peer, number, reason)

    def _start(self, service: str) -> None:
        """Open the routes that wait for what the server says, which is known now."""
        about = self.about[service]
        for peer, number, route in self._of(service):
            if not route.requests:
                self._serial += 2
                route.requests = limits.SERVICE_ROUTES + self._serial
                self._do.serving.serve(peer, number, route, self.offered[service])
                types = (about.type, about.md5sum, about.request_type, about.response_type)
                self._out.send(peer, ServiceOpened(number, route.requests, *types))

    def _ended(self, key: str, reason: str) -> None:
        self.about.pop(key, None)
        for peer, number, _ in self._of(key):
            self._close(peer, number, f"{key}: {reason}")
        self._do.serving.server_gone(key)
        self._do.direct_exports.server_gone(key)

    def _close(self, peer: int, number: int, reason: str) -> None:
        route = self._routes[peer].pop(number)
        if route.requests:
            self._do.serving.end_route(peer, route.requests)
        self._out.send(peer, ServiceClosed(number, reason[: limits.CONTROL_TEXT_MAX]))
