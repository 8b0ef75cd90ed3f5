"""What this module offers its peers, and what each of them was told of it. Pure.

The entries of a catalogue are the topics or services of the local graph that may cross. What peers are to be told is
gathered for each of them, and told a bounded number of entries at a time, so a change costs what changed, however
large the graph is.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Generic, TypeVar

from rmpa.bridge import limits
from rmpa.bridge.actions import Warn
from rmpa.bridge.catalogue.peer_limits import Beyond

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator, Mapping

KeyT = TypeVar("KeyT")
LocalT = TypeVar("LocalT")
OfferT = TypeVar("OfferT")
WireT = TypeVar("WireT", bound="Hashable")


@dataclass(slots=True)
class CataloguePeer(Generic[KeyT, LocalT, OfferT, WireT]):
    """One linked peer.

    Args:
        name: The peer's name, which its rules go by.
        instance: The peer's run, as 32 hexadecimal digits; nothing that came from there is relayed back to it.
        judged: Whether each entry is judged or renamed for it, which takes long: one such peer is told at a time.
        news: Entries that it is perhaps to be told of (a dict, for its order).
        told: Those that it knows: what it was told, and of which local entry.
        by_wire: The same by the names that it knows them by.
        behind: Entries whose name on the wire another one has, by that name.
        beginning: Whether it was not told everything once yet.
    """

    name: str
    instance: str
    judged: bool
    news: dict[KeyT, None]
    told: dict[KeyT, tuple[OfferT, LocalT]] = field(default_factory=dict)
    by_wire: dict[WireT, KeyT] = field(default_factory=dict)
    behind: dict[WireT, list[KeyT]] = field(default_factory=dict)
    beginning: bool = True


@dataclass(slots=True)
class Portion(Generic[KeyT, OfferT, WireT]):
    """What one peer is to be told now.

    Args:
        added: New offers, or offers once more.
        removed: Names on the wire that are offered no more.
        more: Whether the first complete account goes on with the next portion.
        complete: Whether it ends with this one.
        ended: Entries that the peer may not have any more, or has by another name.
        taken: Entries that are not told because another one has their name: their offer, and that one.
    """

    added: list[OfferT] = field(default_factory=list)
    removed: list[WireT] = field(default_factory=list)
    more: bool = False
    complete: bool = False
    ended: list[KeyT] = field(default_factory=list)
    taken: list[tuple[KeyT, OfferT, KeyT]] = field(default_factory=list)

    @property
    def is_news(self) -> bool:
        """Whether there is anything to send."""
        return bool(self.added or self.removed or self.complete)


class OfferCatalogue(Generic[KeyT, LocalT, OfferT, WireT]):
    """The entries that are offered, within a limit, and the portions in which peers are told of them.

    Args:
        kind: The setting that limits it: ``topics`` or ``services``.
        limit: How many entries are offered.
        offer: ``(peer, key, local)``: what a peer is to be told of an entry; ``None``: it may not know it.
        wire: The name on the wire of an offer.
        renewed: ``(before, now)``: whether an entry is told once more though its offer has not changed.
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
        self._offered: dict[KeyT, LocalT] = {}
        self._beyond: OrderedDict[KeyT, LocalT] = OrderedDict()
        self._peers: dict[int, CataloguePeer[KeyT, LocalT, OfferT, WireT]] = {}

    # --- entries -----------------------------------------------------------------------------------------------

    @property
    def offered(self) -> Mapping[KeyT, LocalT]:
        """The entries that peers are told of."""
        return self._offered

    @property
    def beyond(self) -> Beyond:
        """How many entries are offered to no peer because there are too many."""
        return Beyond(self._kind, self.limit, len(self._beyond))

    def is_beyond(self, key: KeyT) -> bool:
        """Whether an entry is one of these."""
        return key in self._beyond

    def put(self, key: KeyT, local: LocalT) -> bool:
        """Offer an entry, or a changed one; return whether there was room for it."""
        if key not in self._offered and len(self._offered) >= self.limit:
            self._beyond[key] = local
            return False
        self._beyond.pop(key, None)
        self._offered[key] = local
        return True

    def warning(self, what: str) -> Warn:
        """What the user is told when there was no room; ``what`` names the count."""
        text = (
            f"this module has more {self._kind} than limits.{self._kind} = {self.limit}; the rest is offered to no "
            "peer: raise it in rmpa.toml and `rmpa reload`, or deny some"
        )
        return Warn(what, "local", text)

    def remove(self, key: KeyT) -> bool:
        """Offer an entry no more; return whether it was offered, and not only beyond the limit."""
        self._beyond.pop(key, None)
        return self._offered.pop(key, None) is not None

    def next_beyond(self) -> tuple[KeyT, LocalT] | None:
        """The entry beyond the limit that waits for longest, which waits no longer; ``None``: there is no room."""
        return self._beyond.popitem(last=False) if self._beyond and len(self._offered) < self.limit else None

    # --- peers -------------------------------------------------------------------------------------------------

    def link_up(self, peer: int, name: str, instance: str, *, judged: bool) -> Portion[KeyT, OfferT, WireT]:
        """A link is up: return the first portion of all there is; ``portions`` goes on with it."""
        self._peers[peer] = CataloguePeer(name, instance, judged, dict.fromkeys(self._offered))
        return self._portion(self._peers[peer])

    def link_down(self, peer: int) -> None:
        """A link is gone."""
        self._peers.pop(peer, None)

    def peer(self, peer: int) -> CataloguePeer[KeyT, LocalT, OfferT, WireT] | None:
        """What is known of a linked peer."""
        return self._peers.get(peer)

    def peers(self) -> Iterator[CataloguePeer[KeyT, LocalT, OfferT, WireT]]:
        """The linked peers."""
        return iter(self._peers.values())

    def told(self, peer: int, key: KeyT) -> OfferT | None:
        """What a peer was told of an entry, by the name that it has over there."""
        known = self._peers.get(peer)
        return known.told[key][0] if known is not None and key in known.told else None

    def note(self, key: KeyT) -> None:
        """An entry has changed: peers are perhaps to be told."""
        for known in self._peers.values():
            known.news.setdefault(key)

    def note_all(self, known: CataloguePeer[KeyT, LocalT, OfferT, WireT]) -> None:
        """The rules for a peer have changed."""
        known.news.update(dict.fromkeys(self._offered))

    @property
    def pending(self) -> bool:
        """Whether there is something to tell."""
        return any(known.news for known in self._peers.values())

    def beginning(self, peer: int) -> bool:
        """Whether a peer has not been told everything once since its link is up."""
        return known.beginning if (known := self._peers.get(peer)) is not None else False

    def portions(self, ready: Callable[[int], bool]) -> Iterator[tuple[int, Portion[KeyT, OfferT, WireT]]]:
        """The next portion for each peer that is to be told something and is ready.

        Of the peers for which each entry is judged only one is told, in turn: the loop must not wait for all.
        """
        judged = False
        for number, known in list(self._peers.items()):
            if not known.news or (known.judged and judged) or not ready(number):
                continue
            if known.judged:
                judged = True
                self._peers[number] = self._peers.pop(number)
            yield number, self._portion(known)

    def _portion(self, known: CataloguePeer[KeyT, LocalT, OfferT, WireT]) -> Portion[KeyT, OfferT, WireT]:
        portion: Portion[KeyT, OfferT, WireT] = Portion()
        for key in tuple(islice(known.news, limits.ADVERTISED_AT_ONCE)):
            del known.news[key]
            local = self._offered.get(key)
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
        portion.more = known.beginning and bool(known.news)
        portion.complete = known.beginning and not portion.more
        known.beginning = portion.more
        return portion
