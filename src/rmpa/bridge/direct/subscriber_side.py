"""Decides for each local subscriber of a remote source whether it connects to the publisher directly. Pure.

One ``DirectRoute`` is kept for each subscriber of each source::

           ┌───────── asked again: link up, retry, a broken connection ────────┐
           ▼                                                                   │
        ASKING ──granted──► PROBING ──reached──► DIRECT ──withdrawn, broken────┤
           │ refused           │ not reached        │ a condition fails        │
           └───────────────────┴────────────────────┴──────► RELAYED ──────────┘

The decision is one thing, the subscriber's present connection another (``Path``): TCPROS lets a publisher's side
only answer ``requestTopic``. Where both differ, the driver *moves* the subscriber: it makes it hang up, and calls it
back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import NO_LINK, Condition, Grant, Unmet
from rmpa.bridge.direct.direct_route import (
    Ask,
    Decided,
    DirectKey,
    DirectRoute,
    DirectState,
    Fallback,
    HangUp,
    Move,
    Path,
    ProbeNode,
    Release,
)
from rmpa.core.contract import Transport
from rmpa.core.timer_queue import TimerQueue

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.bridge.direct.direct_route import DirectAction
    from rmpa.bridge.messages import Source


_UNSTABLE: Final = Unmet(
    Condition.STABLE,
    f"its direct connection broke {limits.DIRECT_BREAKS} times in {limits.DIRECT_BREAKS_SPAN:g} s",
)
_TWICE: Final = Unmet(
    Condition.LATCHED, "it latches, and a move would deliver its last message twice: subscribe again"
)


class DirectSubscriptions:
    """The direct connections of this module's subscribers to nodes of its peers.

    Args:
        is_latched: ``(key)``: whether the publisher is known to latch.
        is_relayed: ``(key)``: whether a subscriber that is not known yet is connected to the proxy already.
    """

    def __init__(
        self,
        is_latched: Callable[[DirectKey], bool] = lambda _: False,
        is_relayed: Callable[[DirectKey], bool] = lambda _: False,
    ) -> None:
        self._is_latched = is_latched
        self._is_relayed = is_relayed
        self._routes: dict[DirectKey, DirectRoute] = {}
        self._of: dict[tuple[int, Source], dict[str, DirectKey]] = {}
        self._reached: set[tuple[int, int]] = set()
        """Peers and ports that were probed with success over the present link."""
        self._unreached: dict[tuple[int, int], tuple[float, Unmet]] = {}
        """Peers and ports that a probe did not reach, until when no other is made, and why. A firewall that drops
        packets delays only the first subscriber of a node."""
        self._probing: set[tuple[int, int]] = set()
        self._timers: TimerQueue[DirectKey] = TimerQueue()
        self._attempts = 0

    def __iter__(self) -> Iterator[tuple[DirectKey, DirectRoute]]:
        """Every subscriber with its state; changes during the iteration are allowed."""
        return iter(list(self._routes.items()))

    def get(self, key: DirectKey) -> DirectRoute | None:
        """The state of one subscriber; ``None`` if it is not known."""
        return self._routes.get(key)

    def of(self, peer: int, source: Source) -> list[tuple[str, DirectRoute]]:
        """The subscribers of one source, by name."""
        return [(name, self._routes[key]) for name, key in sorted(self._of.get((peer, source), {}).items())]

    def connected(self) -> list[tuple[DirectKey, DirectRoute]]:
        """The subscribers whose last answer was the publisher's address."""
        return [(key, route) for key, route in self._routes.items() if route.path is Path.DIRECT]

    def waiting(self, now: float) -> list[DirectKey]:
        """The subscribers that were made to hang up, are decided, and have not been called back for a while."""
        return [
            key
            for key, route in self._routes.items()
            if route.stranded and self.misplaced(key) and now - route.since > limits.DIRECT_SETTLE
        ]

    # --- the local graph --------------------------------------------------------------------------------------------

    def consider(self, key: DirectKey, wanted: Transport, unmet: Unmet | None, now: float) -> list[DirectAction]:
        """Judge a subscriber that is new, or for which something changed here.

        Args:
            key: The subscriber.
            wanted: The transport that this module's contract asks for.
            unmet: The condition that does not hold here, if any.
            now: Monotonic seconds.
        """
        route = self._routes.get(key)
        if route is None:
            route = self._routes[key] = DirectRoute(wanted, DirectState.RELAYED, since=now)
            self._of.setdefault((key.peer, key.source), {})[key.subscriber] = key
            route.local = True  # so that it is asked for below
            route.path = Path.RELAY if self._is_relayed(key) else Path.NONE
        warn = wanted is Transport.DIRECT and route.wanted is not wanted
        route.wanted = wanted
        if unmet is not None and (route.unmet != unmet or not route.local):
            return self._relay(key, route, unmet, now, local=True)
        if unmet is None and route.local:
            return self._ask(key, route, now)
        return [Fallback(key, route.unmet)] if warn and route.unmet is not None else []

    def remove(self, key: DirectKey, *, hang_up: bool = True) -> list[DirectAction]:
        """Forget a subscriber: it has unsubscribed, or its source has left the local graph.

        Args:
            key: The subscriber.
            hang_up: End its direct connection. Otherwise the connection goes on, and a new run of the peer's agent
                finds it.
        """
        route = self._routes.pop(key, None)
        if route is None:
            return []
        names = self._of[key.peer, key.source]
        del names[key.subscriber]
        if not names:
            del self._of[key.peer, key.source]
        self._timers.set(key, None)
        # While it is asked, the peer may grant it after a Release has passed: the response is released instead.
        held = route.held and route.state is not DirectState.ASKING
        actions: list[DirectAction] = [Decided(key)]
        if hang_up and route.path is Path.DIRECT and route.endpoint is not None:
            actions.append(HangUp(key, route.endpoint))
        return [Release(key), *actions] if held else actions

    # --- its requests --------------------------------------------------------------------------------------------

    def decision(self, key: DirectKey) -> Grant | Unmet | None:
        """The answer for a subscriber: a grant, or why it is relayed; ``None`` while it is not decided."""
        route = self._routes.get(key)
        if route is None:
            return Unmet(Condition.SUBSCRIBER, "its node is not registered as a subscriber here")
        if route.state is DirectState.DIRECT:
            return route.grant
        return route.unmet if route.state is DirectState.RELAYED else None

    def answered(self, key: DirectKey, endpoint: tuple[str, int] | None, now: float) -> list[DirectAction]:
        """Note what a subscriber's ``requestTopic`` was answered; it is moved if the decision has changed meanwhile.

        Args:
            key: The subscriber.
            endpoint: The publisher's address and port; ``None``: the proxy's own.
            now: Monotonic seconds.
        """
        route = self._routes.get(key)
        if route is None:
            return []
        route.path = Path.DIRECT if endpoint is not None else Path.RELAY
        route.endpoint, route.answered_at = endpoint, now
        route.stranded, route.stuck = False, ""
        return [Move(key)] if self.misplaced(key) else []

    def misplaced(self, key: DirectKey) -> bool:
        """Whether a subscriber's path differs from the decision, so that it has to be moved."""
        route = self._routes.get(key)
        if route is None or route.state not in {DirectState.DIRECT, DirectState.RELAYED}:
            return False
        if route.path is Path.NONE:
            return route.stranded
        if route.state is DirectState.RELAYED:
            return route.path is Path.DIRECT
        return not route.allows(route.endpoint)

    def hung_up(self, key: DirectKey) -> None:
        """Note that a subscriber has no connection to the source any more, and waits for being called back."""
        route = self._routes.get(key)
        if route is not None:
            route.path, route.endpoint, route.stranded = Path.NONE, None, True

    def stays(self, key: DirectKey, endpoint: tuple[str, int], problem: str) -> None:
        """Note that a direct connection of a subscriber could not be ended.

        A rospy subscriber does not ask again while it is connected, so it is not stranded either.

        Args:
            key: The subscriber.
            endpoint: The address and port of its connection.
            problem: Why it cannot be ended.
        """
        route = self._routes.get(key)
        if route is None:
            return
        if route.path is Path.NONE:
            route.path, route.endpoint, route.stranded = Path.DIRECT, endpoint, False
        # The peer may have allowed this connection meanwhile.
        route.stuck = "" if route.endpoint == endpoint and route.allows(endpoint) else problem

    def left(self, key: DirectKey, now: float) -> list[DirectAction]:
        """Note that a subscriber has closed its connection to the proxy; a latched source may be direct now."""
        route = self._routes.get(key)
        if route is None or route.path is not Path.RELAY:
            return []
        route.path = Path.NONE
        latched = route.unmet is not None and route.unmet.condition is Condition.LATCHED
        return self._ask(key, route, now) if latched else []

    def arrived(self, key: DirectKey, now: float) -> list[DirectAction]:
        """Note that a subscriber is connected to the proxy; roscpp connects again without asking again."""
        route = self._routes.get(key)
        if route is None or route.path is not Path.NONE:
            return []
        route.path, route.stranded = Path.RELAY, False
        return self._direct(key, route, now) if route.state is DirectState.DIRECT else []

    # --- the peer ---------------------------------------------------------------------------------------------------

    def replied(self, key: DirectKey, attempt: int, found: Grant | Unmet, now: float) -> list[DirectAction]:
        """Take the response to ``Ask``; a grant that is not needed any more is released.

        ``Condition.AGENT`` means that no response came: the peer may hold a grant all the same.
        """
        route = self._routes.get(key)
        if route is None:
            return [Release(key)] if isinstance(found, Grant) else []
        if route.state is not DirectState.ASKING or route.attempt != attempt:
            # While it is asked again, or has a later grant, a Release would end that one.
            if route.state is not DirectState.RELAYED or not isinstance(found, Grant):
                return []
            route.held = False
            return [Release(key)]
        if route.doubtful:
            # A notification may be handled before the response that was sent first: the peer is asked once more.
            why = Unmet(Condition.AGENT, "something changed there while it was asked")
            if isinstance(found, Unmet):
                why, route.held = found, found.condition is Condition.AGENT
            else:
                route.grant = found  # released by what follows
            actions = self._relay(key, route, why, now)
            self._timers.set(key, route.asked_at + limits.DIRECT_RETRY_PAUSE)
            return actions
        if isinstance(found, Unmet):
            route.held = found.condition is Condition.AGENT
            return self._relay(key, route, found, now)
        route.grant = found
        if (key.peer, found.port) in self._reached:
            return self._direct(key, route, now)
        until, unmet = self._unreached.get((key.peer, found.port), (now, None))
        if unmet is not None and now < until:
            return self._relay(key, route, unmet, now)
        self._enter(route, DirectState.PROBING, now)
        if (key.peer, found.port) in self._probing:
            return []
        self._probing.add((key.peer, found.port))
        return [ProbeNode(key.peer, found)]

    def probed(self, peer: int, port: int, problem: str, now: float) -> list[DirectAction]:
        """Take the outcome of a probe.

        Args:
            peer: The peer.
            port: The probed port.
            problem: Why the port cannot be reached; empty: it can.
            now: Monotonic seconds.
        """
        if (peer, port) not in self._probing:
            return []  # of an earlier link
        self._probing.remove((peer, port))
        unmet = Unmet(Condition.REACHABLE, problem)
        if problem:
            self._unreached[peer, port] = (now + limits.DIRECT_RETRY, unmet)
            if len(self._unreached) > limits.DIRECT_MAX:
                del self._unreached[next(iter(self._unreached))]
        else:
            self._reached.add((peer, port))
            self._unreached.pop((peer, port), None)
        actions: list[DirectAction] = []
        for key, route in self:
            waits = route.state is DirectState.PROBING and key.peer == peer
            if not waits or route.grant is None or route.grant.port != port:
                continue
            if problem:
                actions += self._relay(key, route, unmet, now)
            else:
                actions += self._direct(key, route, now)
        return actions

    def closed(self, peer: int, source: Source, subscriber: str, unmet: Unmet, now: float) -> list[DirectAction]:
        """Take a peer's withdrawal of its grants for a source.

        Args:
            peer: The peer.
            source: The source.
            subscriber: The subscriber; empty: all of them.
            unmet: Why. ``Condition.NODE``: the publisher has restarted, so the peer is asked again at once.
            now: Monotonic seconds.
        """
        actions: list[DirectAction] = []
        for name, route in self.of(peer, source):
            key = DirectKey(peer, source, name)
            if subscriber in {"", name} and route.state is DirectState.ASKING:
                route.doubtful = True
            if subscriber not in {"", name} or route.grant is None:
                continue
            self._reached.discard((peer, route.grant.port))
            route.grant, route.held = None, False
            route.breaks.append(now)
            if unmet.condition is not Condition.NODE:
                actions += self._relay(key, route, unmet, now)
            elif self._unstable(route, now):
                actions += self._relay(key, route, _UNSTABLE, now)
            else:
                actions += self._hang_up(key, route)
                actions += self._ask(key, route, now)
        return actions

    def retry(self, peer: int, source: Source, now: float) -> list[DirectAction]:
        """Ask again for the subscribers of a source that the peer refused: something has changed there.

        Each is asked for at most once in ``limits.DIRECT_RETRY_PAUSE``.
        """
        actions: list[DirectAction] = []
        for name, route in self.of(peer, source):
            if route.state is DirectState.ASKING:
                route.doubtful = True
            if route.state is not DirectState.RELAYED or route.local or _waits(route):
                continue
            key, due = DirectKey(peer, source, name), route.asked_at + limits.DIRECT_RETRY_PAUSE
            if now < due:
                self._timers.set(key, due)
            else:
                actions += self._ask(key, route, now)
        return actions

    def broken(self, key: DirectKey, now: float) -> list[DirectAction]:
        """Handle a direct connection that is gone although its subscriber and its source are still there."""
        route = self._routes.get(key)
        if route is None or route.path is not Path.DIRECT:
            return []
        self.hung_up(key)
        if route.grant is not None:
            self._reached.discard((key.peer, route.grant.port))
        route.breaks.append(now)
        route.grant = None
        if route.state is DirectState.ASKING:
            return []  # the response decides
        released: list[DirectAction] = [Release(key, broken=True)] if route.held else []
        route.held = False
        if route.state is DirectState.RELAYED:
            return [*released, Move(key)]
        if self._unstable(route, now):
            return [*released, *self._relay(key, route, _UNSTABLE, now)]
        return [*released, *self._ask(key, route, now)]

    # --- links ------------------------------------------------------------------------------------------------------

    def link_down(self, peer: int, now: float, *, crashed: bool) -> list[DirectAction]:
        """Handle the loss of a peer's link.

        Args:
            peer: The peer.
            now: Monotonic seconds.
            crashed: Whether only the peer's agent has died: direct connections go on then. Otherwise the peer cannot
                be reached, or has left, and they are ended.
        """
        self._reached = {one for one in self._reached if one[0] != peer}
        self._unreached = {one: why for one, why in self._unreached.items() if one[0] != peer}
        self._probing = {one for one in self._probing if one[0] != peer}
        actions: list[DirectAction] = []
        for key, route in self:
            if key.peer != peer:
                continue
            self._timers.set(key, None)
            route.attempt = 0
            asked_again = route.state is not DirectState.RELAYED and route.path is Path.DIRECT
            if crashed and (route.state is DirectState.DIRECT or asked_again):
                continue
            actions += self._hang_up(key, route)
            if not (route.state is DirectState.RELAYED and route.local):
                self._enter(route, DirectState.RELAYED, now)
                route.unmet, route.grant = NO_LINK, None
                actions.append(Decided(key))
        return actions

    def link_up(self, peer: int, now: float) -> list[DirectAction]:
        """Ask again for every subscriber of a peer that has a link again, those that are direct included."""
        return [
            action
            for key, route in self
            if key.peer == peer and not (route.state is DirectState.RELAYED and route.local)
            for action in self._ask(key, route, now)
        ]

    # --- timers -----------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, monotonic seconds; ``None`` if no timer runs."""
        return self._timers.next()

    def handle_timer(self, now: float) -> list[DirectAction]:
        """Ask again for subscribers that were refused for a reason that may have passed."""
        actions: list[DirectAction] = []
        for key in self._timers.take(now):
            route = self._routes.get(key)
            if route is not None and route.state is DirectState.RELAYED and not route.local:
                actions += self._ask(key, route, now)
        return actions

    # --- inside -----------------------------------------------------------------------------------------------------

    @staticmethod
    def _unstable(route: DirectRoute, now: float) -> bool:
        many = len(route.breaks) == limits.DIRECT_BREAKS
        return many and now - route.breaks[0] < limits.DIRECT_BREAKS_SPAN

    @staticmethod
    def _enter(route: DirectRoute, state: DirectState, now: float) -> None:
        route.state, route.since = state, now
        if state is not DirectState.RELAYED:
            route.unmet, route.local = None, False

    def _ask(self, key: DirectKey, route: DirectRoute, now: float) -> list[DirectAction]:
        if route.path is Path.RELAY and self._is_latched(key):
            # Known before it is asked for: two modules with a subscriber of one name would free it for each other.
            return self._relay(key, route, _TWICE, now)
        self._timers.set(key, None)
        self._enter(route, DirectState.ASKING, now)
        self._attempts += 1
        route.attempt, route.asked_at, route.doubtful = self._attempts, now, False
        route.grant, route.held = None, True
        return [Ask(key, route.attempt)]

    def _hang_up(self, key: DirectKey, route: DirectRoute) -> list[DirectAction]:
        """Makes a subscriber leave its direct connection, at once as far as this machine is concerned."""
        if route.path is not Path.DIRECT or route.endpoint is None:
            return []
        endpoint = route.endpoint
        self.hung_up(key)
        return [HangUp(key, endpoint)]

    def _direct(self, key: DirectKey, route: DirectRoute, now: float) -> list[DirectAction]:
        if route.path is Path.RELAY and self._is_latched(key):
            return self._relay(key, route, _TWICE, now)
        self._enter(route, DirectState.DIRECT, now)
        if route.path is Path.DIRECT:
            same = route.allows(route.endpoint)
            route.stuck = "" if same else route.stuck  # it may stay now
        else:
            same = route.path is Path.NONE and not route.stranded
        return [Decided(key)] if same else [Decided(key), Move(key)]

    def _relay(
        self, key: DirectKey, route: DirectRoute, unmet: Unmet, now: float, *, local: bool = False
    ) -> list[DirectAction]:
        granted, route.grant = route.grant is not None, None
        if granted:
            route.held = False
        self._enter(route, DirectState.RELAYED, now)
        route.unmet, route.local, route.attempt = unmet, local, 0
        self._timers.set(key, None if unmet.lasting else now + limits.DIRECT_RETRY)
        actions: list[DirectAction] = [Release(key)] if granted else []
        if route.wanted is Transport.DIRECT and unmet.condition is not Condition.TRANSPORT:
            actions.append(Fallback(key, unmet))
        actions.append(Decided(key))
        return [*actions, Move(key)] if route.stranded or route.path is Path.DIRECT else actions


def _waits(route: DirectRoute) -> bool:
    """Whether a subscriber's connections broke repeatedly, so that only time makes it direct again."""
    return route.unmet is not None and route.unmet.condition is Condition.STABLE
