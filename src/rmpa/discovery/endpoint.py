"""One (address, port): decides which run that claims it is the live one (restart, late packet or conflict)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.counters import earliest
from rmpa.core.identity import is_later
from rmpa.discovery import limits
from rmpa.discovery.beacon import BeaconKind
from rmpa.discovery.events import HeardBy

if TYPE_CHECKING:
    from rmpa.core.identity import Identity
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
