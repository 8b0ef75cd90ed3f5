"""Versions and digests of what modules offer, by which peers notice that their copy is out of date, or wrong.

Each agent counts the changes of what it offers. It tells a linked peer the version of the catalogue that the peer
now has completely, with the digests of its topics and services (notification ``offers``); the failure detector
spreads the present version to all members. A module that holds an older version of a parked peer links with it after
a random delay, and gets the catalogue again. A module whose copy has other digests asks for it again
(``offers.again``); one whose copy is right says so in the hello of the next link, and is not sent the same once more.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.catalogue.digest import HeldOffers, digest_text, parse_digest
from rmpa.bridge.permission_gate import Needs
from rmpa.bridge.session.offer_copies import OfferCopies
from rmpa.bridge.session.peer_session import PeerState
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.sizes import UINT32_MAX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.session.offer_copies import SharedCatalogue
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.core.counters import RefusalLog
    from rmpa.core.guid import Guid

OFFERS: Final = "offers"
"""The notification that all of ``version`` was advertised before it; to a peer that compares, with both digests."""
OFFERS_AGAIN: Final = "offers.again"
"""The notification that the sender's copy of the receiver's offers is wrong: they are to be advertised again."""
KINDS: Final = ("topics", "services")
"""The digests of such a notification, in the order of the catalogues."""
DIFFERED: Final = "offers.differed"
"""Counts copies of peers' offers that were not what the peer had told."""
SENT_AGAIN: Final = "offers.sent_again"
"""Counts the times that this module's offers were sent again because a peer's copy of them was wrong."""


class OfferVersions:
    """The version of this module's offers, and those that it has of its peers.

    Args:
        sessions: Returns the sessions of all peers.
        want: Has a parked peer linked again.
        rng: Uniform numbers in [0, 1).
    """

    def __init__(
        self,
        sessions: Callable[[], Iterable[PeerSession]],
        want: Callable[[PeerSession], None],
        rng: Callable[[], float],
    ) -> None:
        self._sessions = sessions
        self._want = want
        self._rng = rng
        self._rpc: PeerRpc | None = None
        self._refusals: RefusalLog | None = None
        self._catalogues: list[SharedCatalogue] = []
        self._copies = OfferCopies(self._catalogues, self._fetch, self._differs)
        self.instance = b""
        """The instance id of this run, by which peers' hellos name it."""
        self._due: dict[int, asyncio.TimerHandle] = {}
        self._spread = 0
        self.on_version: Callable[[int], None] = lambda _: None
        """Called with a new version of this module's offers, to spread it."""

    def add(self, catalogue: SharedCatalogue) -> None:
        """Take a catalogue into account: that of topics first, then that of services."""
        self._catalogues.append(catalogue)

    def listen(self, rpc: PeerRpc, refusals: RefusalLog) -> None:
        """Exchange versions with the peers over their links; copies that differ are logged and counted."""
        self._rpc, self._refusals = rpc, refusals
        rpc.on_notification(OFFERS, self._told, Needs((), "the version of the peer's own catalogue"))
        rpc.on_notification(OFFERS_AGAIN, self._asked_again, Needs((), "what is offered to the peer anyway"))

    @property
    def version(self) -> int:
        """The version of what this module offers now, 32 bits; it begins at 1 in each run."""
        return min(1 + sum(each.changes for each in self._catalogues), UINT32_MAX)

    def changed(self) -> None:
        """Spread the version of this module's offers, if it is a new one."""
        if (version := self.version) != self._spread:
            self._spread = version
            self.on_version(version)

    def settled(self, may_park: Callable[[PeerSession], bool]) -> None:
        """Tell linked peers the version that they now have completely, and compare what is held of theirs.

        Args:
            may_park: Whether the link to a peer may be parked: only then a peer of an earlier release needs to know.
        """
        self.changed()
        self._copies.compare()
        if self._rpc is None or any(each.pending for each in self._catalogues):
            return
        version = self.version
        for session in self._sessions():
            if session.linked and session.offers_told != version and (session.compares or may_park(session)):
                digests = [each.told_digest(session) for each in self._catalogues] if session.compares else []
                session.offers_told = version
                self._rpc.notify(session, OFFERS, {"version": version, **_in_message(digests)})

    def is_known(self, session: PeerSession) -> bool:
        """Whether both sides of a link have each other's catalogue completely."""
        return session.offers_held is not None and session.offers_told == self.version

    def link_up(self, session: PeerSession, *, compares: bool = False, held: bytes = b"") -> None:
        """A link begins: both catalogues are told again over it, unless they are held.

        Args:
            session: The peer.
            compares: Whether the peer compares catalogues by their digests.
            held: What the peer's hello says that it holds of this module's offers.
        """
        session.offers_told = None
        session.compares = compares
        known = HeldOffers.parse(held)
        right = known is not None and known.is_of(self.instance) and known.version == self.version
        session.held_there = known if right else None
        self._copies.advertised(session)
        self._forget(session.peer)

    def held(self, guid: Guid) -> bytes:
        """What this module's hello to a peer says that it holds of the peer's offers; empty if it cannot be sure."""
        session = self._session(guid)
        held = self._copies.held(session) if session is not None else None
        return held.serialize() if held is not None else b""

    def advertised(self, session: PeerSession) -> None:
        """An advertisement of a peer has come."""
        self._copies.advertised(session)

    def heard(self, guid: Guid, instance: bytes, version: int, members: int) -> None:
        """Take in the present version of a peer; a parked one whose offers have changed is linked after a while.

        Args:
            guid: The peer.
            instance: Its run.
            version: What it offers now.
            members: The number of modules, which may all do the same: they spread over a time that grows with it.
        """
        session = self._session(guid)
        if session is None or session.link.identity.instance != instance:
            return
        session.offers_heard = max(session.offers_heard, version)
        if session.state is PeerState.PARKED and self._is_old(session) and session.peer not in self._due:
            delay = self._rng() * min(members / limits.REFRESH_RATE, limits.REFRESH_MAX)
            self._due[session.peer] = asyncio.get_running_loop().call_later(delay, self._refresh, session)

    def parked(self, session: PeerSession, members: int = 1) -> None:
        """A link was parked: news of the peer may have come before."""
        self.heard(session.link.guid, session.link.identity.instance, session.offers_heard, members)

    def gone(self, session: PeerSession) -> None:
        """Forget a peer."""
        self._copies.forget(session)
        self._forget(session.peer)

    def close(self) -> None:
        """Stop all timers."""
        for handle in self._due.values():
            handle.cancel()
        self._due.clear()

    def _refresh(self, session: PeerSession) -> None:
        self._due.pop(session.peer, None)
        if self._is_old(session):
            self._want(session)

    def _is_old(self, session: PeerSession) -> bool:
        return session.offers_held is None or session.offers_held < session.offers_heard

    def _forget(self, peer: int) -> None:
        handle = self._due.pop(peer, None)
        if handle is not None:
            handle.cancel()

    def _session(self, guid: Guid) -> PeerSession | None:
        return next((one for one in self._sessions() if one.link.guid == guid), None)

    def _told(self, session: PeerSession, args: dict[str, Any]) -> None:
        version = args.get("version")
        if not isinstance(version, int) or not 0 < version <= UINT32_MAX:
            raise RemoteProtocolError(f"the version of a catalogue is {version!r}")
        texts = [args[kind] for kind in KINDS if kind in args]
        digests = [parse_digest(text) for text in texts]
        if None in digests:
            raise RemoteProtocolError(f"the digests of a catalogue are {texts!r}"[: limits.CONTROL_TEXT_MAX])
        # The peer itself says what it offers now. A higher version that others spread was forged, or comes over the
        # link too before the peer parks it; kept, it would have the link made again for as long as both run.
        session.offers_held = session.offers_heard = version
        match digests:
            case [int(topics), int(services)]:
                self._copies.said(session, topics, services)

    # --- copies that differ --------------------------------------------------------------------------------------

    def _differs(self, session: PeerSession) -> None:
        if self._refusals is not None:
            name, version = session.link.name, session.offers_held
            text = (
                f"the topics and services of {name} differ here from what it told as version {version}: they are "
                "fetched again; if this comes often, report it with both releases (`rmpa --version`)"
            )
            self._refusals.refuse(asyncio.get_running_loop().time(), DIFFERED, name, text)

    def _fetch(self, session: PeerSession) -> None:
        if not session.linked:
            self._want(session)
        elif self._rpc is not None:
            self._rpc.notify(session, OFFERS_AGAIN, {"version": session.offers_held})

    def _asked_again(self, session: PeerSession, _args: dict[str, Any]) -> None:
        now = asyncio.get_running_loop().time()
        if not session.linked or now - session.copy.sent_again < limits.REFETCH_PAUSE:
            return
        session.copy.sent_again = now
        if self._refusals is not None:
            self._refusals.count(SENT_AGAIN)
        for each in self._catalogues:
            each.tell_again(session)
        session.offers_told = None


def _in_message(digests: list[int | None]) -> dict[str, str]:
    """The digests as arguments of a message; none while one of them is not known."""
    known = [digest_text(digest) for digest in digests if digest is not None]
    return dict(zip(KINDS, known, strict=True)) if len(known) == len(KINDS) else {}
