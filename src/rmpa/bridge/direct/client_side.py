"""Decides for each shown service of a peer whether the nodes of this module call its server directly. Pure.

One ``DirectService`` is kept for each service that is not relayed by rule::

           ┌──────── asked again: link up, retry, another server ────────┐
           ▼                                                             │
        ASKING ──granted──► PROBING ──reached──► DIRECT ──withdrawn──────┤
           │ refused           │ not reached        │ condition fails    │
           └───────────────────┴────────────────────┴──────► RELAYED ────┘

Only the master's answer to ``lookupService`` changes: a client that has a connection keeps it. When the peer's agent
has crashed, what is ``DIRECT`` stays so (*adrift*) while its server answers a probe each ``limits.DIRECT_CHECK``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import NO_LINK, Condition, Grant, Unmet
from rmpa.bridge.direct.direct_route import DirectState
from rmpa.core.contract import Transport
from rmpa.core.timer_queue import TimerQueue

if TYPE_CHECKING:
    from collections.abc import Iterator


class ServiceKey(NamedTuple):
    """One shown service of a peer.

    Args:
        peer: The number of the peer's session.
        service: The service's name here.
    """

    peer: int
    service: str


@dataclass(slots=True)
class DirectService:
    """The state of one service.

    Args:
        node: The node that provides it, in the peer's graph.
        wanted: The transport that this module's rules ask for.
        state: The decision.
        unmet: Why its calls are relayed; ``None`` in other states.
        local: Whether ``unmet`` was found here, not at the peer.
        grant: The peer's permission, from ``PROBING`` on.
        attempt: Counts the requests and probes, to tell their outcomes apart.
        doubtful: Whether something changed there while the peer was asked, so that a refusal may be outdated.
        adrift: Whether it is ``DIRECT`` although the peer's agent has crashed.
    """

    node: str
    wanted: Transport
    state: DirectState = DirectState.RELAYED
    unmet: Unmet | None = None
    local: bool = True
    grant: Grant | None = None
    attempt: int = 0
    doubtful: bool = False
    adrift: bool = False


@dataclass(frozen=True, slots=True)
class AskPeer:
    """Ask the peer for a grant; pass the response to ``replied`` with this attempt."""

    key: ServiceKey
    attempt: int


@dataclass(frozen=True, slots=True)
class ProbeServer:
    """Let the server of a grant answer a service's probe; pass the outcome to ``probed`` with this attempt."""

    key: ServiceKey
    attempt: int
    grant: Grant


@dataclass(frozen=True, slots=True)
class AnswerDirect:
    """Answer lookups of the service with the server's own address from now on."""

    key: ServiceKey
    grant: Grant


@dataclass(frozen=True, slots=True)
class AnswerRelay:
    """Answer lookups of the service with the proxy's address from now on."""

    key: ServiceKey


@dataclass(frozen=True, slots=True)
class ReleaseGrant:
    """Tell the peer that the service is not called directly any more.

    Args:
        key: The service.
        node: The node that provides it.
    """

    key: ServiceKey
    node: str


@dataclass(frozen=True, slots=True)
class Lost:
    """The server of a service that was adrift does not answer any more: remove the service from the graph."""

    key: ServiceKey
    problem: str


@dataclass(frozen=True, slots=True)
class ServiceFallback:
    """Warn: this module's rules say ``direct``, and a condition does not hold."""

    key: ServiceKey
    unmet: Unmet


ServiceAction = AskPeer | ProbeServer | AnswerDirect | AnswerRelay | ReleaseGrant | Lost | ServiceFallback


class DirectServices:
    """The direct calls of this module's nodes to services of its peers."""

    def __init__(self) -> None:
        self._services: dict[ServiceKey, DirectService] = {}
        self._busy: dict[int, set[str]] = {}
        """By peer: the services that are asked for or probed, at most ``limits.DIRECT_ASKS``."""
        self._queued: dict[int, dict[str, None]] = {}
        """By peer: the services in ``ASKING`` that wait for one of these places."""
        self._timers: TimerQueue[ServiceKey] = TimerQueue()

    def __iter__(self) -> Iterator[tuple[ServiceKey, DirectService]]:
        """Every service with its state; changes during the iteration are allowed."""
        return iter(list(self._services.items()))

    def get(self, key: ServiceKey) -> DirectService | None:
        """The state of one service; ``None`` if it is not known, or relayed by rule."""
        return self._services.get(key)

    def adrift(self, peer: int) -> set[str]:
        """The services of a peer that are called directly although its agent has crashed."""
        return {key.service for key, service in self._services.items() if key.peer == peer and service.adrift}

    # --- the local graph -----------------------------------------------------------------------------------------

    def consider(
        self, key: ServiceKey, node: str, wanted: Transport, unmet: Unmet | None, now: float
    ) -> list[ServiceAction]:
        """Judge a service that is shown now, or for which something changed here.

        Args:
            key: The service.
            node: The node that provides it.
            wanted: The transport that this module's rules ask for.
            unmet: The condition that does not hold here, if any.
            now: Monotonic seconds.
        """
        service = self._services.get(key)
        if service is not None and service.node != node:
            actions = self.remove(key)
            return actions + self.consider(key, node, wanted, unmet, now)
        if service is None:
            service = self._services[key] = DirectService(node, wanted)
        before, service.wanted = service.wanted, wanted
        if unmet is not None:
            if service.unmet == unmet and before is wanted:
                return []
            return self._relay(key, service, unmet, now, local=True)
        return self._ask(key, service) if service.local else []

    def wait(self, key: ServiceKey, node: str, wanted: Transport) -> None:
        """Note a service that nothing stands against here, and whose peer has no link; ``link_up`` asks for it."""
        service = self._services.get(key)
        if service is None or service.node != node or service.local:
            unmet = NO_LINK
            self._services[key] = DirectService(node, wanted, unmet=unmet, local=False)

    def remove(self, key: ServiceKey) -> list[ServiceAction]:
        """Forget a service: it has left the local graph, or is relayed by rule."""
        service = self._services.pop(key, None)
        if service is None:
            return []
        self._timers.set(key, None)
        return [*self._leave(key, service), *self._done(key)]

    def renewed(self, key: ServiceKey) -> list[ServiceAction]:
        """Ask again for a service that the peer has offered again: its server may be another one."""
        service = self._services.get(key)
        return self._ask(key, service) if service is not None and not service.local else []

    # --- the peer ------------------------------------------------------------------------------------------------

    def replied(self, key: ServiceKey, attempt: int, found: Grant | Unmet, now: float) -> list[ServiceAction]:
        """Take the response to ``AskPeer``; one to an earlier attempt is ignored."""
        service = self._services.get(key)
        if service is None or service.state is not DirectState.ASKING or service.attempt != attempt:
            return []
        if isinstance(found, Unmet):
            doubtful = service.doubtful
            actions = self._relay(key, service, found, now)
            if doubtful:
                self._timers.set(key, now + limits.DIRECT_RETRY_PAUSE)
            return actions
        service.state, service.grant = DirectState.PROBING, found
        return [ProbeServer(key, attempt, found)]

    def probed(self, key: ServiceKey, attempt: int, problem: str, now: float) -> list[ServiceAction]:
        """Take the outcome of a probe; that of an earlier attempt is ignored.

        Args:
            key: The service.
            attempt: That of ``ProbeServer``.
            problem: Why the server does not answer; empty: it does.
            now: Monotonic seconds.
        """
        service = self._services.get(key)
        if service is None or service.attempt != attempt or service.grant is None:
            return []
        if service.adrift:
            if problem:
                return [*self._relay(key, service, Unmet(Condition.REACHABLE, problem), now), Lost(key, problem)]
            self._timers.set(key, now + limits.DIRECT_CHECK)
            return []
        if service.state is not DirectState.PROBING:
            return []
        if problem:
            return self._relay(key, service, Unmet(Condition.REACHABLE, problem), now)
        service.state, service.unmet = DirectState.DIRECT, None
        return [AnswerDirect(key, service.grant), *self._done(key)]

    def closed(self, key: ServiceKey, node: str, unmet: Unmet, now: float) -> list[ServiceAction]:
        """Take a peer's withdrawal of its grant.

        Args:
            key: The service.
            node: The node that provided it.
            unmet: Why. ``Condition.NODE``: the server has restarted, so the peer is asked again at once.
            now: Monotonic seconds.
        """
        service = self._services.get(key)
        if service is None or service.node != node or service.state is DirectState.RELAYED:
            return []
        if unmet.condition is Condition.NODE:
            return self._ask(key, service)
        return self._relay(key, service, unmet, now)

    def retry(self, key: ServiceKey, node: str) -> list[ServiceAction]:
        """Ask again for a service that the peer refused: something has changed there."""
        service = self._services.get(key)
        if service is None or service.node != node:
            return []
        if service.state is DirectState.ASKING:
            service.doubtful = True  # this may be handled before the refusal that was sent first
        if service.local or service.state is not DirectState.RELAYED:
            return []
        return self._ask(key, service)

    def unreachable(self, key: ServiceKey, problem: str, now: float) -> list[ServiceAction]:
        """Relay a service whose server cannot be reached any more, although the peer has a link."""
        service = self._services.get(key)
        if service is None or service.state is not DirectState.DIRECT or service.adrift:
            return []
        return self._relay(key, service, Unmet(Condition.REACHABLE, problem), now)

    # --- links ---------------------------------------------------------------------------------------------------

    def link_down(self, peer: int, now: float, *, crashed: bool) -> list[ServiceAction]:
        """Handle the loss of a peer's link.

        Args:
            peer: The peer.
            now: Monotonic seconds.
            crashed: Whether only the peer's agent has died: its nodes still answer then. Otherwise the peer cannot
                be reached, or has left.
        """
        self._busy.pop(peer, None)
        self._queued.pop(peer, None)
        actions: list[ServiceAction] = []
        for key, service in self:
            if key.peer != peer:
                continue
            service.attempt += 1
            self._timers.set(key, None)
            if crashed and service.state is DirectState.DIRECT:
                service.adrift = True
                self._timers.set(key, now)
            elif not (service.state is DirectState.RELAYED and service.local):
                if service.state is DirectState.DIRECT:
                    actions.append(AnswerRelay(key))
                service.state, service.grant, service.adrift = DirectState.RELAYED, None, False
                service.unmet = NO_LINK
        return actions

    def link_up(self, peer: int) -> list[ServiceAction]:
        """Ask again for every service of a peer that has a link again."""
        return [
            action
            for key, service in self
            if key.peer == peer and not (service.state is DirectState.RELAYED and service.local)
            for action in self._ask(key, service)
        ]

    # --- timers --------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, monotonic seconds; ``None`` if no timer runs."""
        return self._timers.next()

    def handle_timer(self, now: float) -> list[ServiceAction]:
        """Ask again after a refusal whose reason may have passed; probe what is adrift."""
        actions: list[ServiceAction] = []
        for key in self._timers.take(now):
            service = self._services.get(key)
            if service is None:
                continue
            if service.adrift and service.grant is not None:
                service.attempt += 1
                actions.append(ProbeServer(key, service.attempt, service.grant))
            elif service.state is DirectState.RELAYED and not service.local:
                actions += self._ask(key, service)
        return actions

    # --- inside --------------------------------------------------------------------------------------------------

    def _ask(self, key: ServiceKey, service: DirectService) -> list[ServiceAction]:
        self._timers.set(key, None)
        actions: list[ServiceAction] = [AnswerRelay(key)] if service.state is DirectState.DIRECT else []
        service.state, service.unmet, service.local = DirectState.ASKING, None, False
        service.grant, service.adrift, service.doubtful = None, False, False
        service.attempt += 1
        busy = self._busy.setdefault(key.peer, set())
        if key.service not in busy and len(busy) >= limits.DIRECT_ASKS:
            self._queued.setdefault(key.peer, {})[key.service] = None
            return actions
        busy.add(key.service)
        return [*actions, AskPeer(key, service.attempt)]

    def _done(self, key: ServiceKey) -> list[ServiceAction]:
        """Frees the place of a service among those that are asked for, and gives it to the next one."""
        queued, busy = self._queued.get(key.peer, {}), self._busy.get(key.peer, set())
        queued.pop(key.service, None)
        if key.service not in busy:
            return []
        busy.remove(key.service)
        if not queued:
            return []
        name = next(iter(queued))
        del queued[name]
        following = ServiceKey(key.peer, name)
        busy.add(name)
        return [AskPeer(following, self._services[following].attempt)]

    @staticmethod
    def _leave(key: ServiceKey, service: DirectService, *, release: bool = True) -> list[ServiceAction]:
        """Stops direct answers, and gives a grant back that the peer may count on."""
        actions: list[ServiceAction] = [AnswerRelay(key)] if service.state is DirectState.DIRECT else []
        if release and service.state is not DirectState.RELAYED and not service.adrift:
            actions.append(ReleaseGrant(key, service.node))
        return actions

    def _relay(
        self, key: ServiceKey, service: DirectService, unmet: Unmet, now: float, *, local: bool = False
    ) -> list[ServiceAction]:
        ours = local or unmet.condition is Condition.REACHABLE
        actions = self._leave(key, service, release=ours)
        service.state, service.unmet, service.local = DirectState.RELAYED, unmet, local
        service.grant, service.adrift = None, False
        service.attempt += 1
        self._timers.set(key, None if unmet.lasting else now + limits.DIRECT_RETRY)
        if service.wanted is Transport.DIRECT and unmet.condition is not Condition.TRANSPORT:
            actions.append(ServiceFallback(key, unmet))
        return actions + self._done(key)
