"""What peers were answered about direct calls to the services of this module, so that they learn of changes. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@dataclass(frozen=True, slots=True)
class Told:
    """The answer that a peer has for a service.

    Args:
        node: The node that provides the service.
        uri: Its registered ``rosrpc://`` URI.
        port: The port of the grant; ``None``: the peer was refused.
    """

    node: str
    uri: str
    port: int | None


@dataclass(frozen=True, slots=True)
class WithdrawService:
    """Tell a peer that calls of a service have to be relayed; ``Condition.NODE`` makes it ask again."""

    peer: int
    service: str
    node: str
    unmet: Unmet


@dataclass(frozen=True, slots=True)
class ReofferService:
    """Tell a peer that a service that it was refused may be granted now."""

    peer: int
    service: str
    node: str


ServerAction = WithdrawService | ReofferService


class ServiceGrants:
    """The grants for this module's services, and the refusals; at most one for each peer and offered service."""

    def __init__(self) -> None:
        self._told: dict[str, dict[int, Told]] = {}
        self._granted: dict[int, int] = {}
        """By peer: how many of its answers are grants."""

    def __iter__(self) -> Iterator[tuple[str, int, Told]]:
        """Each service, peer and answer; changes during the iteration are allowed."""
        return iter([(service, peer, told) for service, peers in self._told.items() for peer, told in peers.items()])

    def peers(self, service: str) -> tuple[int, ...]:
        """The peers whose nodes may call a service directly."""
        return tuple(peer for peer, told in self._told.get(service, {}).items() if told.port is not None)

    def ports(self, peer: int) -> set[int]:
        """The ports that were granted to a peer."""
        return {told.port for _, number, told in self if number == peer and told.port is not None}

    def full(self, peer: int, service: str) -> Unmet | None:
        """Why a peer can have no further grant for a service, if so."""
        told = self._told.get(service, {}).get(peer)
        if (told is not None and told.port is not None) or self._granted.get(peer, 0) < limits.DIRECT_MAX:
            return None
        return Unmet(Condition.LIMIT, f"more than {limits.DIRECT_MAX} services are called directly from there")

    def answered(self, peer: int, service: str, node: str, uri: str, found: Grant | Unmet) -> None:
        """Note what a peer is answered."""
        self._put(service, peer, Told(node, uri, found.port if isinstance(found, Grant) else None))

    def released(self, peer: int, service: str, node: str) -> None:
        """Forget the grant of a peer whose clients do not call a service directly any more."""
        told = self._told.get(service, {}).get(peer)
        if told is not None and told.node == node and told.port is not None:
            self._drop(service, peer)

    def server(self, service: str, node: str, uri: str) -> list[ServerAction]:
        """Let the peers ask again for a service that has another server now.

        Args:
            service: The service.
            node: The node that provides it now; empty: none does, and the peers learn it by the advertisement.
            uri: Its registered URI.
        """
        actions: list[ServerAction] = []
        for peer, told in list(self._told.get(service, {}).items()):
            if (told.node, told.uri) == (node, uri):
                continue
            self._drop(service, peer)
            if told.node == node and told.port is not None:
                actions.append(WithdrawService(peer, service, node, Unmet(Condition.NODE, f"{node} has restarted")))
            elif told.node == node:
                actions.append(ReofferService(peer, service, node))
        return actions

    def judge_again(self, unmet: Callable[[str, int], Unmet | None], *, secured: bool = False) -> list[ServerAction]:
        """Judge by other rules: withdraw what they forbid, and let peers ask again for what they may allow.

        Args:
            unmet: ``(service, peer)``: the condition that does not hold by the new rules, if any.
            secured: Whether the mesh is secured: the answers about services that are not offered any more are
                forgotten, so that their peers do not learn of changes.
        """
        actions: list[ServerAction] = []
        for service, peer, told in self:
            why = unmet(service, peer)
            if why is not None and told.port is not None:
                self._put(service, peer, Told(told.node, told.uri, None))
                actions.append(WithdrawService(peer, service, told.node, why))
            elif why is None and told.port is None:
                self._drop(service, peer)
                actions.append(ReofferService(peer, service, told.node))
            if secured and why is not None and why.condition is Condition.OFFERED:
                self._drop(service, peer)
        return actions

    def peer_gone(self, peer: int) -> None:
        """Forget the answers of a peer whose link is gone; it asks again over the next one."""
        for service, number, _ in self:
            if number == peer:
                self._drop(service, number)

    def _put(self, service: str, peer: int, told: Told) -> None:
        peers = self._told.setdefault(service, {})
        before, peers[peer] = peers.get(peer), told
        was_granted = before is not None and before.port is not None
        self._count(peer, (told.port is not None) - was_granted)

    def _count(self, peer: int, more: int) -> None:
        number = self._granted.get(peer, 0) + more
        if number:
            self._granted[peer] = number
        else:
            self._granted.pop(peer, None)

    def _drop(self, service: str, peer: int) -> None:
        peers = self._told[service]
        if peers.pop(peer).port is not None:
            self._count(peer, -1)
        if not peers:
            del self._told[service]
