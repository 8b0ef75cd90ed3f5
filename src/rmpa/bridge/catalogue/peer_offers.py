"""What one peer offers, as far as it is taken: within limits, and confirmed over its present link. Pure."""

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
    """A portion of an advertisement, small enough to be dealt with at once.

    Args:
        added: What is offered.
        removed: Names on the wire of what is offered no more.
    """

    added: tuple[OfferT, ...] = ()
    removed: tuple[WireT, ...] = ()


@dataclass(slots=True, kw_only=True)
class PeerOffers(Generic[WireT, EntryT, OfferT]):
    """The offers of one run of a peer.

    Args:
        name: The peer's name.
        nodes: Which of its nodes stand here, and what waits for a place; what it names there is up to its owner.
        entries: What is taken of its offers, by the name on the wire.
        surplus: Its offers beyond the limit.
        doubtful: What it offered over its last link and has not offered again since.
        away: Whether it has no link, and may come back.
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
        """Split an advertisement into portions; what is offered no more goes first.

        Args:
            added: What it offers.
            removed: What it offers no more.
            wire: The name on the wire of an offer.
            full: Whether it begins a complete account: what that does not mention is offered no more.
            more: Whether the account goes on with the next advertisement.
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
        """The offer beyond the limit that waits for longest, if there is room now; the caller takes it."""
        return self.surplus.pop() if len(self.entries) < limit else None

    def beyond(self, kind: str, limit: int) -> Beyond:
        """How many offers are not taken because there are too many."""
        return Beyond(kind, limit, len(self.surplus))

    def give_up(self) -> None:
        """The peer does not come back soon: nothing of it waits for a place any more."""
        self.nodes.give_up()
        self.surplus.clear()
