"""The routes that this module opens at peers: on demand, and again after they were lost. Pure."""

from __future__ import annotations

from heapq import heappop, heappush
from typing import TYPE_CHECKING

from msgspec import UnsetType

from rmpa.bridge import limits
from rmpa.bridge.actions import Action, Describe, Detach, Send, Warn
from rmpa.bridge.messages import CloseRoute, OpenRoute, RouteClosed, RouteOpened, Source
from rmpa.bridge.topics.remote_topic import RemoteTopic, RouteState
from rmpa.core.counters import Backoff
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from rmpa.core.contract import Contracts


class ImportRoutes:
    """Drives the route states of all remote sources.

    Args:
        find: ``(peer, source)``: returns the remote source, or ``None`` if it is unknown.
        contracts: The contracts that this module asks for.
        position: ``(peer, source)``: epoch and last message of a reliable route that outlived its link, or ``None``.
    """

    def __init__(
        self,
        find: Callable[[int, Source], RemoteTopic | None],
        contracts: Contracts,
        position: Callable[[int, Source], tuple[int, int] | None],
        rng: Callable[[], float],
    ) -> None:
        self._find = find
        self.contracts = contracts
        self._position = position
        self._rng = rng
        self._routes: dict[int, dict[int, Source]] = {}
        """The requested and open sources by route id, for each linked peer."""
        self._last_route: dict[int, int] = {}
        # Heap of (when, serial, peer, source); an item that is no longer its source's timer is skipped.
        self._timers: list[tuple[float, int, int, Source]] = []
        self._serial = 0

    def link_up(self, peer: int) -> None:
        """Registers a peer's link; its route ids begin at 1 again."""
        self._routes[peer] = {}
        self._last_route[peer] = 0

    def link_down(self, peer: int) -> Collection[Source]:
        """Forgets the routes of a peer's link; return the sources that were requested or open."""
        self._last_route.pop(peer, None)
        return self._routes.pop(peer, {}).values()

    # --- what happens ------------------------------------------------------------------------------------------

    def opened(self, peer: int, message: RouteOpened, now: float) -> list[Action]:
        """Takes the peer's answer that a route is open; ignored if the route was closed here meanwhile.

        A description of another type than the offered one closes the route.
        """
        routes = self._routes[peer]
        source = routes.get(message.route)
        entry = self._find(peer, source) if source is not None else None
        if source is None or entry is None or entry.state is not RouteState.OPENING:
            return []
        if message.description.type != entry.type:
            del routes[message.route]
            why = f"it is offered as {entry.type}, but its publisher sends {message.description.type}"
            return [
                Send(peer, CloseRoute(message.route)),
                Warn("mismatch.type", str(source), f"{source}: {why}"),
                *self._fail(peer, source, entry, why, now),
            ]
        entry.enter(RouteState.OPEN)
        entry.problem = ""
        entry.backoff = None
        entry.description = message.description
        entry.contract = message.contract
        terms = (message.contract, message.epoch, message.first)
        following = None if isinstance(message.following, UnsetType) else message.following
        unknown = message.unknown is True
        return [Describe(peer, source, message.route, message.description, *terms, following, unknown)]

    def closed(self, peer: int, message: RouteClosed, now: float) -> list[Action]:
        """Handles a route that the peer has refused or closed: it is opened again after the back-off."""
        source = self._routes[peer].pop(message.route, None)
        entry = self._find(peer, source) if source is not None else None
        if source is None or entry is None:
            return []
        last = None if isinstance(message.last, UnsetType) else message.last
        return self._fail(peer, source, entry, message.reason, now, last)

    def demand(self, peer: int, source: Source, entry: RemoteTopic, now: float, *, wanted: bool) -> list[Action]:
        """Opens a source's route for its first local listener, or lets it linger after the last one."""
        entry.wanted = wanted
        if wanted:
            if entry.state is RouteState.IDLE:
                return self.open(peer, source, entry, now)
            if entry.state is RouteState.LINGERING:
                entry.enter(RouteState.OPEN)
            return []
        if entry.state is RouteState.OPEN:
            self._enter(peer, source, entry, RouteState.LINGERING, now + limits.ROUTE_LINGER)
            return []
        if entry.state in {RouteState.OPENING, RouteState.WAITING}:
            return self.close(peer, source, entry)
        return []

    def suspend(self, entry: RemoteTopic) -> None:
        """Suspends the route of an entry that outlives its peer's link."""
        entry.problem = "its peer is away"
        if entry.state is RouteState.LINGERING:
            entry.enter(RouteState.IDLE)
        elif entry.state in {RouteState.OPEN, RouteState.OPENING}:
            entry.enter(RouteState.WAITING)
        entry.timer = None

    # --- opening and closing -----------------------------------------------------------------------------------

    def open(self, peer: int, source: Source, entry: RemoteTopic, now: float) -> list[Action]:
        """Requests a source's route, or waits for the peer's next link."""
        routes = self._routes.get(peer)
        if routes is None:
            entry.enter(RouteState.OPENING)
            entry.enter(RouteState.WAITING)
            return []
        self._last_route[peer] += 1
        route = entry.route = self._last_route[peer]
        routes[route] = source
        self._enter(peer, source, entry, RouteState.OPENING, now + limits.ROUTE_OPEN_TIMEOUT)
        contract = entry.asked = self.contracts.of(entry.topic, entry.type)
        epoch, after = self._position(peer, source) or (0, 0)
        return [Send(peer, OpenRoute(route, source.topic, source.node, contract, epoch, after))]

    def close(self, peer: int, source: Source, entry: RemoteTopic, *, missed: bool = False) -> list[Action]:
        """Ends a source's route in any state; ``missed`` as in ``actions.Detach``."""
        actions: list[Action] = []
        if entry.route:
            self._routes.get(peer, {}).pop(entry.route, None)
            actions += [Send(peer, CloseRoute(entry.route)), Detach(peer, source, entry.route, missed=missed)]
        elif entry.state is RouteState.WAITING and entry.timer is None:
            actions.append(Detach(peer, source, 0))  # it waited for a new link
        entry.route = 0
        entry.backoff = None
        if entry.state is RouteState.OPEN:
            entry.enter(RouteState.LINGERING)
        if entry.state is not RouteState.IDLE:
            entry.enter(RouteState.IDLE)
        return actions

    def _fail(
        self, peer: int, source: Source, entry: RemoteTopic, reason: str, now: float, last: int | None = None
    ) -> list[Action]:
        missed = entry.wanted and entry.state is not RouteState.LINGERING
        actions: list[Action] = [Detach(peer, source, entry.route, missed=missed, last=last)]
        entry.route = 0
        entry.problem = reason
        if entry.state is RouteState.LINGERING:
            entry.enter(RouteState.IDLE)
        else:
            if entry.backoff is None:
                entry.backoff = Backoff(mesh_limits.BACKOFF_FIRST, mesh_limits.BACKOFF_MAX, self._rng)
            self._enter(peer, source, entry, RouteState.WAITING, now + entry.backoff.delay())
        return actions

    # --- timers ------------------------------------------------------------------------------------------------

    def _enter(self, peer: int, source: Source, entry: RemoteTopic, state: RouteState, timer: float) -> None:
        """Changes a state, and sets the timer that ends it (monotonic seconds)."""
        entry.enter(state, timer)
        self._serial += 1
        entry.serial = self._serial
        heappush(self._timers, (timer, self._serial, peer, source))

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, monotonic seconds; ``None`` if no timer runs."""
        while self._timers and not self._is_pending(self._timers[0]):
            heappop(self._timers)
        return self._timers[0][0] if self._timers else None

    def handle_timer(self, now: float) -> list[Action]:
        """Handle due timers, at most ``limits.APPLIED_AT_ONCE``; if some remain, ``next_timer`` is in the past."""
        actions: list[Action] = []
        for _ in range(limits.APPLIED_AT_ONCE):
            if (due := self.next_timer()) is None or due > now:
                break
            _, _, peer, source = heappop(self._timers)
            entry = self._find(peer, source)
            if entry is None:
                continue
            if entry.state is RouteState.LINGERING:
                actions += self.close(peer, source, entry)
            elif entry.state is RouteState.OPENING:
                self._routes[peer].pop(entry.route, None)
                actions.append(Send(peer, CloseRoute(entry.route)))
                actions += self._fail(peer, source, entry, "the peer has not answered", now)
            elif entry.state is RouteState.WAITING:
                actions += self.open(peer, source, entry, now)
        return actions

    def _is_pending(self, timer: tuple[float, int, int, Source]) -> bool:
        """Whether an item of the heap is still its source's timer."""
        when, serial, peer, source = timer
        entry = self._find(peer, source)
        return entry is not None and entry.timer == when and entry.serial == serial
