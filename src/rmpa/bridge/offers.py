"""What this module offers, and what each peer was told of it. Pure.

As in ``peer_offers``, work is by level: the caller notes a fact and has the entry judged, again whenever a fact has
changed. Work depends on the size of a change, not on that of the graph.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import Enum, auto
from itertools import islice
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from rmpa.bridge import limits
from rmpa.bridge.messages import Message, Source, TopicOffer, is_crossing_name, is_crossing_type
from rmpa.bridge.policy import BridgeContext, Local, PolicyDecision, may_have
from rmpa.ros.wire.tcpros import ANY
from rmpa.trust.permissions import PermissionDecision

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator, Mapping

    from rmpa.config.peer_rules import Access


class PeerState(Enum):
    """The state of a peer.

    ::

    LINKED ──silence──► SILENT ──SILENT_GRACE► AWAY ──nothing waits any more──► (gone)
      ▲  ├──closed in order──────────────────►  │
      ├──┼────────────── a new link ────────────┘   (from SILENT, too)

    Attributes:
        LINKED: The peer has a link.
        SILENT: Its link ended by silence; most peers are back within ``mesh.limits.SILENT_GRACE``.
        AWAY: It has no link, and a part of the bridge keeps something for it.
    """

    LINKED = auto()
    SILENT = auto()
    AWAY = auto()


@dataclass(slots=True, eq=False, kw_only=True)
class PeerRun:
    """One run of a peer, across its links.

    Args:
        peer: Its number in this agent; never used again for another run.
        name: Its name, which selects the rules for it.
        instance: The run, as 32 hexadecimal digits.
        rank: The value of its GUID.
        state: Whether it has a link.
        silent: Whether its last link ended by silence.
        away_since: When its last link ended, monotonic seconds; 0 before.
    """

    peer: int
    name: str = ""
    instance: str = ""
    rank: int = 0
    state: PeerState = PeerState.LINKED
    silent: bool = False
    away_since: float = 0.0

    @property
    def linked(self) -> bool:
        """Whether the peer has a link now."""
        return self.state is PeerState.LINKED


def wire_of(offer: Any) -> Any:
    """How the module of an offer, which is a topic's or a service's, names what is offered."""
    return offer.source if isinstance(offer, TopicOffer) else offer.service


class Effects(ABC):
    """What a part of the bridge does for its books, at once and without calling back; ``GraphPart`` is it.

    Attributes:
        rng: Uniform numbers in [0, 1), for the jitter of a back-off.
    """

    rng: Callable[[], float]

    @property
    @abstractmethod
    def context(self) -> BridgeContext:
        """The rules that hold now."""

    @abstractmethod
    def send(self, peer: int, message: Message) -> None:
        """Send a control message to a peer, if it has a link."""

    @abstractmethod
    def warn(self, kind: str, who: str, text: str) -> None:
        """Log a warning about ``who`` and count it as ``kind``; repeated ones are only counted."""


KeyT = TypeVar("KeyT", bound="Hashable")
LocalT = TypeVar("LocalT", bound=Local)
OfferT = TypeVar("OfferT")
RouteT = TypeVar("RouteT")


@dataclass(slots=True)
class Told(Generic[KeyT, LocalT, OfferT, RouteT]):
    """One linked peer, what it was told over this link, and what it has asked for.

    Args:
        session: The peer. Nothing that came from its run is relayed back to it.
        due: The entries to examine for this peer: they may have changed (a dict, for its order).
        offers: By key: the offer that the peer was told, and the local entry that it was made of.
        by_wire: The keys of ``offers``, by name on the wire.
        routes: The routes that it has asked for, by its own numbers of them.
        behind: By name on the wire: keys of entries that are not told because another entry has that name.
        begun: Whether the first portion was told.
        whole: Whether the peer was told everything once.
        told_at: When the last portion was told, monotonic seconds.
    """

    session: PeerRun
    due: dict[KeyT, None]
    offers: dict[KeyT, tuple[OfferT, LocalT]] = field(default_factory=dict)
    by_wire: dict[KeyT, KeyT] = field(default_factory=dict)
    routes: dict[int, RouteT] = field(default_factory=dict)
    behind: dict[KeyT, list[KeyT]] = field(default_factory=dict)
    begun: bool = False
    whole: bool = False
    told_at: float = -math.inf


class OfferBook(ABC, Generic[KeyT, LocalT, OfferT, RouteT]):
    """The entries of the local graph, which of them are offered, and what each linked peer was told of them.

    Keys are local names; a subclass says what an entry is, whether it may cross, and what its peers are told.

    Args:
        out: The part, which has the rules, and does what is decided here: at once, without calling back.

    Attributes:
        kind: The setting that limits the offered entries: ``topics`` or ``services``.
        counter: Counts the entries beyond that limit.
        access: What a peer does with an entry.
        owner: What provides an entry, for texts.
        message: ``(added, removed, full, more)``: the message to a peer with a portion of the entries.
        renews: Whether a changed entry is told again although its offer is the same.
        reports: Whether a peer that may not know of an entry is reported: it may want to use it.
        seen: What the local graph has, whether it crosses or not.
        offered: What peers may have, within the limit; ``judge_for`` decides for each of them.
        beyond: What is offered to no peer because there is more than the limit, the first one first.
        peers: The linked peers; the one that has waited longest for its next portion comes first.
    """

    kind: ClassVar[str]
    counter: ClassVar[str]
    access: ClassVar[Access]
    owner: ClassVar[str]
    message: ClassVar[Callable[..., Message]]
    renews: ClassVar[bool] = False
    reports: ClassVar[bool] = True

    def __init__(self, out: Effects) -> None:
        self._out = out
        self.seen: dict[KeyT, LocalT] = {}
        self.offered: dict[KeyT, LocalT] = {}
        self.beyond: dict[KeyT, None] = {}
        self.peers: dict[int, Told[KeyT, LocalT, OfferT, RouteT]] = {}

    @abstractmethod
    def judge(self, key: KeyT, local: LocalT) -> PolicyDecision:
        """Decide whether an entry may cross at all."""

    @abstractmethod
    def name_of(self, key: KeyT) -> str:
        """The topic or service, which rules are about."""

    @abstractmethod
    def offer_for(self, key: KeyT, local: LocalT, wire: str) -> OfferT:
        """The offer of an entry under a name on the wire."""

    def _ended(self, key: KeyT, reason: str) -> None:
        """End what uses an entry: it is not offered any more, or another one has its place."""

    def _ended_for(self, peer: int, key: KeyT) -> None:
        """End what one peer uses of an entry: it may not have it any more, or has it under another name now."""

    def judge_for(
        self, told: Told[KeyT, LocalT, OfferT, RouteT], key: KeyT, local: LocalT
    ) -> tuple[PolicyDecision | PermissionDecision, OfferT | None]:
        """Decide whether an entry that may cross may cross to one peer, and make its offer if it may.

        Permissions decide only where they refuse it.
        """
        context, origin = self._out.context, local.origin
        name, peer = self.name_of(key), told.session.name
        if origin is not None and not may_have(told.session.instance, origin):
            return PolicyDecision(False, f"it comes from {peer}"), None
        wire = context.names.of(peer).wire_name(name)
        if not is_crossing_name(wire):
            return PolicyDecision(False, f"its name there would be {wire!r}"), None
        decision = context.policy.judge_for(peer, name, local.type, wire)
        permission = context.gate.judge(self.access, peer, name)
        if not (decision.allowed and permission.allowed):
            return (permission if decision.allowed else decision), None
        return decision, self.offer_for(key, local, wire)

    @property
    def limit(self) -> int:
        """How many entries are offered."""
        return self._out.context.limit(self.kind)

    def put(self, key: KeyT, local: LocalT | None, *, again: bool = False) -> None:
        """Offer what the local graph has under a key, or keep it home; ``advertise`` tells peers what changes.

        Args:
            key: The key.
            local: The entry; ``None``: the graph has none.
            again: Judge it although the graph is as before: a rule has changed, or there is room below the limit.
        """
        if self.seen.get(key) == local and not again:
            return
        if local is None:
            del self.seen[key]
        else:
            self.seen[key] = local
        before, ended = self.offered.get(key), f"{self.owner} has restarted"
        if local is None or not self.judge(key, local).allowed:
            self.beyond.pop(key, None)
            if before is None:
                return
            del self.offered[key]
            ended = f"{self.owner} has gone" if local is None else "a rule keeps it home now"
        elif local == before:
            return
        elif before is None and len(self.offered) >= self.limit:
            self.beyond[key] = None
            text = f"this module has more {self.kind} than limits.{self.kind} = {self.limit}; the rest is "
            text += "offered to no peer: raise it in rmpa.toml and `rmpa reload`, or deny some"
            self._out.warn(self.counter, "local", text)
            return
        else:
            self.beyond.pop(key, None)
            self.offered[key] = local
        for told in self.peers.values():
            told.due[key] = None
        if before is not None:
            self._ended(key, ended)
            if key not in self.offered and self.beyond and len(self.offered) < self.limit:
                first = next(iter(self.beyond))
                self.put(first, self.seen[first], again=True)

    def reload(self) -> Iterator[None]:
        """Judge by new rules, an entry with each item; then peers are told what has changed for them."""
        for key in tuple(self.seen):
            if key in self.seen:
                self.put(key, self.seen[key], again=True)
            yield
        for told in self.peers.values():
            told.due |= dict.fromkeys(self.offered)

    def link_up(self, session: PeerRun) -> None:
        """Begin to tell a peer everything; ``advertise`` goes on with it."""
        told = self.peers[session.peer] = Told(session, dict.fromkeys(self.offered))
        self._portion(session.peer, told)

    def link_down(self, peer: int) -> None:
        """Forget what a peer was told; its routes have no numbers any more."""
        self.peers.pop(peer, None)

    def route(self, peer: int, number: int) -> RouteT | None:
        """The route that a linked peer has asked for by this number."""
        return told.routes.get(number) if (told := self.peers.get(peer)) is not None else None

    def offer(self, peer: int, key: KeyT) -> OfferT | None:
        """The offer that a peer was told last of an entry; ``None`` if it does not know the entry."""
        told = self.peers.get(peer)
        return told.offers[key][0] if told is not None and key in told.offers else None

    def local(self, peer: int, wire: KeyT) -> KeyT | None:
        """The entry that a peer means by a name on the wire; ``None`` if none is offered to it by that name."""
        told = self.peers.get(peer)
        if told is None:
            return None
        key = told.by_wire.get(wire, wire)  # one that it has not been told yet may be on its way
        if (local := self.offered.get(key)) is None:
            return None
        _, offer = self.judge_for(told, key, local)  # anew: after new rules the peer is told a little later
        return key if offer is not None and wire_of(offer) == wire else None

    def decision(self, peer: int, key: KeyT) -> PolicyDecision | PermissionDecision | None:
        """Whether an entry may cross to a peer, and the rule that decides; ``None``: the graph has no such entry."""
        local, told = self.seen.get(key), self.peers.get(peer)
        if local is None:
            return None
        decision = self.judge(key, local)
        if not decision.allowed or told is None:
            return decision
        special, _ = self.judge_for(told, key, local)
        return special if special.rule or not special.allowed else decision

    @property
    def pending(self) -> bool:
        """Whether a peer was not told everything yet; ``advertise`` does it."""
        return any(told.due for told in self.peers.values())

    def advertise(self, now: float = 0.0, busy: Callable[[int], bool] = lambda _: False) -> Iterator[int]:
        """Tell peers the next portions, one peer with each item, until ``limits.ADVERTISED_AT_ONCE`` are examined.

        Commands share the lane with advertisements, and must not wait until a whole catalogue was sent. So a portion
        waits while the lane is busy, but no longer than ``limits.TELL_PATIENCE`` after the one before.

        Args:
            now: Monotonic seconds.
            busy: ``(peer)``: whether a portion would have to wait on the peer's lane.
        """
        left = limits.ADVERTISED_AT_ONCE
        for peer, told in tuple(self.peers.items()):
            if not told.due or self.peers.get(peer) is not told:
                continue
            if now < told.told_at + limits.TELL_PATIENCE and busy(peer):
                continue
            if left <= 0:
                return
            left -= len(told.due)
            told.told_at = now
            self.peers[peer] = self.peers.pop(peer)
            self._portion(peer, told)
            yield peer

    def _portion(self, peer: int, told: Told[KeyT, LocalT, OfferT, RouteT]) -> None:
        added: list[OfferT] = []
        removed: list[KeyT] = []
        for key in tuple(islice(told.due, limits.ADVERTISED_AT_ONCE)):
            del told.due[key]
            local, before = self.offered.get(key), told.offers.get(key)
            decision, offer = self.judge_for(told, key, local) if local is not None else (None, None)
            if isinstance(decision, PermissionDecision) and self.reports:
                self._out.context.gate.refused(self.access, told.session.name, self.name_of(key), decision)
            if before is not None and (offer is None or wire_of(offer) != wire_of(before[0])):
                wire = wire_of(before[0])
                del told.offers[key], told.by_wire[wire]
                told.due |= dict.fromkeys(told.behind.pop(wire, ()))
                removed.append(wire)
                self._ended_for(peer, key)
                before = None
            if offer is None or local is None:
                continue
            if before is not None and before == (offer, local if self.renews else before[1]):
                continue
            holder = told.by_wire.setdefault(wire_of(offer), key)
            if holder != key:
                told.behind.setdefault(wire_of(offer), []).append(key)
                name, other = self.name_of(wire_of(offer)), self.name_of(holder)
                text = f"{key} would be {name} at {told.session.name}, as {other} is already: rename one"
                self._out.warn("names.taken", f"{peer} {key}", text)
                continue
            told.offers[key] = (offer, local)
            added.append(offer)
        full, more = not told.begun, not told.whole and bool(told.due)
        if added or removed or full or (not told.whole and not more):
            self._out.send(peer, self.message(tuple(added), tuple(removed), full, more))
        told.begun, told.whole = True, not more

    def _asked_in_vain(self, peer: int, wire: str) -> None:
        """Report what a peer asks for without permission; it is answered as if there were none."""
        told, context = self.peers.get(peer), self._out.context
        if told is not None and context.gate.on:
            name = told.session.name
            context.gate.admits(self.access, name, next(iter(context.names.of(name).locals_of(wire)), wire))


class TopicBook(OfferBook[Source, LocalT, OfferT, RouteT]):
    """Of what nodes have to do with topics.

    Attributes:
        any_type: Whether ``*``, which stands for any type, crosses.
        topics: The topics of ``seen``, with the nodes of each.
    """

    kind = "topics"
    any_type: ClassVar[bool] = False

    def __init__(self, out: Effects) -> None:
        super().__init__(out)
        self.topics: dict[str, tuple[str, ...]] = {}

    def look(self, topic: str, local: Mapping[str, LocalT]) -> None:
        """Take what the nodes of a topic have to do with it now, by node; see ``put``."""
        sources = [Source(topic, node) for node in dict.fromkeys((*self.topics.pop(topic, ()), *local))]
        for source in sources:
            if source.node in local or not self._leaves(source):
                self.put(source, local.get(source.node))
        if nodes := tuple(source.node for source in sources if source in self.seen):
            self.topics[topic] = nodes

    def _leaves(self, key: Source) -> bool:  # noqa: ARG002 - for those that override it
        """Whether something is still to come of what the graph does not have any more: it is looked at again then."""
        return False

    def judge(self, key: Source, local: LocalT) -> PolicyDecision:
        """Decide whether an entry may cross at all."""
        kind = local.type or ""
        typed = is_crossing_type(kind) or (self.any_type and kind == ANY)
        if not (typed and is_crossing_name(key.topic) and is_crossing_name(key.node)):
            return PolicyDecision(False, f"no peer takes the type {kind!r}, or the name of the topic or node")
        node = key.node if local.origin is None else local.origin.node
        return self._out.context.policy.judge(key.topic, kind, node)

    def name_of(self, key: Source) -> str:
        """The topic."""
        return key.topic
