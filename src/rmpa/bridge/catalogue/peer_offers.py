"""What one peer offers, as far as it is taken: within limits, and confirmed over the present link. Pure."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Generic, TypeVar

from rmpa.bridge import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.bridge.catalogue.peer_limits import NodePlaces

EntryT = TypeVar("EntryT")
OfferT = TypeVar("OfferT")
WireT = TypeVar("WireT")


@dataclass(frozen=True, slots=True)
class Change(Generic[OfferT, WireT]):
    """A portion of an advertisement, small enough to be applied in one turn of the event loop.

    Args:
        added: New or changed offers.
        removed: Names on the wire that are no longer offered.
    """

    added: tuple[OfferT, ...] = ()
    removed: tuple[WireT, ...] = ()


@dataclass(slots=True, kw_only=True)
class PeerOffers(Generic[WireT, EntryT, OfferT]):
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
    nodes: NodePlaces[WireT]
    entries: dict[WireT, EntryT] = field(default_factory=dict)
    refused: OrderedDict[WireT, OfferT] = field(default_factory=OrderedDict)
    doubtful: set[WireT] = field(default_factory=set)
    away: bool = False

    def changes(
        self,
        added: tuple[OfferT, ...],
        removed: tuple[WireT, ...],
        wire: Callable[[OfferT], WireT],
        *,
        full: bool,
        more: bool,
    ) -> Iterator[Change[OfferT, WireT]]:
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

    def refuse(self, wire: WireT, offer: OfferT) -> None:
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
