"""What this module offers to its peers, and what each of them has been sent of it. Pure.

The entries of a catalogue are the topics or services of the local graph that may cross. Changes are gathered for each
peer and sent a bounded number of entries at a time, so the work depends on the size of a change and not on that of
the graph.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Generic, TypeVar

from rmpa.bridge import limits
from rmpa.bridge.actions import Warn

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator

KeyT = TypeVar("KeyT")
LocalT = TypeVar("LocalT")
OfferT = TypeVar("OfferT")
WireT = TypeVar("WireT", bound="Hashable")


@dataclass(slots=True)
class CataloguePeer(Generic[KeyT, LocalT, OfferT, WireT]):
    """One linked peer, and what it has been sent.

    Args:
        name: The peer's name, by which the rules for it are found.
        instance: The peer's run, as 32 hexadecimal digits; nothing that came from this run is relayed back to it.
        judged: Whether each entry is judged or renamed for this peer. That takes long, so ``portions`` serves only
            one such peer at a time.
        news: Keys of the entries to examine for this peer; the entry may have changed (a dict, for its order).
        told: By key: the offer that the peer was sent, and the local entry that it was made of.
        by_wire: The keys of ``told``, by name on the wire.
        behind: By name on the wire: keys of entries that are not sent because an entry in ``by_wire`` has that name.
        beginning: Whether the peer has not been sent the complete catalogue yet.
        fresh: Whether the next portion is the first one of a complete catalogue.
    """

    name: str
    instance: str
    judged: bool
    news: dict[KeyT, None]
    told: dict[KeyT, tuple[OfferT, LocalT]] = field(default_factory=dict)
    by_wire: dict[WireT, KeyT] = field(default_factory=dict)
    behind: dict[WireT, list[KeyT]] = field(default_factory=dict)
    beginning: bool = True
    fresh: bool = True


@dataclass(slots=True)
class Portion(Generic[KeyT, OfferT, WireT]):
    """What one peer is to be sent now.

    Args:
        added: New or changed offers.
        removed: Names on the wire that are no longer offered.
        full: Whether the complete catalogue begins with this portion.
        more: Whether the complete catalogue goes on with the next portion.
        complete: Whether the complete catalogue ends with this portion.
        ended: Keys of entries that the peer may no longer have, or now has under another name.
        taken: Entries that are not sent because another entry has their name on the wire: key, offer, key of the
            other.
    """

    added: list[OfferT] = field(default_factory=list)
    removed: list[WireT] = field(default_factory=list)
    full: bool = False
    more: bool = False
    complete: bool = False
    ended: list[KeyT] = field(default_factory=list)
    taken: list[tuple[KeyT, OfferT, KeyT]] = field(default_factory=list)

    @property
    def is_news(self) -> bool:
        """Whether there is anything to send."""
        return bool(self.added or self.removed or self.full or self.complete)


class OfferCatalogue(Generic[KeyT, LocalT, OfferT, WireT]):
    """The entries that are offered, up to a limit, and the portions in which peers are sent them.

    Args:
        kind: The setting that limits the entries: ``topics`` or ``services``.
        limit: How many entries are offered.
        offer: ``(peer, key, local)``: the offer of an entry to this peer; ``None``: the peer may not know of it.
        wire: ``(offer)``: the offer's name on the wire.
        renewed: ``(before, now)``: whether a changed entry is sent again although its offer is the same.
    """

    def __init__(
        self,
        kind: str,
        limit: int,
        *,
        offer: Callable[[CataloguePeer[KeyT, LocalT, OfferT, WireT], KeyT, LocalT], OfferT | None],
        wire: Callable[[OfferT], WireT],
        renewed: Callable[[LocalT, LocalT], bool] = lambda _before, _now: False,
    ) -> None:
        self._kind = kind
        self.limit = limit
        self._offer = offer
        self._wire = wire
        self._renewed = renewed
        self.offered: dict[KeyT, LocalT] = {}
        """The entries within the limit, by key; which of them a peer is sent is decided by ``offer``."""
        self._beyond: OrderedDict[KeyT, LocalT] = OrderedDict()
        self._peers: dict[int, CataloguePeer[KeyT, LocalT, OfferT, WireT]] = {}
        self._with_news: dict[int, None] = {}
        """The peers that have, or had when last looked at, entries to examine."""

    # --- entries -----------------------------------------------------------------------------------------------

    @property
    def beyond(self) -> int:
        """The count of entries that are offered to no peer because there are more than the limit."""
        return len(self._beyond)

    def is_beyond(self, key: KeyT) -> bool:
        """Whether an entry is offered to no peer because the limit is reached."""
        return key in self._beyond

    def put(self, key: KeyT, local: LocalT) -> bool:
        """Offer an entry, or a changed one; return whether there was room for it.

        Without room the entry waits until ``next_beyond`` returns it. Peers are not notified: call ``note``.
        """
        if key not in self.offered and len(self.offered) >= self.limit:
            self._beyond[key] = local
            return False
        self._beyond.pop(key, None)
        self.offered[key] = local
        return True

    def warning(self, what: str) -> Warn:
        """The warning to the user that there was no room for an entry.

        Args:
            what: The name of the counter.
        """
        text = (
            f"this module has more {self._kind} than limits.{self._kind} = {self.limit}; the rest is offered to no "
            "peer: raise it in rmpa.toml and `rmpa reload`, or deny some"
        )
        return Warn(what, "local", text)

    def remove(self, key: KeyT) -> bool:
        """Offer an entry no more; return whether it was within the limit."""
        self._beyond.pop(key, None)
        return self.offered.pop(key, None) is not None

    def next_beyond(self) -> tuple[KeyT, LocalT] | None:
        """Take the entry beyond the limit that has waited longest; it waits no longer.

        Returns:
            Its key and value; ``None`` if none waits, or there is no room.
        """
        return self._beyond.popitem(last=False) if self._beyond and len(self.offered) < self.limit else None

    # --- peers -------------------------------------------------------------------------------------------------

    def link_up(self, peer: int, name: str, instance: str, *, judged: bool) -> Portion[KeyT, OfferT, WireT]:
        """Add a linked peer; return the first portion of the complete catalogue. ``portions`` yields the rest.

        Args:
            peer: The peer's number.
            name: The peer's name.
            instance: The peer's run, as 32 hexadecimal digits.
            judged: Whether each entry is judged or renamed for this peer.
        """
        self._peers[peer] = CataloguePeer(name, instance, judged, dict.fromkeys(self.offered))
        self._with_news[peer] = None
        return self._portion(self._peers[peer])

    def link_down(self, peer: int) -> None:
        """Forget a peer and what it has been sent."""
        self._peers.pop(peer, None)
        self._with_news.pop(peer, None)

    def peer(self, peer: int) -> CataloguePeer[KeyT, LocalT, OfferT, WireT] | None:
        """The state of a linked peer; ``None`` if it is not linked."""
        return self._peers.get(peer)

    def peers(self) -> Iterator[CataloguePeer[KeyT, LocalT, OfferT, WireT]]:
        """The linked peers."""
        return iter(self._peers.values())

    def told(self, peer: int, key: KeyT) -> OfferT | None:
        """The offer that a peer was last sent of an entry; ``None`` if it does not know the entry."""
        known = self._peers.get(peer)
        return known.told[key][0] if known is not None and key in known.told else None

    def note(self, key: KeyT) -> None:
        """Have an entry examined for every peer: it was put, changed or removed."""
        for number, known in self._peers.items():
            known.news.setdefault(key)
            self._with_news[number] = None

    def note_all(self, known: CataloguePeer[KeyT, LocalT, OfferT, WireT]) -> None:
        """Have all entries examined for one peer: its rules have changed."""
        known.news.update(dict.fromkeys(self.offered))
        self._with_news = dict.fromkeys(self._peers)

    @property
    def pending(self) -> bool:
        """Whether entries are to be examined for any peer; ``portions`` does it."""
        return any(self._peers[number].news for number in self._with_news)

    def portions(self, ready: Callable[[int], bool]) -> Iterator[tuple[int, Portion[KeyT, OfferT, WireT]]]:
        """Yield the number and next portion of each peer with entries to examine that is ready.

        Of the peers for which each entry is judged only one is served in a call, in turn, so that the event loop does
        not wait for all of them.

        Args:
            ready: ``(peer)``: whether a portion may be sent to this peer now.
        """
        judged = False
        for number in list(self._with_news):
            known = self._peers.get(number)
            if known is None or not known.news:
                self._with_news.pop(number, None)
                continue
            if (known.judged and judged) or not ready(number):
                continue
            if known.judged:
                judged = True
                del self._with_news[number]
                self._with_news[number] = None
            yield number, self._portion(known)

    def _portion(self, known: CataloguePeer[KeyT, LocalT, OfferT, WireT]) -> Portion[KeyT, OfferT, WireT]:
        portion = self._examined(known)
        portion.full, known.fresh = known.fresh, False
        portion.more = known.beginning and bool(known.news)
        portion.complete = known.beginning and not portion.more
        known.beginning = portion.more
        return portion

    def _examined(self, known: CataloguePeer[KeyT, LocalT, OfferT, WireT]) -> Portion[KeyT, OfferT, WireT]:
        """Examines entries for a peer; the portion has what it is to be sent of them."""
        portion: Portion[KeyT, OfferT, WireT] = Portion()
        for key in tuple(islice(known.news, limits.ADVERTISED_AT_ONCE)):
            del known.news[key]
            local = self.offered.get(key)
            offer = self._offer(known, key, local) if local is not None else None
            before = known.told.get(key)
            if before is not None and (offer is None or self._wire(offer) != self._wire(before[0])):
                wire = self._wire(before[0])
                del known.told[key], known.by_wire[wire]
                portion.removed.append(wire)
                portion.ended.append(key)
                known.news.update(dict.fromkeys(known.behind.pop(wire, ())))
                before = None
            if local is None or offer is None:
                continue
            if before is not None and offer == before[0] and not self._renewed(before[1], local):
                continue
            holder = known.by_wire.setdefault(self._wire(offer), key)
            if holder != key:
                known.behind.setdefault(self._wire(offer), []).append(key)
                portion.taken.append((key, offer, holder))
                continue
            known.told[key] = (offer, local)
            portion.added.append(offer)
        return portion


# Which nodes of one peer have a place in the local graph, within ``limits.nodes`` of this module.


_Thing = TypeVar("_Thing")


class NodePlaces(Generic[_Thing]):
    """The nodes of one peer that are in the local graph, and what is refused because its node is not.

    A node takes a place as long as one thing of it (a topic, a service) is shown. A lower limit ends nothing that is
    shown: it holds for the nodes that come.

    Args:
        limit: How many places there are.
    """

    __slots__ = ("_shown", "limit", "refused")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._shown: Counter[str] = Counter()
        # Ordered: taking the first item of a plain dict passes over all that were taken before it.
        self.refused: OrderedDict[str, dict[_Thing, None]] = OrderedDict()
        """The nodes without a place, and the things of each."""

    def free(self, node: str) -> bool:
        """Whether a node may show a thing: it has a place, or a place is free."""
        return node in self._shown or len(self._shown) < self.limit

    def refuse(self, node: str, thing: _Thing) -> None:
        """Note that a thing is hidden because its node has no place."""
        self.refused.setdefault(node, {})[thing] = None

    def leave(self, node: str, thing: _Thing) -> None:
        """Note that a thing is shown, hidden for another reason, or gone."""
        things = self.refused.get(node)
        if things is not None:
            things.pop(thing, None)
            if not things:
                del self.refused[node]

    def show(self, node: str) -> None:
        """Count one more thing of a node that is shown."""
        self._shown[node] += 1

    def hide(self, node: str) -> None:
        """Count one thing less of a node that is shown; the last one frees the node's place."""
        self._shown[node] -= 1
        if not self._shown[node]:
            del self._shown[node]

    def admitted(self) -> Iterator[tuple[_Thing, ...]]:
        """Yield the things that may be shown now, one node's at a time, the first refused one first.

        The caller shows the things before it asks for the next node, or the place still counts as free.
        """
        while self.refused and self.free(next(iter(self.refused))):
            yield tuple(self.refused.popitem(last=False)[1])

    def give_up(self) -> None:
        """Forget what is refused: the peer is away."""
        self.refused.clear()


def warning(peer: str, kind: str, limit: int) -> str:
    """The text of the log when a peer first exceeds a limit."""
    return (
        f"{peer} has more than limits.{kind} = {limit} of this module; the rest is refused until there is room: "
        f"raise it in rmpa.toml and `rmpa reload`, or deny some; `rmpa peer info {peer}` counts them"
    )


# What one peer offers, as far as it is taken: within limits, and confirmed over the present link. Pure.


EntryT = TypeVar("EntryT")

HeardT = TypeVar("HeardT")


@dataclass(frozen=True, slots=True)
class Change(Generic[OfferT, HeardT]):
    """A portion of an advertisement, small enough to be applied in one turn of the event loop.

    Args:
        added: New or changed offers.
        removed: Names on the wire that are no longer offered.
    """

    added: tuple[OfferT, ...] = ()
    removed: tuple[HeardT, ...] = ()


@dataclass(slots=True, kw_only=True)
class PeerOffers(Generic[HeardT, EntryT, OfferT]):
    """The offers of one run of a peer.

    Args:
        name: The peer's name.
        nodes: Which of its nodes have a place in the local graph, and what is refused for want of one. The owner
            decides whether the things in it go by their names on the wire or by their local names.
        entries: The offers that are taken, by name on the wire.
        refused: The offers beyond the limit, at most ``limits.REFUSED_MAX``; further ones come with its next link.
        doubtful: Names on the wire that were offered over the last link and are not confirmed over the present one.
        away: Whether the peer has no link but may come back.
    """

    name: str
    nodes: NodePlaces[HeardT]
    entries: dict[HeardT, EntryT] = field(default_factory=dict)
    refused: OrderedDict[HeardT, OfferT] = field(default_factory=OrderedDict)
    doubtful: set[HeardT] = field(default_factory=set)
    away: bool = False

    def changes(
        self,
        added: tuple[OfferT, ...],
        removed: tuple[HeardT, ...],
        wire: Callable[[OfferT], HeardT],
        *,
        full: bool,
        more: bool,
    ) -> Iterator[Change[OfferT, HeardT]]:
        """Split an advertisement into portions; removals go first.

        Args:
            added: The offers that the advertisement adds.
            removed: The names on the wire that it removes.
            wire: ``(offer)``: the offer's name on the wire.
            full: Whether it begins a complete catalogue: entries that the catalogue does not contain are removed at
                its end.
            more: Whether the complete catalogue goes on with the next advertisement.
        """
        if full:
            self.doubtful = set(self.entries)
            self.refused.clear()
        self.doubtful.difference_update(map(wire, added))
        if self.doubtful and not more:
            removed += tuple(sorted(self.doubtful))  # type: ignore[type-var] # names are in order
            self.doubtful = set()
        step = limits.APPLIED_AT_ONCE
        for begin in range(0, len(removed), step):
            yield Change(removed=removed[begin : begin + step])
        for begin in range(0, len(added), step):
            yield Change(added=added[begin : begin + step])

    def refuse(self, wire: HeardT, offer: OfferT) -> None:
        """Remember an offer beyond the limit."""
        if wire in self.refused or len(self.refused) < limits.REFUSED_MAX:
            self.refused[wire] = offer

    def admitted(self, limit: int) -> OfferT | None:
        """Take the first refused offer; ``None`` if there is none, or ``limit`` entries are taken already."""
        return self.refused.popitem(last=False)[1] if self.refused and len(self.entries) < limit else None

    def give_up(self) -> None:
        """Forget all that is refused: the peer does not come back soon."""
        self.nodes.give_up()
        self.refused.clear()
