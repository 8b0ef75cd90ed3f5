"""One (address, port): which of the runs that claim it is the live one (restart, ghost or conflict)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.serial_number import is_later
from rmpa.discovery import limits
from rmpa.discovery.beacon import BeaconKind
from rmpa.discovery.events import HeardBy

if TYPE_CHECKING:
    from rmpa.core.identity import Identity
    from rmpa.discovery.beacon import Beacon
    from rmpa.discovery.events import Address

_NEVER: Final = float("-inf")


class EndpointChange(Enum):
    """What a beacon, or the fate of a link, means for the seat."""

    NEW = auto()
    """The seat was empty; it is taken now."""
    KNOWN = auto()
    """The one who has the seat spoke."""
    CHANGED = auto()
    """… and says something else of itself."""
    RESTARTED = auto()
    """Another run has the seat now."""
    LEAVING = auto()
    """The one who has the seat said goodbye."""
    STALE = auto()
    """A late or doubled packet; ignored."""
    WAITING = auto()
    """Another run spoke, which may be a late packet, or the next to have the seat."""
    CONFLICT = auto()
    """Another run is alive beyond doubt, and so is the one who has the seat."""


@dataclass(slots=True)
class PeerInstance:
    """One run of one peer, as heard here. Times in seconds of the roster's clock."""

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
    leaving: bool = False
    aside_at: float = _NEVER

    @property
    def deadline(self) -> float:
        """When its silence has lasted for its lease."""
        return self.heard + self.lease

    def accepts(self, sequence: int) -> bool:
        """Whether a beacon is newer than the last one (serial numbers, RFC 1982: they wrap)."""
        return self.sequence is None or is_later(sequence, self.sequence)

    def heed(self, beacon: Beacon, now: float, source: Address, *, multicast: bool) -> None:
        """Take over what a newer beacon says."""
        self.identity = beacon.identity
        self.sequence = beacon.sequence
        self.lease = min(max(beacon.lease_ms / 1000, limits.ROSTER_LEASE_MIN), limits.ROSTER_LEASE_MAX)
        self.heard = now
        self.source = source
        self.heard_by = HeardBy.MULTICAST if multicast else HeardBy.UNICAST
        self.leaving = beacon.kind is BeaconKind.GOODBYE


@dataclass(slots=True)
class Endpoint:
    """The runs heard under one (address, port).

    Args:
        current: Who has the seat.
        others: By instance id: runs that had it, that left, or that claim it too.
        conflict: Whether two live ones were seen.
        present: Whether ``current`` was told as found and not yet as lost.
        own: Whether this is our own seat, which we never give up.
    """

    current: PeerInstance | None = None
    others: dict[bytes, PeerInstance] = field(default_factory=dict)
    conflict: bool = False
    present: bool = False
    own: bool = False

    def hear(self, beacon: Beacon, now: float, source: Address, *, multicast: bool) -> EndpointChange:
        """Place one beacon; see ``EndpointChange``."""
        instance = beacon.identity.instance
        voice = self._find(instance)
        if voice is None:
            if beacon.kind is BeaconKind.GOODBYE:
                return EndpointChange.STALE
            return self._stranger(_voice(beacon, now, source, multicast=multicast), now)
        if multicast:
            voice.multicast_at = now
        if not voice.accepts(beacon.sequence):
            return EndpointChange.STALE
        previous, departed = voice.identity, voice.leaving
        voice.heed(beacon, now, source, multicast=multicast)
        if voice is not self.current:
            return self._returned(voice, now, departed=departed)
        if voice.leaving:
            return EndpointChange.LEAVING
        return EndpointChange.KNOWN if voice.identity == previous else EndpointChange.CHANGED

    def link_up(self, identity: Identity, now: float) -> EndpointChange:
        """A link's handshake proves that this run is alive: it gets the seat."""
        voice = self._find(identity.instance)
        if voice is None:
            voice = PeerInstance(identity, now, now, core_limits.ROSTER_LEASE, HeardBy.LINK, HeardBy.LINK)
        previous = voice.identity
        # A handshake carries no further addresses; those of the beacons stay.
        voice.identity = identity if identity.addresses else replace(identity, addresses=previous.addresses)
        voice.linked = True
        voice.leaving = False
        voice.heard = now
        if voice is self.current:
            return EndpointChange.KNOWN if voice.identity == previous else EndpointChange.CHANGED
        if self.current is None:
            return self._promote(voice, now, EndpointChange.NEW)
        return self._promote(voice, now, EndpointChange.RESTARTED)

    def link_down(self, now: float) -> EndpointChange:
        """The link of the one who has the seat fell; a run that waited for just that gets it."""
        current = self.current
        if current is None or not current.linked:
            return EndpointChange.STALE
        current.linked = False
        current.heard = now
        if current.leaving:
            return EndpointChange.LEAVING
        if self.conflict:
            return EndpointChange.CONFLICT
        # A run that lives sends heartbeats; one beacon, perhaps forged, long ago gets nobody a seat.
        waiting = [v for v in self.rivals() if v.since > current.since and now - v.heard <= limits.HEARTBEAT_LATE]
        if not waiting:
            return EndpointChange.KNOWN
        return self._promote(max(waiting, key=lambda v: v.heard), now, EndpointChange.RESTARTED)

    def rivals(self) -> list[PeerInstance]:
        """The others that have not said goodbye."""
        return [v for v in self.others.values() if not v.leaving]

    def vacate(self) -> None:
        """The one who has the seat is gone; in a conflict the loudest rival gets it."""
        if self.current is not None and self.current.leaving:
            self._put_aside(self.current, self.current.heard)
        self.current = None
        rivals = self.rivals()
        if self.conflict and rivals:
            self.current = max(rivals, key=lambda v: v.heard)
            del self.others[self.current.identity.instance]

    def forget(self, now: float) -> None:
        """Drop the others whose lease is over."""
        for instance in [i for i, v in self.others.items() if v.deadline <= now]:
            del self.others[instance]

    def next_timer(self) -> float | None:
        """When somebody's lease is over."""
        times = [v.deadline for v in self.others.values()]
        if self.current is not None and not self.current.linked:
            times.append(self.current.deadline)
        return min(times, default=None)

    def _find(self, instance: bytes) -> PeerInstance | None:
        if self.current is not None and self.current.identity.instance == instance:
            return self.current
        return self.others.get(instance)

    def _stranger(self, voice: PeerInstance, now: float) -> EndpointChange:
        if self.current is None:
            self.current = voice
            return EndpointChange.NEW
        if self.current.linked or self.conflict:
            self._put_aside(voice, now)
            return EndpointChange.WAITING
        return self._promote(voice, now, EndpointChange.RESTARTED)

    def _returned(self, voice: PeerInstance, now: float, *, departed: bool) -> EndpointChange:
        """One of the others spoke, with a packet that is not a late one by its number."""
        if voice.leaving:
            return EndpointChange.WAITING
        if departed:
            del self.others[voice.identity.instance]
            voice.since = now
            return self._stranger(voice, now)
        if self.current is None:
            return self._promote(voice, now, EndpointChange.NEW)
        if self.conflict or now - voice.aside_at < limits.CONFLICT_AFTER:
            return EndpointChange.WAITING
        if self.current.linked or now - self.current.heard <= limits.HEARTBEAT_LATE:
            self.conflict = True
            return EndpointChange.CONFLICT
        # Whoever has the seat missed its heartbeat: its packets were the late ones.
        return self._promote(voice, now, EndpointChange.RESTARTED)

    def _promote(self, voice: PeerInstance, now: float, verdict: EndpointChange) -> EndpointChange:
        self.others.pop(voice.identity.instance, None)
        if self.current is not None:
            self.current.linked = False
            self._put_aside(self.current, now)
        self.current = voice
        return verdict

    def _put_aside(self, voice: PeerInstance, now: float) -> None:
        voice.aside_at = now
        self.others[voice.identity.instance] = voice
        while len(self.others) >= limits.SEAT_VOICES_MAX:
            del self.others[min(self.others, key=lambda i: (self.others[i].heard, i))]


def _voice(beacon: Beacon, now: float, source: Address, *, multicast: bool) -> PeerInstance:
    how = HeardBy.MULTICAST if multicast else HeardBy.UNICAST
    voice = PeerInstance(beacon.identity, now, now, core_limits.ROSTER_LEASE, how, how)
    voice.heed(beacon, now, source, multicast=multicast)
    voice.multicast_at = now if multicast else _NEVER
    return voice
