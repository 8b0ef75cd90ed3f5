"""Which subscribers of peers may connect to local publishers directly. Pure.

A rospy publisher keeps one connection for each caller id: a second subscriber of that name closes the first one's
connection without a word (docs/design/ros-traps.md, trap 12). Therefore a name is granted once for each source, and
not at all while a local node of that name subscribes to the topic.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition, Unmet

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator

    from rmpa.bridge.messages import Source
    from rmpa.core.contract import Contract


@dataclass(frozen=True, slots=True)
class Granted:
    """A grant in force.

    Args:
        asked: The contract that the peer asked for.
        port: The TCPROS port of the publisher's node.
        uri: The slave API of that node.
    """

    asked: Contract
    port: int
    uri: str


@dataclass(frozen=True, slots=True)
class WithdrawGrant:
    """Tell a peer that its subscribers of a source have to be relayed.

    Args:
        peer: The peer.
        source: The source, by its local name, which is its wire name too.
        subscriber: The subscriber; empty: all of them.
        unmet: Why; ``Condition.NODE`` makes the peer ask again.
    """

    peer: int
    source: Source
    subscriber: str
    unmet: Unmet


@dataclass(frozen=True, slots=True)
class Retry:
    """Tell a peer that a source that it was refused may be granted now."""

    peer: int
    source: Source


@dataclass(frozen=True, slots=True)
class EndConnections:
    """End the connections from a local publisher's port to a peer's address.

    The peer cannot be reached, or may not have them any more.
    """

    peer: int
    port: int


GrantAction = WithdrawGrant | Retry | EndConnections


class DirectGrants:
    """The grants of this module's publishers.

    Args:
        on_change: ``(peer, source, subscriber, granted)``: a subscriber has got a grant, or has none any more.
    """

    def __init__(self, on_change: Callable[[int, Source, str, bool], None] = lambda *_: None) -> None:
        self._on_change = on_change
        self._grants: dict[Source, dict[tuple[int, str], Granted]] = {}
        self._count: dict[int, int] = {}
        self._refused: dict[Source, dict[int, None]] = {}
        """Peers to tell when something changes that made a source be refused (a dict, for its order)."""
        self._refusals: dict[int, dict[Source, None]] = {}
        """The same by peer, to bound them: a peer names the sources."""
        self._away: dict[Source, dict[int, None]] = {}
        """Peers to tell when a source that was granted to them is published again."""
        self._unconfirmed: dict[int, set[tuple[Source, str]]] = {}
        """The grants from before a peer's present link that it has not asked for again."""

    def __iter__(self) -> Iterator[tuple[Source, int, str, Granted]]:
        """Every grant: source, peer, subscriber."""
        for source, grants in list(self._grants.items()):
            for (peer, subscriber), granted in list(grants.items()):
                yield source, peer, subscriber, granted

    def of(self, source: Source) -> list[tuple[int, str, Granted]]:
        """The grants for one source: peer and subscriber of each."""
        return [(peer, name, granted) for (peer, name), granted in self._grants.get(source, {}).items()]

    def judge(self, peer: int, source: Source, subscriber: str, local: Collection[str]) -> Unmet | None:
        """Check whether the caller id of a subscriber is free, and the peer's number of grants within its bound.

        A refusal is remembered: ``Retry`` follows when it may be granted.

        Args:
            peer: The peer.
            source: The source.
            subscriber: The subscriber's name, in the peer's graph.
            local: The local nodes that subscribe to the topic.
        """
        grants = self._grants.get(source, {})
        unmet = None
        if subscriber in local:
            unmet = Unmet(Condition.CALLER_ID, f"a node {subscriber} of the publisher's module subscribes too")
        elif any(name == subscriber and other != peer for other, name in grants):
            unmet = Unmet(Condition.CALLER_ID, f"a node {subscriber} of another module is connected already")
        elif (peer, subscriber) not in grants and self._count.get(peer, 0) >= limits.DIRECT_MAX:
            unmet = Unmet(Condition.LIMIT, f"more than {limits.DIRECT_MAX} direct connections to this module")
        if unmet is not None:
            self.refuse(peer, source)
        return unmet

    def refuse(self, peer: int, source: Source) -> None:
        """Remember that a peer was refused a source, for ``Retry``; at most ``limits.DIRECT_MAX`` for each peer."""
        refusals = self._refusals.setdefault(peer, {})
        refusals[source] = None
        self._refused.setdefault(source, {})[peer] = None
        if len(refusals) > limits.DIRECT_MAX:
            self._forget_refusal(peer, next(iter(refusals)))

    def refused(self, peer: int, source: Source, subscriber: str, *, hidden: bool = False) -> list[GrantAction]:
        """Refuse a subscriber: an earlier grant of it ends, and others that were refused may try again.

        Args:
            peer: The peer.
            source: The source.
            subscriber: The subscriber's name, in the peer's graph.
            hidden: Whether the peer must not learn of changes of the source: no ``Retry`` follows.
        """
        actions: list[GrantAction] = []
        if self._drop(peer, source, subscriber):
            actions += [one for one in self.changed(source) if one.peer != peer]
        if hidden:
            self._forget_refusal(peer, source)
        else:
            self.refuse(peer, source)
        return actions

    def grant(self, peer: int, source: Source, subscriber: str, granted: Granted) -> None:
        """Note a grant; one of the same subscriber is replaced."""
        grants = self._grants.setdefault(source, {})
        is_new = (peer, subscriber) not in grants
        grants[peer, subscriber] = granted
        if is_new:
            self._count[peer] = self._count.get(peer, 0) + 1
            self._on_change(peer, source, subscriber, True)
        self._confirm(peer, source, subscriber)

    def release(self, peer: int, source: Source, subscriber: str) -> list[GrantAction]:
        """Forget a grant that its subscriber does not use any more."""
        if not self._drop(peer, source, subscriber):
            return []
        return self.changed(source)

    def has(self, peer: int, source: Source, subscriber: str) -> bool:
        """Whether a subscriber has a grant."""
        return (peer, subscriber) in self._grants.get(source, {})

    def link_up(self, peer: int) -> None:
        """Handle a peer's new link: it asks again for what it uses; see ``expire``."""
        found = {(source, subscriber) for source, owner, subscriber, _ in self if owner == peer}
        if found:
            self._unconfirmed[peer] = found

    def expire(self, peer: int) -> list[GrantAction]:
        """End the grants that a peer has not asked for again since its last link began.

        Its subscribers have gone while it had no link. Call this ``limits.DIRECT_ADOPT`` after ``link_up``.
        """
        actions: list[GrantAction] = []
        for source, subscriber in sorted(self._unconfirmed.pop(peer, ())):
            actions += self.release(peer, source, subscriber)
        return actions

    def local_subscriber(self, topic: str, node: str) -> list[GrantAction]:
        """Withdraw the grants whose caller id a local subscriber of the topic has from now on."""
        actions: list[GrantAction] = []
        text = f"a node {node} of the publisher's module subscribes too"
        for source, peer, subscriber, _ in list(self):
            if source.topic == topic and subscriber == node:
                self._drop(peer, source, subscriber)
                self.refuse(peer, source)
                actions.append(WithdrawGrant(peer, source, subscriber, Unmet(Condition.CALLER_ID, text)))
        return actions

    def local_subscriber_gone(self, topic: str) -> list[GrantAction]:
        """Let the refused peers of a topic try again: a local subscriber has gone."""
        return [action for source in list(self._refused) if source.topic == topic for action in self.changed(source)]

    def changed(self, source: Source) -> list[GrantAction]:
        """Let the peers that were refused a source try again: something has changed."""
        peers = list(self._refused.get(source, ()))
        for peer in peers:
            self._forget_refusal(peer, source)
        return [Retry(peer, source) for peer in peers]

    def withdraw(self, source: Source, unmet: Unmet) -> list[GrantAction]:
        """Withdraw every grant for a source."""
        peers = dict.fromkeys(peer for peer, _, _ in self.of(source))
        for peer, subscriber, _ in self.of(source):
            self._drop(peer, source, subscriber)
            self.refuse(peer, source)
        return [WithdrawGrant(peer, source, "", unmet) for peer in peers]

    def gone(self, source: Source) -> None:
        """Forget the grants of a source whose publisher has left; see ``published``."""
        for peer, subscriber, _ in self.of(source):
            self._drop(peer, source, subscriber)
            self._away.setdefault(source, {})[peer] = None
        while len(self._away) > limits.DIRECT_MAX:
            del self._away[next(iter(self._away))]

    def published(self, source: Source, uri: str) -> list[GrantAction]:
        """Handle the registration of a publisher: what was granted for an earlier run of its node is withdrawn.

        Args:
            source: The source.
            uri: The slave API of the node.
        """
        unmet = Unmet(Condition.NODE, f"{source.node} has restarted")
        if any(granted.uri != uri for _, _, granted in self.of(source)):
            return self.withdraw(source, unmet)
        away = self._away.pop(source, {})
        return [*(WithdrawGrant(peer, source, "", unmet) for peer in away), *self.changed(source)]

    def judge_again(
        self, unmet: Callable[[Source, int, Granted], Unmet | None], *, secured: bool = False
    ) -> list[GrantAction]:
        """Withdraw the grants that the rules do not allow any more.

        Args:
            unmet: ``(source, peer, grant)``: the condition that does not hold by the new rules, if any.
            secured: Whether the mesh is secured: the connections end at once, which is not left to the peer's agent,
                and no ``Retry`` follows for a source that is not offered any more.
        """
        actions: list[GrantAction] = []
        for source, peer, subscriber, granted in list(self):
            why = unmet(source, peer, granted)
            if why is not None:
                if secured:
                    actions.append(EndConnections(peer, granted.port))
                hidden = secured and why.condition is Condition.OFFERED
                self._drop(peer, source, subscriber)
                if not hidden:
                    self.refuse(peer, source)
                actions.append(WithdrawGrant(peer, source, subscriber, why))
        return actions

    def retry_all(self) -> list[GrantAction]:
        """Let every refused peer try again: the rules have changed."""
        return [action for source in list(self._refused) for action in self.changed(source)]

    def unreachable(self, peer: int) -> list[GrantAction]:
        """Handle the loss of a peer's link by silence: a publisher may block on a connection to it."""
        ports = dict.fromkeys(granted.port for _, owner, _, granted in self if owner == peer)
        return [EndConnections(peer, port) for port in ports]

    def peer_gone(self, peer: int) -> list[GrantAction]:
        """Forget a peer for good; names that it held are free."""
        freed: list[GrantAction] = []
        for source in list(self._refusals.get(peer, ())):
            self._forget_refusal(peer, source)
        for peers in self._away.values():
            peers.pop(peer, None)
        self._away = {source: peers for source, peers in self._away.items() if peers}
        for source, owner, subscriber, _ in list(self):
            if owner == peer:
                self._drop(peer, source, subscriber)
                freed += self.changed(source)
        self._count.pop(peer, None)
        self._unconfirmed.pop(peer, None)
        return freed

    def _drop(self, peer: int, source: Source, subscriber: str) -> bool:
        grants = self._grants.get(source, {})
        if grants.pop((peer, subscriber), None) is None:
            return False
        if not grants:
            del self._grants[source]
        self._count[peer] -= 1
        self._on_change(peer, source, subscriber, False)
        self._confirm(peer, source, subscriber)
        return True

    def _forget_refusal(self, peer: int, source: Source) -> None:
        peers, sources = self._refused.get(source, {}), self._refusals.get(peer, {})
        peers.pop(peer, None)
        sources.pop(source, None)
        if not peers:
            self._refused.pop(source, None)
        if not sources:
            self._refusals.pop(peer, None)

    def _confirm(self, peer: int, source: Source, subscriber: str) -> None:
        self._unconfirmed.get(peer, set()).discard((source, subscriber))
