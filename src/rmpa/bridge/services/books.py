"""Which services are offered to peers, which of the peers' are in the local graph, and which are open to be called.

A peer opens a service of this module once for all of its clients::

    open ──server known──► ServiceOpened, served ──closed, gone, restarted──► ended
      │                                                                         ▲
      └──► probe ──described──► …      ──refused──► ServiceClosed               │ link down

A graph has one provider of each service, so one of several is shown: a local one always, else that of the peer with
the lowest GUID, and one that a gateway reaches outside the mesh only if there is no other. The others are hidden,
with the reason, and one of them is shown when the first one leaves. The state of a service follows from its facts
(``RemoteService.state``)::

    idle ──wanted──► opening ──opened──► open
      ▲                 │ closed, time     │ closed, withdrawn, link down, released
      └─────────────────┴──────────────────┘

What the server of an opened service said of it is remembered until the service is withdrawn or advertised again.
Until then a client's probe is answered without a message to the peer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.messages import (
    AdvertiseServices,
    CloseService,
    OpenService,
    ServiceClosed,
    ServiceOffer,
    ServiceOpened,
    is_crossing_name,
)
from rmpa.bridge.offers import OfferBook
from rmpa.bridge.peer_offers import ImportBook, Remote
from rmpa.bridge.policy import PolicyDecision, is_outside
from rmpa.bridge.services.bodies import LocalService
from rmpa.config.peer_rules import Access
from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.core.facts import CROWDED, DENIED
from rmpa.ros.wire.tcpros import ServiceDescription

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.bridge.services.part import Services


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


class ServiceExports(OfferBook[str, LocalService, ServiceOffer, ServiceRoute]):
    """The outbound half: services of this module, called by peers.

    Attributes:
        about: What the servers of services have said of them.
        _serial: Counts the routes of requests. They are even; the odd ones are for replies to this module's own
            calls.
    """

    kind, counter, access, owner = "services", "services.too_many", Access.CALL, "its server"
    message = AdvertiseServices
    renews = True  # behind another server what peers know of a service may not be true any more
    _out: Services

    def __init__(self, out: Services) -> None:
        super().__init__(out)
        self.about: dict[str, ServiceDescription] = {}
        self._serial = 0

    def callers(self, service: str) -> tuple[int, ...]:
        """The numbers of the peers that have a service open."""
        return tuple(dict.fromkeys(peer for peer, _, route in self._of(service) if route.requests))

    def _of(self, service: str) -> list[tuple[int, int, ServiceRoute]]:
        """The routes to a service: each with its peer and the peer's number for it."""
        return [
            (peer, number, route)
            for peer, told in self.peers.items()
            for number, route in told.routes.items()
            if route.service == service
        ]

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

    def reload(self) -> Iterator[None]:
        """Judge by new rules; routes that no permission allows any more end at once."""
        gate = self._out.context.gate
        for peer, told in self.peers.items():
            for number, route in list(told.routes.items()):
                if why := gate.why_not(Access.CALL, told.session.name, route.service):
                    self._close(peer, number, why)
        return super().reload()

    def link_down(self, peer: int) -> None:
        """End all routes of a peer whose link is gone."""
        told = self.peers.get(peer)
        super().link_down(peer)
        for route in told.routes.values() if told is not None else ():
            if route.requests:
                self._out.serving.end_route(peer, route.requests)

    def opened(self, peer: int, message: OpenService) -> None:
        """Open a service for a peer, or answer with ``ServiceClosed`` and the reason.

        Raises:
            RemoteProtocolError: The peer's route is in use.
        """
        routes, number = self.peers[peer].routes, message.route
        if number in routes:
            raise RemoteProtocolError(f"route {number} is opened twice, for {message.service} now")
        service = self.local(peer, message.service)
        if len(routes) >= self.limit:
            why = f"more services are open on one link than limits.services = {self.limit} there"
        elif service is None:
            self._asked_in_vain(peer, message.service)
            why = f"{message.service} is not provided here, or policy keeps it home"
        else:
            probing = any(not route.requests for _, _, route in self._of(service))
            routes[number] = ServiceRoute(service, message.timeout)
            if service in self.about:
                self._start(service)
            elif not probing:
                self._out.serving.probe(service, self.offered[service])
            return
        self._out.send(peer, ServiceClosed(number, why))

    def closed(self, peer: int, message: CloseService) -> None:
        """End the route of a service that a peer will not call any more.

        A route that is not open is ignored: this module's own ``ServiceClosed`` may have crossed the peer's message.
        """
        route = self.peers[peer].routes.pop(message.route, None)
        if route is not None and route.requests:
            self._out.serving.end_route(peer, route.requests)

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
                self._out.serving.serve(peer, number, route, self.offered[service])
                types = (about.type, about.md5sum, about.request_type, about.response_type)
                self._out.send(peer, ServiceOpened(number, route.requests, *types))

    def _ended(self, key: str, reason: str) -> None:
        self.about.pop(key, None)
        for peer, number, _ in self._of(key):
            self._close(peer, number, f"{key}: {reason}")
        self._out.serving.server_gone(key)
        self._out.direct_exports.server_gone(key)

    def _close(self, peer: int, number: int, reason: str) -> None:
        route = self.peers[peer].routes.pop(number)
        if route.requests:
            self._out.serving.end_route(peer, route.requests)
        self._out.send(peer, ServiceClosed(number, reason[: limits.CONTROL_TEXT_MAX]))


@dataclass(slots=True, eq=False, kw_only=True)
class RemoteService(Remote[str]):
    """One service of one peer.

    Args:
        route: The route of its replies while it is asked for or open; else 0.
        requests: The route of its requests while it is open; else 0.
        due: While it is asked for: when the peer's answer is overdue, in monotonic seconds.
        about: What its server said of it; ``None`` while that is unknown.
    """

    route: int = 0
    requests: int = 0
    due: float = 0.0
    about: ServiceDescription | None = None

    @property
    def state(self) -> str:
        """Whether it can be called now, as in the figure above."""
        if not self.route:
            return "idle"
        return "open" if self.requests else "opening"


class ServiceImports(ImportBook[str, RemoteService, ServiceOffer]):
    """The inbound half: services of the peers, called from this module.

    Attributes:
        _local: The node of this module that provides a service.
        _claims: The services that have a name here.
    """

    kind, access = "services", Access.SERVE
    _out: Services

    def __init__(self, out: Services) -> None:
        super().__init__(out)
        self._local: dict[str, str] = {}
        self._claims: dict[str, dict[RemoteService, None]] = {}
        self._shown: dict[str, RemoteService] = {}
        # Those whose peers have not answered yet.
        self._opening = set[RemoteService]()

    def __iter__(self) -> Iterator[tuple[int, RemoteService]]:
        """The number of the peer and the service, for each service of each peer."""
        for number, peer in self._peers.items():
            for remote in peer.entries.values():
                yield number, remote

    def get(self, peer: int, service: str) -> RemoteService | None:
        """A peer's service by its name here, the shown one first; ``None`` if the peer offers none of this name."""
        if (shown := self._shown.get(service)) is not None and shown.peer == peer:
            return shown
        return next((one for one in self._claims.get(service, ()) if one.peer == peer), None)

    def shown(self, service: str) -> RemoteService | None:
        """The peer's service that is in the local graph by this name."""
        return self._shown.get(service)

    def link_down(self, peer: int) -> None:
        """Close the routes of a peer whose link is gone; its services stay in the graph until ``gone``."""
        if (known := self._peers.get(peer)) is not None:
            self._ready(peer)
            for remote in list(known.routes.values()):
                self._end(remote, f"the link to {known.session.name} was lost")

    def _entry(self, peer: int, offer: ServiceOffer) -> RemoteService:
        name = self.name_here(peer, offer.service, offer.origin)
        entry = RemoteService(peer=peer, wire=offer.service, name=name, node=offer.node, origin=offer.origin)
        self._claims.setdefault(name, {})[entry] = None
        return entry

    def _came_again(self, entry: RemoteService, now: float) -> None:  # noqa: ARG002 - as of ImportBook
        """The server was replaced, or the link is a new one: the type may have changed."""
        entry.about = None
        if entry.shown:
            self._out.forget_about(entry)

    def _judge(self, entry: RemoteService) -> None:
        """As of ``ImportBook``; a thousand modules may have a name, so only if it may go first."""
        first = self._shown.get(entry.name)
        if entry.name not in self._local and (first is None or self._rank(entry) <= self._rank(first)):
            self._choose(entry.name)

    def _went(self, entry: RemoteService, reason: str) -> None:
        # Messages may have crossed: the route asked for last may be open at the peer, for another server perhaps.
        self.release(entry, reason)
        self._unclaim(entry)
        if entry.shown:
            self._hide(entry, reason)
            if entry.name in self._claims:
                self._choose(entry.name)
            self._next_in(entry.peer)

    def _unclaim(self, entry: RemoteService) -> None:
        claims = self._claims[entry.name]
        del claims[entry]
        if not claims:
            del self._claims[entry.name]

    def local(self, service: str, node: str | None) -> None:
        """Set the node of this module that provides a service, ``None`` for none; it goes before the peers' ones."""
        if node is None:
            self._local.pop(service, None)
        else:
            self._local[service] = node
        self._choose(service)

    def _rejudge_all(self, now: float) -> Iterator[None]:  # noqa: ARG002 - as of ImportBook
        for _, remote in list(self):
            known = self._peers.get(remote.peer)
            if known is None or known.entries.get(remote.wire) is not remote:
                continue
            name = self.name_here(remote.peer, remote.wire, remote.origin)
            if name != remote.name:
                self._went(remote, "a rule has another name for it now")
                remote.name = name
                self._claims.setdefault(name, {})[remote] = None
            yield
        for name in tuple(self._claims):
            self._choose(name)
            yield

    def _choose(self, service: str) -> None:
        """Show the one service of a name that goes first, by the facts of now; call it whenever one has changed."""
        chosen, shown, left = None, self._shown.get(service), ""
        reason = self._own_first(service)
        for remote in sorted(self._claims.get(service, ()), key=self._rank):
            known, before = self._peers[remote.peer], remote.cause
            why, remote.cause = (reason, "") if reason else self._objection(remote)
            known.wait(remote, crowded=remote.cause == CROWDED)
            if not why:
                chosen, reason = remote, self._outranked(remote)
            elif remote is shown:
                left = why
            if remote.cause == DENIED != before:
                self.permission(remote, report=True)
        if shown is not None and left:
            self.release(shown, left)
            self._hide(shown, left)
        if chosen is not None and not chosen.shown:
            self._peers[chosen.peer].show(chosen)
            self._shown[service] = chosen
            self._out.provide(chosen)
        if shown is not None and left:
            # Only now: the services that this chooses could take the place that was found free above.
            self._next_in(shown.peer)

    def _hide(self, remote: RemoteService, reason: str) -> None:
        del self._shown[remote.name]
        self._peers[remote.peer].hide(remote)
        self._out.withdraw(remote, reason)

    def _next_in(self, peer: int) -> None:
        """Choose again among the services that wait for a place of their node, as far as places are free."""
        for waiting in self._peers[peer].admitted(self._out.context.settings.limits.nodes):
            self._choose(waiting.name)

    def _rank(self, remote: RemoteService) -> tuple[bool, bool, int, int]:
        """Sorts the claims to a name: modules of this mesh go first, then links that work, then by GUID."""
        known, outside = self._peers[remote.peer], remote.origin is not None and is_outside(remote.origin)
        return outside, not known.session.linked, known.session.rank, remote.peer

    def _own_first(self, service: str) -> str:
        node = self._local.get(service)
        return f"{node} of this module provides it itself" if node is not None else ""

    def _outranked(self, first: RemoteService) -> str:
        return f"{self._peers[first.peer].session.name} provides it too, and is shown: its GUID is lower"

    def why_hidden(self, remote: RemoteService) -> tuple[str, str]:
        """Why a service is not in the local graph, and the cause (see ``Remote``); empty if it may be."""
        if why := self._own_first(remote.name):
            return why, ""
        first = self._shown.get(remote.name)
        if first is not None and first is not remote:
            if first.peer == remote.peer:
                return f"{first.wire} of the same peer has this name here already", ""
            if self._rank(first) < self._rank(remote):
                return self._outranked(first), ""
        return self._objection(remote)

    def _objection(self, remote: RemoteService) -> tuple[str, str]:
        """Why a service may not be shown, whatever others there are, and the cause; empty if it may."""
        origin, service = remote.origin, remote.name
        if origin is not None and (why := self.ways.why_not(remote.peer, origin)):
            return why, ""
        if not is_crossing_name(service):
            return f"the rules of names make {service!r} of it", ""
        decision = self._out.context.services.judge(service, remote.node if origin is None else origin.node)
        if why := self._kept_out(remote, decision, remote.wire):
            return f"policy: {why}", ""
        return self._no_place(remote)

    def want(self, remote: RemoteService, now: float) -> None:
        """Open a service that a local node wants to call, or whose type it wants to know.

        Nothing happens if the route is asked for or open already.

        Raises:
            LocalProtocolError: The service is not shown, or its peer has no link: check before the call.
        """
        known = self._peers.get(remote.peer)
        if known is None or not remote.shown or not known.session.linked:
            raise LocalProtocolError(f"{remote.name} of peer {remote.peer} cannot be opened")
        if not remote.route:
            known.last_route += 1
            # Odd ones are for replies; the even ones are for requests of the peer.
            remote.route = limits.SERVICE_ROUTES + 2 * known.last_route - 1
            # Its server may be slow; after the time for a call the calls that wait fail.
            timeout = self._out.context.services.timeout(remote.name)
            remote.due = now + timeout
            known.routes[remote.route] = remote
            self._opening.add(remote)
            self._out.arm_timer()
            self._out.send(remote.peer, OpenService(remote.route, remote.wire, timeout))

    def opened(self, peer: int, message: ServiceOpened) -> None:
        """Handle a peer's answer that a service is open.

        A route that was given up meanwhile is ignored: this module's own ``CloseService`` may have crossed the peer's
        message.

        Raises:
            RemoteProtocolError: The route was open already.
        """
        known = self._peers.get(peer)
        remote = known.routes.get(message.route) if known is not None else None
        if remote is None:
            return
        if remote.requests:
            raise RemoteProtocolError(f"route {message.route} of {remote.wire} is opened twice")
        self._opening.discard(remote)
        remote.requests, remote.problem = message.requests, ""
        remote.about = ServiceDescription(message.type, message.md5, message.request_type, message.response_type)
        self._out.opened(remote)

    def closed(self, peer: int, message: ServiceClosed) -> None:
        """Handle a peer's message that a service cannot be called, or no longer; unknown routes are ignored."""
        known = self._peers.get(peer)
        if known is not None and (remote := known.routes.get(message.route)) is not None:
            self._end(remote, message.reason)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, in monotonic seconds; ``None``: no route is asked for."""
        return min((remote.due for remote in self._opening), default=None)

    def handle_timer(self, now: float) -> None:
        """Give up the routes that the peers have not opened in time."""
        for remote in [one for one in self._opening if one.due <= now]:
            self.release(remote, f"the agent of {self.peer_name(remote.peer)} does not answer")

    def release(self, remote: RemoteService, reason: str) -> None:
        """Close the route of a service that is not needed now; the next call opens it again."""
        if remote.route:
            if self._peers[remote.peer].session.linked:
                self._out.send(remote.peer, CloseService(remote.route))
            self._end(remote, reason)

    def _end(self, remote: RemoteService, reason: str) -> None:
        route = remote.route
        self._opening.discard(remote)
        del self._peers[remote.peer].routes[route]
        remote.route, remote.requests, remote.problem = 0, 0, reason
        self._out.ended(remote, route, reason)
