"""The routes that this module opens at peers: on demand, and again after they were lost. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from heapq import heappop, heappush
from typing import TYPE_CHECKING, Final

from msgspec import UnsetType

from rmpa.bridge import limits
from rmpa.bridge.actions import Action, Describe, Detach, Send, Warn
from rmpa.bridge.messages import CloseRoute, OpenRoute, RouteClosed, RouteOpened, Source
from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, Reliability
from rmpa.core.counters import Backoff
from rmpa.core.errors import LocalProtocolError
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from rmpa.bridge.messages import Description, Origin
    from rmpa.core.contract import Contracts


# One source of a peer as the local graph shows it, and the states of its route. Pure.
#
# ::
#
#     idle ──wanted──► opening ──opened──► open ──unwanted──► lingering ──time──► idle
#       ▲                 │ closed, time      │ closed             │ wanted
#       │ unwanted        ▼                   ▼                    ▼
#       └────────────── waiting ◄────────────────                 open
#                         │ time ──► opening


class RouteState(Enum):
    """The state of a remote source's route."""

    IDLE = auto()
    """No route: the source has no local listener."""
    OPENING = auto()
    """Requested; the peer has not answered yet."""
    OPEN = auto()
    """Data flows."""
    LINGERING = auto()
    """Data still flows after the last listener has left; for ``limits.ROUTE_LINGER``."""
    WAITING = auto()
    """The route was lost although a node listens; it will be requested again."""


_S = RouteState
TRANSITIONS: Final[Mapping[RouteState, frozenset[RouteState]]] = {
    _S.IDLE: frozenset({_S.OPENING}),
    _S.OPENING: frozenset({_S.OPEN, _S.WAITING, _S.IDLE}),
    _S.OPEN: frozenset({_S.LINGERING, _S.WAITING}),
    _S.LINGERING: frozenset({_S.OPEN, _S.IDLE}),
    _S.WAITING: frozenset({_S.OPENING, _S.IDLE}),
}


_LISTENED: Final = frozenset({RouteState.OPENING, RouteState.OPEN, RouteState.WAITING})


@dataclass(slots=True)
class RemoteTopic:
    """One source of one peer.

    Args:
        type: Its message type.
        topic: Its topic in the local graph.
        shown: Whether it is in the local graph.
        hidden: Why it is not, or empty.
        denied: Whether it is hidden because no permission lets its module publish it here.
        conflict: Whether it is hidden because a local node publishes the topic with another type, or, for ``/clock``,
            because time already has another source.
        state: The state of its route.
        route: The route's id while it is requested or open, else 0.
        timer: When the state's time is over, monotonic seconds; ``None``: no timer.
        description: The header of its publisher, once known.
        problem: Why the last attempt failed, or empty.
        wanted: Whether a local node listens.
        contract: The contract of its last open route; ``None`` before the first one.
        asked: The contract that was last requested.
        serial: Identifies the timer among earlier ones.
        origin: Its module and node, if its peer only relays it.
        crowded: Whether it is hidden because of ``limits.nodes``.
        direct: Whether a local node is connected to its publisher directly, and only the peer's agent has died.
        backoff: Delays between attempts to open its route, after the first one that failed.
    """

    type: str
    topic: str
    shown: bool = False
    hidden: str = ""
    denied: bool = False
    conflict: bool = False
    state: RouteState = RouteState.IDLE
    route: int = 0
    timer: float | None = None
    description: Description | None = None
    problem: str = ""
    wanted: bool = False
    contract: Contract | None = None
    asked: Contract | None = None
    serial: int = 0
    origin: Origin | None = None
    crowded: bool = False
    direct: bool = False
    backoff: Backoff | None = None

    def enter(self, state: RouteState, timer: float | None = None) -> None:
        """Change the route's state.

        Raises:
            LocalProtocolError: ``TRANSITIONS`` does not allow it.
        """
        if state not in TRANSITIONS[self.state]:
            raise LocalProtocolError(f"{self.state.name} does not lead to {state.name}")
        self.state = state
        self.timer = timer

    def outlives(self, *, silent: bool) -> bool:
        """Whether the source stays in the local graph when its peer's link is gone.

        Only a source with a listener does. A reliable one stays, so that no message is lost. A latched one stays if
        the link fell silent (``silent``): its subscribers stay connected and do not get the same message again when
        the peer is back, and new subscribers get it meanwhile. A relayed one does not stay, because another relay may
        offer it. A source with direct subscribers stays if only its agent has died: its messages go on.
        """
        if self.direct:
            return True
        if not self.wanted or self.origin is not None or self.state not in _LISTENED:
            return False
        if silent and self.description is not None and self.description.latching:
            return True
        return self.contract is not None and self.contract.reliability is Reliability.RELIABLE

    @property
    def outage(self) -> float:
        """For how many seconds it outlives its link: the contract's outage, or the default if it is not reliable."""
        if self.contract is not None and self.contract.reliability is Reliability.RELIABLE:
            return self.contract.outage
        return core_limits.RESUME_WINDOW


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
