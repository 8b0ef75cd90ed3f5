"""The roster machine: who is there, told from beacons and links alone (paper, section 4.3). Pure.

Feed it with ``start``, ``receive``, ``link_up``, ``link_down``, ``interfaces_changed``, ``set_seeds`` and
``handle_timer``; after each of them take ``outputs()`` (what to send) and ``events()`` (what to tell).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.clock import earliest
from rmpa.core.counters import Counters
from rmpa.core.identity import Identity
from rmpa.core.serial_number import serial_add
from rmpa.core.token_bucket import TokenBucket
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.endpoint import Endpoint, EndpointChange, PeerInstance
from rmpa.discovery.endpoint_table import EndpointTable
from rmpa.discovery.events import (
    Address,
    ConflictCleared,
    ConflictKind,
    Event,
    HeardBy,
    LossReason,
    Output,
    PeerChanged,
    PeerConflict,
    PeerFound,
    PeerLost,
    PeerRestarted,
    PeerView,
    SendMulticast,
    SendUnicast,
)
from rmpa.discovery.gossip import GossipSelector, UnicastHeartbeats
from rmpa.discovery.greeting import AnswerLimit, Greetings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from ipaddress import IPv4Address

    from rmpa.core.guid import Guid

_NEVER: Final = float("-inf")


class Roster:
    """Who is there.

    Args:
        identity: Our own.
        rng: Uniform numbers in [0, 1), for jitter; seeded by simulations.
        multicast: Whether to send to the group at all.
        lease: Seconds after which others may count us as gone.
        counters: Where refusals are counted.
    """

    def __init__(
        self,
        identity: Identity,
        *,
        rng: Callable[[], float],
        multicast: bool = True,
        lease: float = core_limits.ROSTER_LEASE,
        counters: Counters | None = None,
    ) -> None:
        self.counters = counters if counters is not None else Counters()
        self._own = identity
        self._rng = rng
        self._multicast = multicast
        self._lease_ms = round(lease * 1000)
        self._seats = EndpointTable()
        self._room = TokenBucket(limits.ROSTER_EVICTIONS_PER_SECOND, limits.ROSTER_EVICTIONS_PER_SECOND)
        self._no_room_until = _NEVER
        self._named: set[frozenset[bytes]] = set()
        self._answers = AnswerLimit()
        self._greetings = Greetings(rng)
        self._seeds: tuple[Address, ...] = ()
        self._burst: list[float] = []
        self._heartbeat_at: float | None = None
        self._spread_at: float | None = None
        self._spread_last = _NEVER
        self._sequence = 0
        self._gossip_turn = GossipSelector()
        self._whispers = UnicastHeartbeats()
        self._closed = False
        self._outputs: list[Output] = []
        self._events: list[Event] = []

    # --- what drives it ---------------------------------------------------------------------------------------

    def start(self, now: float) -> None:
        """Announce ourselves: a burst, then silence but for the heartbeat."""
        own = PeerInstance(self._own, now, now, core_limits.ROSTER_LEASE, HeardBy.LINK, HeardBy.LINK, linked=True)
        self._seats.add(self._own.guid.place, Endpoint(own, own=True))
        self._burst = self._burst_times(now, limits.BURST_OFFSETS)
        self._heartbeat_at = self._next_heartbeat(now)
        self.handle_timer(now)

    def receive(self, beacon: Beacon, source: Address, now: float, *, multicast: bool) -> None:
        """Take in one beacon.

        Args:
            beacon: As parsed; of our domain.
            source: The packet's source address and port.
            now: Monotonic seconds.
            multicast: Whether it came to the group (else: to our own port).
        """
        identity = beacon.identity
        if self._closed or identity.instance == self._own.instance:
            self.counters.add("beacon.echo")
            return
        key = identity.guid.place
        seat = self._seats.get(key)
        if seat is None:
            if len(self._seats) >= core_limits.ROSTER_PEERS_MAX and not self._evict_silent(now):
                self.counters.add("roster.full")
                return
            seat = self._seats.add(key, Endpoint())
        previous = seat.current.identity if seat.current is not None else None
        verdict = seat.hear(beacon, now, source, multicast=multicast)
        if verdict in {EndpointChange.KNOWN, EndpointChange.STALE}:
            self._seats.heard(key)
        else:
            self._seats.changed(key)
        greeted = [self._greetings.heard(address) for address in {identity.guid.endpoint, source}]
        self._judge(seat, verdict, now, previous=previous, source=source)
        if verdict in {EndpointChange.NEW, EndpointChange.RESTARTED} and not multicast and seat.current is not None:
            self._presume(seat.current, beacon, source, now, greeted=any(greeted))
        if verdict is EndpointChange.STALE:
            self.counters.add("beacon.late")
        elif verdict in {EndpointChange.NEW, EndpointChange.RESTARTED, EndpointChange.KNOWN, EndpointChange.CHANGED}:
            self._answer(seat, verdict, beacon, now, multicast=multicast)
            self._hearsay(beacon, now)
        self._drop_if_empty(key)

    def link_up(self, identity: Identity, now: float, source: Address | None = None) -> None:
        """A link to this peer is up: it is in the roster for as long as the link is, however silent.

        Args:
            identity: As its handshake said.
            now: Monotonic seconds.
            source: Where its beacons can be sent to, if that is known to differ from its GUID's endpoint.
        """
        key = identity.guid.place
        seat = self._seats.get(key)
        if seat is None:
            if len(self._seats) >= core_limits.ROSTER_PEERS_MAX and not self._evict():
                self.counters.add("roster.full")
                return
            seat = self._seats.add(key, Endpoint())
        if seat.own:
            self.counters.add("roster.own_link")
            return
        previous = seat.current.identity if seat.current is not None else None
        verdict = seat.link_up(identity, now)
        self._seats.changed(key)
        if source is not None and seat.current is not None:
            seat.current.source = source
        self._greetings.heard(identity.guid.endpoint)
        self._judge(seat, verdict, now, previous=previous, source=source)
        if not seat.present:
            self._found(seat, now)

    def link_down(self, guid: Guid, now: float, instance: bytes | None = None) -> None:
        """The link to this peer fell: from now on its silence counts.

        Args:
            guid: Whose link.
            now: Monotonic seconds.
            instance: Which run's; a link of a run that was replaced meanwhile changes nothing.
        """
        key = guid.place
        seat = self._seats.get(key)
        if seat is None or seat.own or seat.current is None:
            return
        previous = seat.current.identity
        if instance is not None and previous.instance != instance:
            return
        verdict = seat.link_down(now)
        self._seats.changed(key)
        if verdict is EndpointChange.CONFLICT:
            self._lost(seat, LossReason.CONFLICT)
            return
        source = seat.current.source
        self._judge(seat, verdict, now, previous=previous, source=source)
        if verdict is EndpointChange.RESTARTED:
            self._send_answer(seat.current, now)
        self._drop_if_empty(key)

    def interfaces_changed(self, now: float, addresses: tuple[IPv4Address, ...] | None = None) -> None:
        """Interfaces came or went: announce ourselves again, with our present addresses if they are given."""
        if self._closed:
            return
        if addresses is not None:
            own = self._own
            self._own = Identity(own.guid, own.instance, own.name, own.domain, addresses)
        self._burst = self._burst_times(now, limits.BURST_AGAIN_OFFSETS)
        self.handle_timer(now)

    def set_seeds(self, seeds: Iterable[Address]) -> None:
        """Greet these numeric addresses now and with each heartbeat; replaces the former ones."""
        known = self._seeds
        self._seeds = tuple(dict.fromkeys(seeds))
        if self._heartbeat_at is not None:
            for address in self._seeds:
                if address not in known:
                    self._send(BeaconKind.ANNOUNCE, address)

    def goodbye(self, now: float) -> None:
        """Say that we leave; nothing is sent or taken in afterwards."""
        if self._closed or self._heartbeat_at is None:
            return
        if self._multicast:
            self._outputs.append(SendMulticast(self._beacon(BeaconKind.GOODBYE)))
        for voice in self._whispers.choose(self._unheard_by_multicast(now), now)[0]:
            for address in _addresses(voice):
                self._send(BeaconKind.GOODBYE, address)
        self._closed = True

    def next_timer(self) -> float | None:
        """When ``handle_timer`` wants to be called, in the clock's seconds."""
        if self._closed:
            return None
        return earliest(
            self._heartbeat_at,
            self._spread_at,
            self._whispers.at,
            self._burst[0] if self._burst else None,
            self._greetings.next_timer(),
            self._seats.next_timer(),
        )

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        if self._closed or self._heartbeat_at is None:
            return
        self._leases(now)
        if self._burst and self._burst[0] <= now:
            self._burst = [at for at in self._burst if at > now]
            self._shout(BeaconKind.ANNOUNCE, now)
            for address in self._seeds:
                self._send(BeaconKind.ANNOUNCE, address)
        if self._heartbeat_at <= now:
            self._heartbeat_at = self._next_heartbeat(now)
            self._shout(BeaconKind.HEARTBEAT, now)
            self._whisper(now)
            met = {address for voice in self._seats.present() for address in _addresses(voice)} if self._seeds else ()
            for address in self._seeds:
                if address not in met:
                    self._send(BeaconKind.ANNOUNCE, address)
        if self._spread_at is not None and self._spread_at <= now:
            self._spread(now)
        for voice in self._whispers.some():
            gossip = self._gossip(self._seats.present(), voice, now)
            for address in _addresses(voice):
                self._send(BeaconKind.HEARTBEAT, address, gossip)
        for address in self._greetings.due(now):
            self._send(BeaconKind.ANNOUNCE, address)

    # --- what it says -----------------------------------------------------------------------------------------

    def outputs(self) -> list[Output]:
        """What to send, in order; taken out."""
        taken, self._outputs = self._outputs, []
        return taken

    def events(self) -> list[Event]:
        """What happened, in order; taken out."""
        taken, self._events = self._events, []
        return taken

    def peers(self) -> tuple[PeerView, ...]:
        """All peers in GUID order, those that a conflict keeps out included."""
        return tuple(
            self._view(seat, voice)
            for seat in self._seats
            for voice in [seat.current, *(seat.rivals() if seat.conflict else [])]
            if voice is not None and not (seat.own and voice is seat.current)
        )

    def silent_seeds(self) -> list[Address]:
        """Seeds at whose address nobody in the roster is."""
        met = {host for voice in self._seats.present() for host, _ in _addresses(voice)}
        return [seed for seed in self._seeds if seed[0] not in met]

    def is_linked(self, guid: Guid, instance: bytes) -> bool:
        """Whether we have a link with this run of a peer; with ourselves we do."""
        seat = self._seats.get(guid.place)
        voice = seat.current if seat is not None else None
        return voice is not None and voice.linked and voice.identity.instance == instance

    @property
    def identity(self) -> Identity:
        """Our own, as the next beacon will say it."""
        return self._own

    # --- verdicts to events -----------------------------------------------------------------------------------

    def _judge(
        self,
        seat: Endpoint,
        verdict: EndpointChange,
        now: float,
        *,
        previous: Identity | None,
        source: Address | None,
    ) -> None:
        current = seat.current
        if current is None:
            return
        if verdict is EndpointChange.KNOWN and seat.present:
            self._check_name(seat)
        elif verdict is EndpointChange.NEW:
            self._found(seat, now)
        elif verdict is EndpointChange.CHANGED and previous is not None and seat.present:
            self._events.append(PeerChanged(current.identity, previous))
            self._check_name(seat)
        elif verdict is EndpointChange.RESTARTED and previous is not None:
            if seat.present:
                self._events.append(PeerRestarted(current.identity, previous, source))
                self._check_name(seat)
                self._news(now)
            elif not seat.conflict:
                self._found(seat, now)
        elif verdict is EndpointChange.LEAVING and not current.linked:
            self._lost(seat, LossReason.GOODBYE)
            seat.vacate()
            self._settle(seat, now)
            self._seats.changed(current.identity.guid.place)
        elif verdict is EndpointChange.CONFLICT:
            kind = ConflictKind.OWN_GUID if seat.own else ConflictKind.GUID
            rival = max(seat.rivals(), key=lambda v: v.heard)
            self._events.append(PeerConflict(kind, rival.identity, current.identity))
            if not current.linked:
                self._lost(seat, LossReason.CONFLICT)
        elif verdict is EndpointChange.WAITING:
            self._settle(seat, now)
            self._seats.changed(current.identity.guid.place)

    def _found(self, seat: Endpoint, now: float) -> None:
        voice = seat.current
        if voice is None or seat.own:
            return
        seat.present = True
        voice.since = now
        self._seats.changed(voice.identity.guid.place)
        self._events.append(PeerFound(voice.identity, voice.source, voice.found_by))
        self._retire_ghosts(seat, voice)
        self._check_name(seat)
        self._news(now)

    def _lost(self, seat: Endpoint, reason: LossReason) -> None:
        if seat.present and seat.current is not None:
            seat.present = False
            self._seats.changed(seat.current.identity.guid.place)
            self._events.append(PeerLost(seat.current.identity, reason))
            self._named = {pair for pair in self._named if seat.current.identity.instance not in pair}

    def _retire_ghosts(self, seat: Endpoint, voice: PeerInstance) -> None:
        """A killed agent that starts again at another port: one name, one machine, and the old one has no link.

        If the old one lives all the same, its next beacon brings it back.
        """
        for other in self._seats.named(voice.identity.name):
            ghost = other.current
            if (
                ghost is not None
                and other is not seat
                and not other.own
                and not ghost.linked
                and ghost.heard < voice.since
                and ghost.identity.guid.address == voice.identity.guid.address
            ):
                key = ghost.identity.guid.place
                self._lost(other, LossReason.MOVED)
                other.vacate()
                self._seats.changed(key)
                self._drop_if_empty(key)

    def _check_name(self, seat: Endpoint) -> None:
        """Say once that two peers share a name, if both live beyond doubt: a ghost is none's namesake."""
        for one, other in self._namesakes(seat):
            pair = frozenset({one.identity.instance, other.identity.instance})
            if pair not in self._named:
                self._named.add(pair)
                self._events.append(PeerConflict(ConflictKind.NAME, one.identity, other.identity))
                return

    def _namesakes(self, seat: Endpoint) -> list[tuple[PeerInstance, PeerInstance]]:
        """This seat's peer with each other of its name, the newer of both first."""
        mine = seat.current
        if mine is None:
            return []
        pairs = []
        for other in self._seats.named(mine.identity.name):
            voice = other.current
            if voice is None or other is seat or not (other.present or other.own):
                continue
            newer, older = (mine, voice) if (mine.since, other.own) >= (voice.since, seat.own) else (voice, mine)
            alive = older.linked or older.heard >= newer.since or other.own or seat.own
            if alive:
                pairs.append((newer, older))
        return pairs

    def _settle(self, seat: Endpoint, now: float) -> None:
        """After somebody of this seat fell silent or left: is a conflict over?"""
        seat.forget(now)
        if seat.conflict and seat.current is not None and not seat.rivals():
            seat.conflict = False
            kind = ConflictKind.OWN_GUID if seat.own else ConflictKind.GUID
            self._events.append(ConflictCleared(kind, seat.current.identity))
            if not seat.present:
                self._found(seat, now)
                if not seat.own:
                    self._send_answer(seat.current, now)

    def _leases(self, now: float) -> None:
        for key in self._seats.due(now):
            seat = self._seats.get(key)  # one that came back may have retired another
            if seat is None:
                continue
            voice = seat.current
            if voice is not None and not voice.linked and voice.deadline <= now:
                self._lost(seat, LossReason.SILENCE)
                seat.vacate()
                if voice.multicast_at + limits.MULTICAST_SILENCE < now:
                    # No multicast will bring it back by itself once the network heals.
                    self._greetings.learn(voice.identity.guid.endpoint, now)
            self._settle(seat, now)
            self._seats.changed(key)
            self._drop_if_empty(key)

    def _drop_if_empty(self, key: int) -> None:
        seat = self._seats.get(key)
        if seat is not None and seat.current is None and not seat.others:
            self._seats.drop(key)

    def _evict(self) -> bool:
        """Make room for a linked peer: the one that is silent for longest has no link to prove that it exists."""
        oldest = self._seats.oldest_unlinked()
        if oldest is not None:
            self._remove(oldest[1])
        return oldest is not None

    def _evict_silent(self, now: float) -> bool:
        """Make room for one that speaks: another has no link and has missed a heartbeat, and may be invented.

        Not often, for so may be the one that speaks.
        """
        if now < self._no_room_until:
            return False
        heard, key = self._seats.oldest_unlinked() or (now, 0)
        self._no_room_until = heard + limits.HEARTBEAT_LATE
        if now >= self._no_room_until and self._room.take(now):
            self._remove(key)
            return True
        self._no_room_until = max(self._no_room_until, self._room.next(now))
        return False

    def _remove(self, key: int) -> None:
        seat = self._seats.get(key)
        if seat is not None:
            self._lost(seat, LossReason.SILENCE)
            self._seats.drop(key)

    # --- sending ----------------------------------------------------------------------------------------------

    def _beacon(self, kind: BeaconKind, gossip: tuple[Guid, ...] = ()) -> Beacon:
        self._sequence = serial_add(self._sequence, 1)
        return Beacon(kind, self._own, self._lease_ms, self._sequence, gossip, self._elsewhere(gossip))

    def _elsewhere(self, gossip: tuple[Guid, ...]) -> tuple[Address, ...]:
        """Where we hear those that are not at their GUID's address: whoever hears of them may only reach that."""
        found = []
        for guid in gossip:
            seat = self._seats.get(guid.place)
            source = seat.current.source if seat is not None and seat.current is not None else None
            if source is not None and source != guid.endpoint and not source[0].startswith("127."):
                found.append(source)
        return tuple(found)

    def _send(self, kind: BeaconKind, address: Address, gossip: tuple[Guid, ...] = ()) -> None:
        if not self._closed:
            self._outputs.append(SendUnicast(self._beacon(kind, gossip), address))

    def _shout(self, kind: BeaconKind, now: float) -> None:
        """Multicast, with those that multicast does not bring to the others."""
        if self._multicast:
            gossip = self._gossip(self._unheard_by_multicast(now), None, now)
            self._outputs.append(SendMulticast(self._beacon(kind, gossip)))

    def _whisper(self, now: float) -> None:
        """The heartbeat, and all we know, to peers that multicast does not join with us; a few at once."""
        if not self._whispers.plan(self._unheard_by_multicast(now), now):
            self.counters.add("beacon.whisper_limited")

    def _spread(self, now: float) -> None:
        self._spread_at = None
        self._spread_last = now
        self._whisper(now)
        if self._unheard_by_multicast(now):
            self._shout(BeaconKind.HEARTBEAT, now)

    def _news(self, now: float) -> None:
        """Somebody was found: let those know who cannot hear it themselves."""
        if self._spread_at is None and self._heartbeat_at is not None and len(self._seats.present()) > 1:
            self._spread_at = max(now, self._spread_last + limits.SPREAD_INTERVAL)

    def _answer(
        self, seat: Endpoint, verdict: EndpointChange, beacon: Beacon, now: float, *, multicast: bool
    ) -> None:
        """Tell the sender of us if it does not know us, or may not."""
        voice = seat.current
        if voice is None or voice.linked or seat.conflict or beacon.kind is BeaconKind.ANSWER:
            return
        unknown = verdict in {EndpointChange.NEW, EndpointChange.RESTARTED}
        # A heartbeat by unicast says that its sender hears no multicast of ours; if we hear none of its either
        # our own heartbeat goes there by unicast anyway.
        deaf = not multicast and now - voice.multicast_at <= limits.MULTICAST_SILENCE
        if unknown or deaf or beacon.kind is BeaconKind.ANNOUNCE:
            self._send_answer(voice, now)

    def _send_answer(self, voice: PeerInstance, now: float) -> None:
        gossip: tuple[Guid, ...] | None = None
        for address in _addresses(voice):
            if self._answers.allows(address, now):
                gossip = self._gossip(self._seats.present(), voice, now) if gossip is None else gossip
                self._send(BeaconKind.ANSWER, address, gossip)
            else:
                self.counters.add("beacon.answer_limited")

    def _presume(self, voice: PeerInstance, beacon: Beacon, source: Address, now: float, *, greeted: bool) -> None:
        """Whoever answers without having been greeted has heard our multicast: expect to hear its, for a while."""
        if greeted:
            voice.found_by = HeardBy.GOSSIP
        elif beacon.kind is BeaconKind.ANSWER and self._multicast and source not in self._seeds:
            voice.multicast_at = now - limits.HEARTBEAT_INTERVAL

    def _hearsay(self, beacon: Beacon, now: float) -> None:
        """Greet those whom the sender knows and we do not; only their own word puts them into the roster."""
        for guid in beacon.gossip:
            if guid.place in self._seats or (guid.is_loopback and not self._own.guid.is_loopback):
                continue
            if not self._greetings.learn(guid.endpoint, now):
                self.counters.add("gossip.full")
        for address in self._unmet(beacon.elsewhere):
            if not self._greetings.learn(address, now):
                self.counters.add("gossip.full")
        for address in self._greetings.due(now):
            self._send(BeaconKind.ANNOUNCE, address)

    def _unmet(self, addresses: tuple[Address, ...]) -> list[Address]:
        """Those of some addresses at which nobody is whom we know, ourselves included."""
        if not addresses:
            return []
        met = {*self._own.endpoints}
        for voice in self._seats.present():
            met.update(voice.identity.endpoints, _addresses(voice))
        near = self._own.guid.is_loopback
        return [a for a in addresses if a not in met and (near or not a[0].startswith("127."))]

    def _gossip(self, voices: list[PeerInstance], to: PeerInstance | None, now: float) -> tuple[Guid, ...]:
        identity = to.identity if to is not None else self._own
        return self._gossip_turn.choose(voices, to, now, near=identity.guid.is_loopback)

    # --- small reads ------------------------------------------------------------------------------------------

    def _unheard_by_multicast(self, now: float) -> list[PeerInstance]:
        """Peers that get their heartbeats by unicast."""
        silence = limits.MULTICAST_SILENCE
        return [v for v in self._seats.present() if not self._multicast or now - v.multicast_at > silence]

    def _burst_times(self, now: float, offsets: tuple[float, ...]) -> list[float]:
        return [now + offset + (limits.BURST_JITTER * self._rng() if offset else 0.0) for offset in offsets]

    def _next_heartbeat(self, now: float) -> float:
        return now + limits.HEARTBEAT_INTERVAL * (1.0 - limits.HEARTBEAT_JITTER * self._rng())

    def _view(self, seat: Endpoint, voice: PeerInstance) -> PeerView:
        conflicts = []
        if seat.conflict and seat.current is not None:
            rivals = seat.rivals()
            other = seat.current if voice is not seat.current else rivals[0] if rivals else voice
            kind = ConflictKind.OWN_GUID if seat.own else ConflictKind.GUID
            conflicts.append(str(PeerConflict(kind, voice.identity, other.identity)))
        conflicts += [
            str(PeerConflict(ConflictKind.NAME, one.identity, other.identity))
            for one, other in (self._namesakes(seat) if voice is seat.current else ())
        ]
        return PeerView(
            voice.identity,
            voice.since,
            voice.heard,
            voice.found_by,
            voice.heard_by if not voice.linked else HeardBy.LINK,
            voice.source,
            voice.linked,
            tuple(conflicts),
            seat.present and voice is seat.current,
        )


def _addresses(voice: PeerInstance) -> tuple[Address, ...]:
    """Where a peer's unicast goes: its GUID's endpoint, and where its packets come from if that differs."""
    endpoint, source = voice.identity.guid.endpoint, voice.source
    return (endpoint,) if source is None or source == endpoint else (endpoint, source)
