"""Compares this module's copy of each peer's offers with what the peer said that it told, and has it fetched again.

TCP loses nothing, so a copy differs only after an error of one side: an advertisement that was left out or wrongly
applied. A copy is compared once after each change, and then again in turn, a few entries at a time, so that an error
that comes later is found too. Nothing is sent for that.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from itertools import islice
from typing import TYPE_CHECKING, Protocol

from rmpa.bridge import limits
from rmpa.bridge.catalogue.digest import HeldOffers, digest_of
from rmpa.bridge.session.peer_session import PeerState
from rmpa.runtime.event_loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from rmpa.bridge.session.peer_session import PeerSession


class SharedCatalogue(Protocol):
    """A kind of what modules offer each other, topics or services: what this module offers, and what peers do."""

    @property
    def changes(self) -> int:
        """The number of changes of what this module offers so far."""
        ...

    @property
    def pending(self) -> bool:
        """Whether a linked peer has not been sent all changes."""
        ...

    def told_digest(self, session: PeerSession) -> int | None:
        """The digest of what a linked peer was told; ``None`` while it was not told all."""
        ...

    def held_offers(self, session: PeerSession) -> Sequence[object] | None:
        """What a peer offers, as it was received; ``None`` if not all of it was kept."""
        ...

    def waits(self, session: PeerSession) -> bool:
        """Whether an advertisement of a peer has come and is not applied yet."""
        ...

    def tell_again(self, session: PeerSession) -> None:
        """Begin to send a linked peer the complete catalogue once more."""
        ...


class OfferCopies:
    """This module's copies of its peers' offers.

    Args:
        catalogues: Topics and services, in this order.
        fetch: Has the peer send its catalogues again.
        on_differs: Called with a peer whose offers differ here from what it said that it told.
    """

    def __init__(
        self,
        catalogues: Sequence[SharedCatalogue],
        fetch: Callable[[PeerSession], None],
        on_differs: Callable[[PeerSession], None],
    ) -> None:
        self._catalogues = catalogues
        self._fetch = fetch
        self._on_differs = on_differs
        self._due: dict[int, PeerSession] = {}
        self._right: OrderedDict[int, PeerSession] = OrderedDict()

    def said(self, session: PeerSession, topics: int, services: int) -> None:
        """Take in the digests of what a peer has told completely."""
        session.copy.said = (topics, services)
        session.copy.right = None
        self._due[session.peer] = session
        self._right.pop(session.peer, None)

    def advertised(self, session: PeerSession) -> None:
        """An advertisement has come: the digests that the peer said before are no longer those of its offers."""
        if session.copy.right:
            session.copy.right = None
        self.forget(session)

    def forget(self, session: PeerSession) -> None:
        """Compare the copy of a peer no more, until the peer says digests again."""
        session.copy.said = None
        self._due.pop(session.peer, None)
        self._right.pop(session.peer, None)

    def held(self, session: PeerSession) -> HeldOffers | None:
        """What the hello to a peer says of its offers: its copy here, if that was compared and is right."""
        copy = session.copy
        if session.state is PeerState.AWAY or not copy.right or copy.said is None or session.offers_held is None:
            return None
        return HeldOffers.of(session.link.identity.instance, session.offers_held, *copy.said)

    def compare(self) -> None:
        """Compare the copies that are new, and some of those that were right, with what the peers said."""
        now = asyncio.get_running_loop().time()
        fetched = 0
        for session in list(self._due.values()):
            if fetched < limits.REFETCHED_AT_ONCE:
                fetched += self._compare(session, now)
        audited = 0
        for session in list(islice(self._right.values(), limits.AUDITED_AT_ONCE)):
            if session.peer in self._right and audited < limits.AUDITED_AT_ONCE:
                self._right.move_to_end(session.peer)
                audited += 1 + sum(len(each.held_offers(session) or ()) for each in self._catalogues)
                self._compare(session, now)

    def _compare(self, session: PeerSession, now: float) -> bool:
        """Compares one copy; returns whether it is fetched again."""
        copy, said = session.copy, session.copy.said
        settled = session.state in (PeerState.LINKED, PeerState.PARKED)
        if not settled or now < copy.due or any(each.waits(session) for each in self._catalogues):
            return False
        held = tuple(_digest(each.held_offers(session)) for each in self._catalogues)
        if copy.said is not said:
            return False  # the peer told something new while data went first
        self._due.pop(session.peer, None)
        if None in held:
            return False
        copy.right = held == said
        if copy.right:
            copy.in_a_row = 0
            self._right[session.peer] = session
            return False
        self._right.pop(session.peer, None)
        self._due[session.peer] = session
        copy.differed += 1
        copy.due = now + min(limits.REFETCH_PAUSE * 2**copy.in_a_row, limits.REFETCH_PAUSE_MAX)
        copy.in_a_row = min(copy.in_a_row + 1, 16)
        self._on_differs(session)
        self._fetch(session)
        return True


def _digest(offers: Iterable[object] | None) -> int | None:
    return digest_of(yielding_to_data(list(offers), every=64)) if offers is not None else None
