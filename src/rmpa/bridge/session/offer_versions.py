"""Versions of what modules offer, by which peers notice that their copy is out of date.

Each agent counts the changes of what it offers. It tells a linked peer the version of the catalogue that the peer
now has completely (notification ``offers``); the failure detector spreads the present version to all members. A
module that holds an older version of a parked peer links with it after a random delay, and gets the catalogue again.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, Protocol

from rmpa.bridge import limits
from rmpa.bridge.permission_gate import Needs
from rmpa.bridge.session.peer_session import PeerState
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.sizes import UINT32_MAX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.core.guid import Guid

OFFERS: Final = "offers"
"""The notification that all of ``version`` was advertised before it."""


class _Exports(Protocol):
    @property
    def changes(self) -> int: ...

    @property
    def pending(self) -> bool: ...


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
        self._catalogues: list[_Exports] = []
        self._due: dict[int, asyncio.TimerHandle] = {}
        self._spread = 0
        self.on_version: Callable[[int], None] = lambda _: None
        """Called with a new version of this module's offers, to spread it."""

    def add(self, catalogue: _Exports) -> None:
        """Take a catalogue into account."""
        self._catalogues.append(catalogue)

    def listen(self, rpc: PeerRpc) -> None:
        """Exchange versions with the peers over their links."""
        self._rpc = rpc
        rpc.on_notification(OFFERS, self._told, Needs((), "the version of the peer's own catalogue"))

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
        """Tell linked peers the version that they now have completely.

        Args:
            may_park: Whether the link to a peer may be parked: only then the peer needs to know.
        """
        self.changed()
        if self._rpc is None or any(each.pending for each in self._catalogues):
            return
        version = self.version
        for session in self._sessions():
            if session.linked and session.offers_told != version and may_park(session):
                session.offers_told = version
                self._rpc.notify(session, OFFERS, {"version": version})

    def is_known(self, session: PeerSession) -> bool:
        """Whether both sides of a link have each other's catalogue completely."""
        return session.offers_held is not None and session.offers_told == self.version

    def link_up(self, session: PeerSession) -> None:
        """A link begins: both catalogues are told again over it."""
        session.offers_told = None
        self._forget(session.peer)

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
        # The peer itself says what it offers now. A higher version that others spread was forged, or comes over the
        # link too before the peer parks it; kept, it would have the link made again for as long as both run.
        session.offers_held = session.offers_heard = version
