"""What one peer offers, as far as it is taken: within limits, and confirmed over the present link. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Generic, TypeVar

from rmpa.bridge import limits
from rmpa.bridge.catalogue.peer_limits import Beyond, NodePlaces, Surplus

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

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
        nodes: Which of its nodes have a place in the local graph, and what waits for one. The owner decides whether
            the things in it go by their names on the wire or by their local names.
        entries: The offers that are taken, by name on the wire.
        surplus: The offers beyond the limit.
        doubtful: Names on the wire that were offered over the last link and are not confirmed over the present one.
        away: Whether the peer has no link but may come back.
    """

    name: str
    nodes: NodePlaces[WireT]
    entries: dict[WireT, EntryT] = field(default_factory=dict)
    surplus: Surplus[OfferT] = field(default_factory=lambda: Surplus(limits.SURPLUS_MAX))
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
            self.surplus.clear()
        self.doubtful.difference_update(map(wire, added))
        if self.doubtful and not more:
            removed += tuple(sorted(self.doubtful))  # type: ignore[type-var] # names are in order
            self.doubtful = set()
        step = limits.APPLIED_AT_ONCE
        for begin in range(0, len(removed), step):
            yield Change(removed=removed[begin : begin + step])
        for begin in range(0, len(added), step):
            yield Change(added=added[begin : begin + step])

    def admitted(self, limit: int) -> OfferT | None:
        """Take the offer in surplus that has waited longest.

        Returns:
            The offer; ``None`` if none waits, or ``limit`` entries are taken already.
        """
        return self.surplus.pop() if len(self.entries) < limit else None

    def beyond(self, kind: str, limit: int) -> Beyond:
        """How many offers are not taken because there are too many."""
        return Beyond(kind, limit, len(self.surplus))

    def give_up(self) -> None:
        """Drop all that waits for a place: the peer does not come back soon."""
        self.nodes.give_up()
        self.surplus.clear()
