"""All endpoints of the membership protocol, with indexes: a packet never costs a look at every endpoint."""

from __future__ import annotations

from bisect import bisect_left, insort
from typing import TYPE_CHECKING

from rmpa.core import limits as core_limits
from rmpa.core.counters import TimerQueue
from rmpa.discovery import limits
from rmpa.discovery.events import ConflictKind, HeardBy, PeerConflict, PeerView

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.core.identity import Guid, Identity
    from rmpa.discovery.beacon import Address
    from rmpa.discovery.endpoint import Endpoint, PeerInstance


class EndpointTable:
    """The endpoints by place (``Guid.place``), with their timers.

    After an endpoint was changed from outside, ``changed`` must be called; ``heard`` if only its peer was heard.
    """

    def __init__(self) -> None:
        self._all: dict[int, Endpoint] = {}
        self._order: list[int] = []
        self._timers: TimerQueue[int] = TimerQueue()
        self._present: list[PeerInstance] = []
        self._present_places: list[int] = []
        self._strangers: set[int] = set()
        self._names: dict[int, str] = {}
        self._by_name: dict[str, list[int]] = {}

    def __len__(self) -> int:
        return len(self._all)

    def __contains__(self, place: int) -> bool:
        return place in self._all

    def __iter__(self) -> Iterator[Endpoint]:
        """In the order of their places, which is that of GUIDs."""
        return iter([self._all[place] for place in self._order])

    @property
    def is_full(self) -> bool:
        """Whether there is no room for one more peer that was never linked."""
        return len(self._all) >= core_limits.PEERS_MAX or len(self._strangers) >= limits.STRANGERS_MAX

    def get(self, place: int) -> Endpoint | None:
        """The endpoint at a place, or ``None``."""
        return self._all.get(place)

    def add(self, place: int, endpoint: Endpoint) -> Endpoint:
        """Add an endpoint at a place that has none; return it."""
        self._all[place] = endpoint
        insort(self._order, place)
        self.changed(place)
        return endpoint

    def remove(self, place: int) -> None:
        """Remove the endpoint at a place."""
        del self._all[place]
        del self._order[bisect_left(self._order, place)]
        self._timers.set(place, None)
        self._index(place, None)

    def heard(self, place: int) -> None:
        """Update the endpoint's timer, the only part of it that has changed."""
        endpoint = self._all.get(place)
        if endpoint is not None:
            self._timers.set(place, endpoint.next_timer())

    def changed(self, place: int) -> None:
        """Update all indexes after any change of the endpoint: its peer, its name, whether it is present."""
        self.heard(place)
        self._index(place, self._all.get(place))

    def _index(self, place: int, endpoint: Endpoint | None) -> None:
        """Update the indexes at one place; a thousand peers that appear at once must not cost a million steps."""
        peer = endpoint.current if endpoint is not None else None
        if endpoint is None or endpoint.own or (peer is not None and peer.verified):
            self._strangers.discard(place)
        else:
            self._strangers.add(place)
        name = peer.identity.name if peer is not None else None
        before = self._names.get(place)
        if name != before:
            if before is not None:
                there = self._by_name[before]
                there.remove(place)
                if not there:
                    del self._by_name[before]
                del self._names[place]
            if name is not None:
                insort(self._by_name.setdefault(name, []), place)
                self._names[place] = name
        member = peer if endpoint is not None and endpoint.present else None
        at = bisect_left(self._present_places, place)
        listed = at < len(self._present_places) and self._present_places[at] == place
        if member is None and listed:
            del self._present_places[at], self._present[at]
        elif member is not None and listed:
            self._present[at] = member
        elif member is not None:
            self._present_places.insert(at, place)
            self._present.insert(at, member)

    def next_timer(self) -> float | None:
        """When the next lease is over, on the clock of ``take_expired``; ``None``: never."""
        return self._timers.next()

    def take_expired(self, now: float) -> list[int]:
        """The places at which a lease is over, in order. The caller handles each, and calls ``changed``."""
        return sorted(self._timers.take(now))

    def present(self) -> list[PeerInstance]:
        """The peers that are members, without this agent, by GUID; not to be changed or kept by the caller."""
        return self._present

    def observed_addresses(self, gossip: tuple[Guid, ...]) -> tuple[Address, ...]:
        """Source addresses of gossiped peers that differ from the GUID's address, which may not be reachable."""
        found = []
        for guid in gossip:
            endpoint = self._all.get(guid.place)
            source = endpoint.current.source if endpoint is not None and endpoint.current is not None else None
            if source is not None and source != guid.endpoint and not source[0].startswith("127."):
                found.append(source)
        return tuple(found)

    def unknown_addresses(self, addresses: tuple[Address, ...], own: Identity) -> list[Address]:
        """Those of the addresses that belong neither to a member nor to this agent, whose identity is given."""
        if not addresses:
            return []
        met = {*own.endpoints}
        for peer in self.present():
            met.update(peer.identity.endpoints, peer.addresses)
        loopback = own.guid.is_loopback
        return [a for a in addresses if a not in met and (loopback or not a[0].startswith("127."))]

    def with_name(self, name: str) -> list[Endpoint]:
        """The endpoints whose peer has this name, in order; peers in conflict and this agent itself included."""
        return [self._all[place] for place in self._by_name.get(name, ())]

    def oldest_unlinked(self, silent_since: float | None = None) -> int | None:
        """The place of the unlinked peer that has been silent for longest; one that never had a link comes first.

        Args:
            silent_since: Only one that never had a link, and was not heard since then.
        """
        unlinked = [
            (peer is not None and peer.verified, peer.heard if peer is not None else float("-inf"), place)
            for place, peer in ((place, endpoint.current) for place, endpoint in self._all.items())
            if peer is None or not peer.linked
        ]
        had_link, heard, place = min(unlinked, default=(True, 0.0, None))
        return None if silent_since is not None and (had_link or heard > silent_since) else place

    def same_name(self, endpoint: Endpoint) -> list[tuple[PeerInstance, PeerInstance]]:
        """Pairs of this endpoint's peer and each other live peer with its name, the newer peer first."""
        mine = endpoint.current
        if mine is None:
            return []
        pairs = []
        for other in self.with_name(mine.identity.name):
            peer = other.current
            if peer is None or other is endpoint or not (other.present or other.own):
                continue
            newer, older = (mine, peer) if (mine.since, other.own) >= (peer.since, endpoint.own) else (peer, mine)
            alive = older.linked or older.heard >= newer.since or other.own or endpoint.own
            if alive:
                pairs.append((newer, older))
        return pairs

    def views(self) -> tuple[PeerView, ...]:
        """All peers in GUID order, those included that a conflict keeps from being members; not this agent itself."""
        return tuple(
            self._view(endpoint, peer)
            for endpoint in self
            for peer in [endpoint.current, *(endpoint.rivals() if endpoint.conflict else [])]
            if peer is not None and not (endpoint.own and peer is endpoint.current)
        )

    def _view(self, endpoint: Endpoint, peer: PeerInstance) -> PeerView:
        conflicts = []
        if endpoint.conflict and endpoint.current is not None:
            rivals = endpoint.rivals()
            other = endpoint.current if peer is not endpoint.current else rivals[0] if rivals else peer
            kind = ConflictKind.OWN_GUID if endpoint.own else ConflictKind.GUID
            conflicts.append(str(PeerConflict(kind, peer.identity, other.identity)))
        conflicts += [
            str(PeerConflict(ConflictKind.NAME, one.identity, other.identity))
            for one, other in (self.same_name(endpoint) if peer is endpoint.current else ())
        ]
        return PeerView(
            peer.identity,
            peer.since,
            peer.heard,
            peer.found_by,
            peer.heard_by if not peer.linked else HeardBy.LINK,
            peer.source,
            peer.linked,
            tuple(conflicts),
            endpoint.present and peer is endpoint.current,
        )
