"""The table of (address, port): which run that claims an address is the live one, and which runs have ended.

One (address, port): decides which run that claims it is the live one (restart, late packet or conflict).
"""

from __future__ import annotations

from bisect import bisect_left, insort
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.counters import TimerQueue, earliest
from rmpa.core.identity import is_later
from rmpa.discovery import limits
from rmpa.discovery.beacon import BeaconKind, ConflictKind, HeardBy, PeerConflict, PeerView

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.core.identity import Guid, Identity
    from rmpa.discovery.beacon import Address, Beacon

_NEVER: Final = float("-inf")


class EndpointChange(Enum):
    """The change of an endpoint by a beacon, or by a link that came up or fell."""

    NEW = auto()
    """The endpoint had no current run; it has one now."""
    KNOWN = auto()
    """The current run was heard."""
    CHANGED = auto()
    """The current run was heard, and its identity has changed."""
    RESTARTED = auto()
    """Another run is current now."""
    LEAVING = auto()
    """The current run said goodbye."""
    STALE = auto()
    """A late or repeated packet; ignored."""
    WAITING = auto()
    """Another run was heard: by a late packet, or because it is the next run."""
    CONFLICT = auto()
    """Another run is certainly alive, and so is the current one."""


@dataclass(slots=True)
class PeerInstance:
    """One run of a peer, as heard here. Times are seconds of the protocol's clock.

    Args:
        identity: As its last beacon or handshake said.
        since: When it was first heard, or became a member.
        heard: When it was last heard, or had a link.
        lease: Seconds of silence after which it counts as gone.
        found_by: How it was first heard.
        heard_by: How it was last heard.
        source: The source address of its last packet; ``None`` if only a link has shown it.
        sequence: The number of its last beacon.
        multicast_at: When it was last heard by multicast.
        linked: Whether there is a link with it.
        verified: Whether it had a link: it is no forgery.
        leaving: Whether it said goodbye. The goodbye may be forged: its number does not count for what comes after.
        before_goodbye: The number of its last beacon before the goodbye.
        superseded_at: When another run took its endpoint.
        doubted: Whether the silence of its beacons, while it is linked, was reported.
    """

    identity: Identity
    since: float
    heard: float
    lease: float
    found_by: HeardBy
    heard_by: HeardBy
    source: Address | None = None
    sequence: int | None = None
    multicast_at: float = _NEVER
    linked: bool = False
    verified: bool = False
    leaving: bool = False
    before_goodbye: int | None = None
    superseded_at: float = _NEVER
    doubted: bool = False

    @property
    def deadline(self) -> float:
        """When its lease is over, if it stays silent."""
        return self.heard + self.lease

    @property
    def addresses(self) -> tuple[Address, ...]:
        """Where its unicasts go: its GUID's endpoint, and the source of its packets where that differs."""
        endpoint = self.identity.guid.endpoint
        return (endpoint,) if self.source is None or self.source == endpoint else (endpoint, self.source)

    def accepts(self, sequence: int, now: float) -> bool:
        """Whether a beacon is newer than the last one (serial numbers, RFC 1982: they wrap).

        A beacon that was late behind a goodbye comes soon after it. One that comes later was sent after it, and shows
        that the goodbye was forged, whatever number that had.
        """
        last = self.sequence
        if self.leaving and now - self.heard >= limits.GOODBYE_LATE:
            last = self.before_goodbye
        return last is None or is_later(sequence, last)

    def update(self, beacon: Beacon, now: float, source: Address, *, multicast: bool) -> None:
        """Take over the content of a newer beacon; of a goodbye, which may be forged, only that it was said."""
        self.leaving = beacon.kind is BeaconKind.GOODBYE
        if self.leaving:
            self.before_goodbye, self.sequence = self.sequence, beacon.sequence
            self.heard = now
            return
        self.identity = beacon.identity
        self.sequence = beacon.sequence
        self.lease = min(max(beacon.lease_ms / 1000, limits.LEASE_MIN), limits.LEASE_MAX)
        self.heard = now
        self.doubted = False
        self.source = source
        self.heard_by = HeardBy.MULTICAST if multicast else HeardBy.UNICAST


@dataclass(slots=True)
class Endpoint:
    """The runs heard under one (address, port).

    Args:
        current: The run that counts as the live one.
        others: By instance id: runs that were current, that said goodbye, or that claim the endpoint too.
        conflict: Whether two live runs were seen.
        present: Whether ``current`` is a member: reported as found and not yet as lost.
        own: Whether this is this agent's own endpoint, at which no other run becomes current.
    """

    current: PeerInstance | None = None
    others: dict[bytes, PeerInstance] = field(default_factory=dict)
    conflict: bool = False
    present: bool = False
    own: bool = False

    def receive(self, beacon: Beacon, now: float, source: Address, *, multicast: bool) -> EndpointChange:
        """Take in one beacon; return what it changes."""
        instance = beacon.identity.instance
        peer = self._find(instance)
        if peer is None:
            if beacon.kind is BeaconKind.GOODBYE:
                return EndpointChange.STALE
            return self._new_run(_peer_from(beacon, now, source, multicast=multicast), now)
        if multicast:
            peer.multicast_at = now
        again = peer.leaving and beacon.kind is BeaconKind.GOODBYE  # one of an agent is its last beacon
        if again or not peer.accepts(beacon.sequence, now):
            return EndpointChange.STALE
        previous, departed = peer.identity, peer.leaving
        peer.update(beacon, now, source, multicast=multicast)
        if peer is not self.current:
            return self._other_run(peer, now, departed=departed)
        if peer.leaving:
            return EndpointChange.LEAVING
        same = peer.identity is previous or peer.identity == previous
        return EndpointChange.KNOWN if same else EndpointChange.CHANGED

    def link_up(self, identity: Identity, now: float) -> EndpointChange:
        """Make the run of a link's handshake the current one, because the handshake proves that it is alive."""
        peer = self._find(identity.instance)
        if peer is None:
            peer = PeerInstance(identity, now, now, core_limits.PEER_LEASE, HeardBy.LINK, HeardBy.LINK)
        previous = peer.identity
        # A handshake carries no further addresses; those of the beacons stay.
        peer.identity = identity if identity.addresses else replace(identity, addresses=previous.addresses)
        peer.linked = peer.verified = True
        peer.leaving = peer.doubted = False
        peer.heard = now
        if peer is self.current:
            return EndpointChange.KNOWN if peer.identity == previous else EndpointChange.CHANGED
        if self.current is None:
            return self._promote(peer, now, EndpointChange.NEW)
        return self._promote(peer, now, EndpointChange.RESTARTED)

    def link_down(self, now: float) -> EndpointChange:
        """Handle the end of the current run's link; a newer run that was heard lately becomes current."""
        current = self.current
        if current is None or not current.linked:
            return EndpointChange.STALE
        current.linked = False
        current.heard = now
        if current.leaving:
            return EndpointChange.LEAVING
        if self.conflict:
            return EndpointChange.CONFLICT
        # A live run sends heartbeats; a single beacon long ago, perhaps forged, is not enough.
        waiting = [v for v in self.rivals() if v.since > current.since and now - v.heard <= limits.HEARTBEAT_LATE]
        if not waiting:
            return EndpointChange.KNOWN
        return self._promote(max(waiting, key=lambda v: v.heard), now, EndpointChange.RESTARTED)

    def rivals(self) -> list[PeerInstance]:
        """The other runs that have not said goodbye."""
        return [v for v in self.others.values() if not v.leaving]

    def remove_current(self) -> None:
        """Remove the current run; in a conflict the rival that was heard last becomes current."""
        if self.current is not None and self.current.leaving:
            self._supersede(self.current, self.current.heard)
        self.current = None
        rivals = self.rivals()
        if self.conflict and rivals:
            self.current = max(rivals, key=lambda v: v.heard)
            del self.others[self.current.identity.instance]

    def expire_others(self, now: float) -> None:
        """Drop the other runs whose lease is over."""
        for instance in [i for i, v in self.others.items() if v.deadline <= now]:
            del self.others[instance]

    def next_timer(self) -> float | None:
        """When the first lease is over; that of a linked run is only once, which is reported."""
        current = self.current
        first = None if current is None or self.own or (current.linked and current.doubted) else current.deadline
        return earliest(first, *(v.deadline for v in self.others.values())) if self.others else first

    def _find(self, instance: bytes) -> PeerInstance | None:
        if self.current is not None and self.current.identity.instance == instance:
            return self.current
        return self.others.get(instance)

    def _new_run(self, peer: PeerInstance, now: float) -> EndpointChange:
        """Take in a run that was not known, or had said goodbye."""
        if self.current is None:
            self.current = peer
            return EndpointChange.NEW
        if self.current.linked or self.conflict:
            self._supersede(peer, now)
            return EndpointChange.WAITING
        return self._promote(peer, now, EndpointChange.RESTARTED)

    def _other_run(self, peer: PeerInstance, now: float, *, departed: bool) -> EndpointChange:
        """Take in a new packet, by its sequence number, of a known run that is not the current one."""
        if peer.leaving:
            return EndpointChange.WAITING
        if departed:
            del self.others[peer.identity.instance]
            peer.since = now
            return self._new_run(peer, now)
        if self.current is None:
            return self._promote(peer, now, EndpointChange.NEW)
        if self.conflict or now - peer.superseded_at < limits.CONFLICT_AFTER:
            return EndpointChange.WAITING
        if self.current.linked and not self.own and self.current.heard <= peer.since:
            # The current run was not heard since. Its link may lead to a machine without power; it is checked.
            return EndpointChange.WAITING
        if self.current.linked or now - self.current.heard <= limits.HEARTBEAT_LATE:
            self.conflict = True
            return EndpointChange.CONFLICT
        # The current run missed its heartbeat, so its packets, and not the other run's, were the late ones.
        return self._promote(peer, now, EndpointChange.RESTARTED)

    def _promote(self, peer: PeerInstance, now: float, change: EndpointChange) -> EndpointChange:
        self.others.pop(peer.identity.instance, None)
        if self.current is not None:
            self.current.linked = False
            self._supersede(self.current, now)
        self.current = peer
        return change

    def _supersede(self, peer: PeerInstance, now: float) -> None:
        peer.superseded_at = now
        self.others[peer.identity.instance] = peer
        while len(self.others) >= limits.ENDPOINT_RUNS_MAX:
            del self.others[min(self.others, key=lambda i: (self.others[i].heard, i))]


def _peer_from(beacon: Beacon, now: float, source: Address, *, multicast: bool) -> PeerInstance:
    how = HeardBy.MULTICAST if multicast else HeardBy.UNICAST
    peer = PeerInstance(beacon.identity, now, now, core_limits.PEER_LEASE, how, how)
    peer.update(beacon, now, source, multicast=multicast)
    peer.multicast_at = now if multicast else _NEVER
    return peer


# All endpoints of the membership protocol, with indexes: a packet never costs a look at every endpoint.


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
