"""The membership protocol: which peers are there, by beacons and links alone (paper, section 4.3). Sans-I/O.

Inputs are ``start``, ``receive``, ``link_up``, ``link_down``, ``interfaces_changed``, ``set_seeds`` and
``handle_timer``; after each of them take ``outputs()`` (beacons to send) and ``events()`` (what happened).

Members are kept by heartbeats with a lease, or by their links. Gossip tells of further peers; a peer only becomes a
member by a beacon of its own or a link, never because another peer says so.
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.counters import Counters, earliest
from rmpa.core.identity import Identity
from rmpa.discovery import limits
from rmpa.discovery.announcing import BeaconSender, GossipCandidates, LateAnswers, dissemination_interval, is_many
from rmpa.discovery.beacon import (
    Address,
    Beacon,
    BeaconKind,
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
    RunDoubted,
)
from rmpa.discovery.endpoints import Endpoint, EndpointChange, EndpointTable, PeerInstance

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from ipaddress import IPv4Address

    from rmpa.core.identity import Guid
    from rmpa.discovery.beacon import PeerView

_NEVER: Final = float("-inf")


class MembershipProtocol:
    """The peers of one domain, as one agent knows them.

    Args:
        identity: This agent's own.
        rng: Uniform numbers in [0, 1), for jitter; seeded by simulations.
        multicast: Whether to send to the group at all.
        lease: Seconds of silence after which peers may count this agent as gone.
        counters: Where refusals are counted.
    """

    def __init__(
        self,
        identity: Identity,
        *,
        rng: Callable[[], float],
        multicast: bool = True,
        lease: float = core_limits.PEER_LEASE,
        counters: Counters | None = None,
    ) -> None:
        self.counters = counters if counters is not None else Counters()
        self._rng = rng
        self._endpoints = EndpointTable()
        self._sender = BeaconSender(identity, self._endpoints, lease, self.counters, multicast=multicast)
        self._reported_names: set[frozenset[bytes]] = set()
        self._late_answers = LateAnswers(rng)
        self._candidates = GossipCandidates(rng)
        self._seeds: tuple[Address, ...] = ()
        self._burst: list[float] = []
        self._heartbeat_at: float | None = None
        self._disseminate_at: float | None = None
        self._disseminated_at = _NEVER
        self._unicasts: dict[int, PeerInstance] = {}
        """The peers that get a heartbeat by unicast now, by place."""
        self._unicast_at = _NEVER
        self._events: list[Event] = []

    # --- inputs -----------------------------------------------------------------------------------------------

    def start(self, now: float) -> None:
        """Announce this agent: a burst of beacons, then only heartbeats."""
        own = PeerInstance(self._sender.identity, now, now, core_limits.PEER_LEASE, HeardBy.LINK, HeardBy.LINK)
        own.linked = own.verified = True
        self._endpoints.add(self._sender.identity.guid.place, Endpoint(own, own=True))
        self._burst = self._burst_times(now, limits.BURST_OFFSETS)
        self._heartbeat_at = self._next_heartbeat(now)
        self.handle_timer(now)

    def receive(self, beacon: Beacon, source: Address, now: float, *, multicast: bool) -> None:
        """Take in one beacon.

        Args:
            beacon: As parsed; of this domain.
            source: The packet's source address and port.
            now: Monotonic seconds.
            multicast: Whether it came to the group, or else to this agent's own port.
        """
        identity = beacon.identity
        if self._sender.closed or identity.instance == self._sender.identity.instance:
            self.counters.add("beacon.echo")
            return
        key = identity.guid.place
        endpoint = self._endpoints.get(key)
        if endpoint is None:
            if self._endpoints.is_full and not self._evict(now - limits.HEARTBEAT_LATE):
                self.counters.add("roster.full")
                return
            endpoint = self._endpoints.add(key, Endpoint())
        previous = endpoint.current.identity if endpoint.current is not None else None
        change = endpoint.receive(beacon, now, source, multicast=multicast)
        if change in {EndpointChange.KNOWN, EndpointChange.STALE}:
            self._endpoints.heard(key)
        else:
            self._endpoints.changed(key)
        addresses = {identity.guid.endpoint, source} if self._candidates else ()
        candidates = [self._candidates.answered(address) for address in addresses]
        self._apply(endpoint, change, now, previous=previous, source=source)
        if (
            change in {EndpointChange.NEW, EndpointChange.RESTARTED}
            and not multicast
            and endpoint.current is not None
        ):
            self._infer_multicast(endpoint.current, beacon, source, now, was_candidate=any(candidates))
        if change is EndpointChange.STALE:
            self.counters.add("beacon.late")
        elif change in {EndpointChange.NEW, EndpointChange.RESTARTED, EndpointChange.KNOWN, EndpointChange.CHANGED}:
            self._answer_if_unknown(endpoint, change, beacon, now, multicast=multicast)
            if beacon.gossip or beacon.observed:
                self._apply_gossip(beacon, now)
        self._remove_if_empty(key)

    def recognise(self, beacon: Beacon, source: Address, key: int) -> None:
        """Tell a module that has only an older group key of a secured mesh where this agent is.

        It was away, or it was revoked, which its certificate shows when it dials. Until then nothing is known of it
        here: what it says of itself and of others counts nowhere.

        Args:
            beacon: What it sent.
            source: The packet's source address and port.
            key: The low 16 bits of the number of its group key, by which the answer is signed.
        """
        if beacon.identity.instance == self._sender.identity.instance:
            self.counters.add("beacon.echo")
        elif beacon.kind in {BeaconKind.ANNOUNCE, BeaconKind.HEARTBEAT}:
            self._sender.send(BeaconKind.ANSWER, source, key=key)

    def link_up(self, identity: Identity, now: float, source: Address | None = None) -> None:
        """Take in a peer whose link is up: it is a member for as long as the link is up, even if it is silent.

        Args:
            identity: As in the link's handshake.
            now: Monotonic seconds.
            source: Where beacons can be sent to it, if that is known to differ from its GUID's endpoint.
        """
        key = identity.guid.place
        endpoint = self._endpoints.get(key)
        if endpoint is None:
            if len(self._endpoints) >= core_limits.PEERS_MAX and not self._evict():
                self.counters.add("roster.full")
                return
            endpoint = self._endpoints.add(key, Endpoint())
        if endpoint.own:
            self.counters.add("roster.own_link")
            return
        previous = endpoint.current.identity if endpoint.current is not None else None
        change = endpoint.link_up(identity, now)
        self._endpoints.changed(key)
        if source is not None and endpoint.current is not None:
            endpoint.current.source = source
        self._candidates.answered(identity.guid.endpoint)
        self._late_answers.discard(key)
        self._apply(endpoint, change, now, previous=previous, source=source)
        if not endpoint.present:
            self._peer_found(endpoint, now)

    def link_down(self, guid: Guid, now: float, instance: bytes | None = None) -> None:
        """Handle the end of the link to a peer, whose lease begins now.

        Args:
            guid: The peer's.
            now: Monotonic seconds.
            instance: The run's; the link of a run that was superseded meanwhile changes nothing.
        """
        key = guid.place
        endpoint = self._endpoints.get(key)
        if endpoint is None or endpoint.own or endpoint.current is None:
            return
        previous = endpoint.current.identity
        if instance is not None and previous.instance != instance:
            return
        change = endpoint.link_down(now)
        self._endpoints.changed(key)
        if change is EndpointChange.CONFLICT:
            self._peer_lost(endpoint, LossReason.CONFLICT)
            return
        source = endpoint.current.source
        self._apply(endpoint, change, now, previous=previous, source=source)
        if change is EndpointChange.RESTARTED:
            self._sender.send_answer(endpoint.current, now)
        self._remove_if_empty(key)

    def interfaces_changed(self, now: float, addresses: tuple[IPv4Address, ...] | None = None) -> None:
        """Announce this agent again after a change of interfaces, with its present addresses if they are given."""
        if self._sender.closed:
            return
        if addresses is not None:
            own = self._sender.identity
            self._sender.identity = Identity(own.guid, own.instance, own.name, own.domain, addresses)
        self._burst = self._burst_times(now, limits.BURST_AGAIN_OFFSETS)
        self.handle_timer(now)

    def set_seeds(self, seeds: Iterable[Address]) -> None:
        """Send announcements to these addresses, now and with each heartbeat; they replace the former seeds."""
        known = self._seeds
        self._seeds = tuple(dict.fromkeys(seeds))
        if self._heartbeat_at is not None:
            for address in self._seeds:
                if address not in known:
                    self._sender.send(BeaconKind.ANNOUNCE, address)

    def goodbye(self, now: float) -> None:
        """Send a goodbye to the peers; afterwards nothing is sent, and beacons are ignored."""
        if self._sender.closed or self._heartbeat_at is None:
            return
        self._sender.send_goodbye(self._sender.unheard_by_multicast(now))

    def next_timer(self) -> float | None:
        """When to call ``handle_timer``, in seconds of the clock; ``None``: never."""
        if self._sender.closed:
            return None
        return earliest(
            self._heartbeat_at,
            self._disseminate_at,
            self._late_answers.at,
            self._unicast_at if self._unicasts else None,
            self._burst[0] if self._burst else None,
            self._candidates.next_timer(),
            self._endpoints.next_timer(),
        )

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        if self._sender.closed or self._heartbeat_at is None:
            return
        self._expire_leases(now)
        if self._burst and self._burst[0] <= now:
            self._burst = [at for at in self._burst if at > now]
            self._send_multicast(BeaconKind.ANNOUNCE, now)
            for address in self._seeds:
                self._sender.send(BeaconKind.ANNOUNCE, address)
        if self._heartbeat_at <= now:
            self._heartbeat_at = self._next_heartbeat(now)
            self._send_multicast(BeaconKind.HEARTBEAT, now)
            self._plan_unicast_heartbeats(now)
            met = {address for peer in self._endpoints.present() for address in peer.addresses} if self._seeds else ()
            for address in self._seeds:
                if address not in met:
                    self._sender.send(BeaconKind.ANNOUNCE, address)
        if self._disseminate_at is not None and self._disseminate_at <= now:
            self._disseminate(now)
        self._send_late_answers(now)
        for place in tuple(islice(self._unicasts, limits.UNICAST_HEARTBEATS_AT_ONCE)):
            peer = self._unicasts.pop(place)
            gossip = self._sender.gossip(self._endpoints.present(), peer, now)
            for address in peer.addresses:
                self._sender.send(BeaconKind.HEARTBEAT, address, gossip)
        for address in self._candidates.take_due(now):
            self._sender.send(BeaconKind.ANNOUNCE, address)

    # --- outputs and views ------------------------------------------------------------------------------------

    def outputs(self) -> list[Output]:
        """The beacons to send, in order; each is returned once."""
        return self._sender.take()

    def events(self) -> list[Event]:
        """What happened, in order; each event is returned once."""
        taken, self._events = self._events, []
        return taken

    def peers(self) -> tuple[PeerView, ...]:
        """All peers in GUID order, those included that a conflict keeps from being members."""
        return self._endpoints.views()

    @property
    def members(self) -> int:
        """The number of peers that are present."""
        return len(self._endpoints.present())

    def silent_seeds(self) -> list[Address]:
        """The seeds at whose address there is no member."""
        met = {host for peer in self._endpoints.present() for host, _ in peer.addresses}
        return [seed for seed in self._seeds if seed[0] not in met]

    def is_verified(self, guid: Guid, instance: bytes) -> bool:
        """Whether this run of a peer has or had a link; this agent itself counts as linked."""
        endpoint = self._endpoints.get(guid.place)
        peer = endpoint.current if endpoint is not None else None
        return peer is not None and peer.verified and peer.identity.instance == instance

    @property
    def identity(self) -> Identity:
        """This agent's own, as the next beacon will carry it."""
        return self._sender.identity

    # --- changes to events ------------------------------------------------------------------------------------

    def _apply(
        self,
        endpoint: Endpoint,
        change: EndpointChange,
        now: float,
        *,
        previous: Identity | None,
        source: Address | None,
    ) -> None:
        current = endpoint.current
        if current is None:
            return
        if change is EndpointChange.KNOWN and endpoint.present:
            self._report_name_conflict(endpoint)
        elif change is EndpointChange.NEW:
            self._peer_found(endpoint, now)
        elif change is EndpointChange.CHANGED and previous is not None and endpoint.present:
            self._events.append(PeerChanged(current.identity, previous))
            self._report_name_conflict(endpoint)
        elif change is EndpointChange.RESTARTED and previous is not None:
            if endpoint.present:
                self._events.append(PeerRestarted(current.identity, previous, source))
                self._report_name_conflict(endpoint)
                self._schedule_dissemination(now)
            elif not endpoint.conflict:
                self._peer_found(endpoint, now)
        elif change is EndpointChange.LEAVING:
            self._run_leaves(endpoint, current, now)
        elif change is EndpointChange.CONFLICT:
            kind = ConflictKind.OWN_GUID if endpoint.own else ConflictKind.GUID
            rival = max(endpoint.rivals(), key=lambda v: v.heard)
            self._events.append(PeerConflict(kind, rival.identity, current.identity))
            if not current.linked:
                self._peer_lost(endpoint, LossReason.CONFLICT)
        elif change is EndpointChange.WAITING:
            self._run_waits(endpoint, current, now)

    def _run_leaves(self, endpoint: Endpoint, current: PeerInstance, now: float) -> None:
        """The current run said goodbye; its link, while it stands, is stronger evidence than a packet."""
        if current.linked:
            self._events.append(RunDoubted(current.identity))
            return
        self._peer_lost(endpoint, LossReason.GOODBYE)
        endpoint.remove_current()
        self._clear_conflict(endpoint, now)
        self._endpoints.changed(current.identity.guid.place)

    def _run_waits(self, endpoint: Endpoint, current: PeerInstance, now: float) -> None:
        if current.linked and not endpoint.own:
            self._events.append(RunDoubted(current.identity))
        self._clear_conflict(endpoint, now)
        self._endpoints.changed(current.identity.guid.place)

    def _peer_found(self, endpoint: Endpoint, now: float) -> None:
        peer = endpoint.current
        if peer is None or endpoint.own:
            return
        endpoint.present = True
        peer.since = now
        self._endpoints.changed(peer.identity.guid.place)
        self._events.append(PeerFound(peer.identity, peer.source, peer.found_by))
        self._remove_predecessors(endpoint, peer)
        self._report_name_conflict(endpoint)
        self._schedule_dissemination(now)

    def _peer_lost(self, endpoint: Endpoint, reason: LossReason) -> None:
        if endpoint.present and endpoint.current is not None:
            endpoint.present = False
            self._endpoints.changed(endpoint.current.identity.guid.place)
            self._events.append(PeerLost(endpoint.current.identity, reason))
            self._reported_names = {
                pair for pair in self._reported_names if endpoint.current.identity.instance not in pair
            }

    def _remove_predecessors(self, endpoint: Endpoint, peer: PeerInstance) -> None:
        """Remove the former run of an agent that was killed and started again at another port.

        It has the same name and address, and no link. If it is alive after all, its next beacon brings it back.
        """
        for other in self._endpoints.with_name(peer.identity.name):
            former = other.current
            if (
                former is not None
                and other is not endpoint
                and not other.own
                and not former.linked
                and former.heard < peer.since
                and former.identity.guid.address == peer.identity.guid.address
            ):
                key = former.identity.guid.place
                self._peer_lost(other, LossReason.MOVED)
                other.remove_current()
                self._endpoints.changed(key)
                self._remove_if_empty(key)

    def _report_name_conflict(self, endpoint: Endpoint) -> None:
        """Report once that two peers share a name, if both are certainly alive."""
        for one, other in self._endpoints.same_name(endpoint):
            pair = frozenset({one.identity.instance, other.identity.instance})
            if pair not in self._reported_names:
                self._reported_names.add(pair)
                self._events.append(PeerConflict(ConflictKind.NAME, one.identity, other.identity))
                return

    def _clear_conflict(self, endpoint: Endpoint, now: float) -> None:
        """Report that a conflict is over, after a run of this endpoint fell silent or left."""
        endpoint.expire_others(now)
        if endpoint.conflict and endpoint.current is not None and not endpoint.rivals():
            endpoint.conflict = False
            kind = ConflictKind.OWN_GUID if endpoint.own else ConflictKind.GUID
            self._events.append(ConflictCleared(kind, endpoint.current.identity))
            if not endpoint.present:
                self._peer_found(endpoint, now)
                if not endpoint.own:
                    self._sender.send_answer(endpoint.current, now)

    def _expire_leases(self, now: float) -> None:
        for key in self._endpoints.take_expired(now):
            endpoint = self._endpoints.get(key)  # handling an earlier one may have removed it
            if endpoint is None:
                continue
            peer = endpoint.current
            if peer is not None and peer.linked and peer.deadline <= now and not endpoint.own:
                peer.doubted = True  # a link at rest would notice much later that its peer is gone
                self._events.append(RunDoubted(peer.identity))
            elif peer is not None and not peer.linked and peer.deadline <= now:
                self._peer_lost(endpoint, LossReason.SILENCE)
                endpoint.remove_current()
                if peer.multicast_at + limits.MULTICAST_SILENCE < now:
                    # Multicast does not reach this peer, so after a network failure announcements must find it again.
                    self._candidates.add(peer.identity.guid.endpoint, now)
            self._clear_conflict(endpoint, now)
            self._endpoints.changed(key)
            self._remove_if_empty(key)

    def _remove_if_empty(self, key: int) -> None:
        endpoint = self._endpoints.get(key)
        if endpoint is not None and endpoint.current is None and not endpoint.others:
            self._endpoints.remove(key)

    def _evict(self, silent_since: float | None = None) -> bool:
        """Make room for a linked peer: the unlinked one that has been silent for longest goes, if there is one.

        Args:
            silent_since: For a peer that is only heard: one goes that was never linked, and not heard since then.
        """
        place = self._endpoints.oldest_unlinked(silent_since)
        endpoint = self._endpoints.get(place) if place is not None else None
        if place is None or endpoint is None:
            return False
        self._peer_lost(endpoint, LossReason.SILENCE)
        self._endpoints.remove(place)
        return True

    # --- sending ----------------------------------------------------------------------------------------------

    def _send_multicast(self, kind: BeaconKind, now: float) -> None:
        self._sender.send_multicast(kind, now)
        self._late_answers.clear()  # all have got this beacon

    def _plan_unicast_heartbeats(self, now: float) -> None:
        """Queue unicast heartbeats, with gossip about all peers, for the peers that multicast does not reach."""
        self._unicasts |= {peer.identity.guid.place: peer for peer in self._sender.unheard_by_multicast(now)}
        self._unicast_at = now

    def _disseminate(self, now: float) -> None:
        """Send heartbeats early, so that their gossip reports newly found peers."""
        self._disseminate_at = None
        self._disseminated_at = now
        self._plan_unicast_heartbeats(now)
        if self._sender.unheard_by_multicast(now):
            self._send_multicast(BeaconKind.HEARTBEAT, now)

    def _schedule_dissemination(self, now: float) -> None:
        """Schedule gossip about a found peer for the peers that multicast does not reach."""
        members = len(self._endpoints.present())
        if self._disseminate_at is None and self._heartbeat_at is not None and members > 1:
            self._disseminate_at = max(now, self._disseminated_at + dissemination_interval(members))

    def _answer_if_unknown(
        self, endpoint: Endpoint, change: EndpointChange, beacon: Beacon, now: float, *, multicast: bool
    ) -> None:
        """Answer a sender that does not know this agent, or may not."""
        peer = endpoint.current
        if peer is None or peer.linked or endpoint.conflict or beacon.kind is BeaconKind.ANSWER:
            return
        unknown = change in {EndpointChange.NEW, EndpointChange.RESTARTED}
        # A unicast heartbeat means that its sender receives none of this agent's multicasts. If this agent receives
        # none of the sender's either, its own heartbeats go there by unicast anyway.
        deaf = not multicast and now - peer.multicast_at <= limits.MULTICAST_SILENCE
        if not (unknown or deaf or beacon.kind is BeaconKind.ANNOUNCE):
            return
        if not (multicast and self._sender.multicast and is_many(self.members)):
            self._sender.send_answer(peer, now)
        elif self._burst:
            self.counters.add("beacon.answer_spared")  # the next beacon of this agent's own burst tells the sender
        else:
            self._late_answers.add(peer.identity.guid.place, self.members, now)

    def _send_late_answers(self, now: float) -> None:
        """Answer the newcomers of a large mesh that got no link meanwhile."""
        places = self._late_answers.take(now)
        if len(places) >= limits.ANSWERS_TOGETHER:
            self._send_multicast(BeaconKind.HEARTBEAT, now)
            return
        for place in places:
            if (endpoint := self._endpoints.get(place)) is not None and (peer := endpoint.current) is not None:
                gossip = self._sender.gossip(self._sender.unheard_by_multicast(now), peer, now)
                self._sender.send_answer(peer, now, gossip)

    def _infer_multicast(
        self, peer: PeerInstance, beacon: Beacon, source: Address, now: float, *, was_candidate: bool
    ) -> None:
        """Infer how a peer was found whose first beacon came by unicast.

        A gossip candidate was found by gossip. A peer that answers without being asked has received a multicast of
        this agent; for a while its own multicasts are expected here too.
        """
        if was_candidate:
            peer.found_by = HeardBy.GOSSIP
        elif beacon.kind is BeaconKind.ANSWER and self._sender.multicast and source not in self._seeds:
            peer.multicast_at = now - limits.HEARTBEAT_INTERVAL

    def _apply_gossip(self, beacon: Beacon, now: float) -> None:
        """Announce this agent to unknown peers of the sender."""
        for address in self._endpoints.unknown_addresses(beacon.observed, self._sender.identity):
            if not self._candidates.add(address, now):
                self.counters.add("gossip.full")
        for guid in beacon.gossip:
            if guid.place in self._endpoints or (guid.is_loopback and not self._sender.identity.guid.is_loopback):
                continue
            if not self._candidates.add(guid.endpoint, now):
                self.counters.add("gossip.full")
        for address in self._candidates.take_due(now):
            self._sender.send(BeaconKind.ANNOUNCE, address)

    # --- queries ----------------------------------------------------------------------------------------------

    def _burst_times(self, now: float, offsets: tuple[float, ...]) -> list[float]:
        return [now + offset + (limits.BURST_JITTER * self._rng() if offset else 0.0) for offset in offsets]

    def _next_heartbeat(self, now: float) -> float:
        return now + limits.HEARTBEAT_INTERVAL * (1.0 - limits.HEARTBEAT_JITTER * self._rng())
