"""The membership protocol: which peers are there, by beacons and links alone (paper, section 4.3). Sans-I/O.

Inputs are ``start``, ``receive``, ``link_up``, ``link_down``, ``interfaces_changed``, ``set_seeds`` and
``handle_timer``; after each of them take ``outputs()`` (beacons to send) and ``events()`` (what happened).

Members are kept by heartbeats with a lease, or by their links. Gossip tells of further peers; a peer only becomes a
member by a beacon of its own or a link, never because another peer says so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Final, Literal

from rmpa.core import limits as core_limits
from rmpa.core.statistics import Counters
from rmpa.core.timers import earliest
from rmpa.discovery import limits
from rmpa.discovery.beacon import Address, Beacon, BeaconKind
from rmpa.discovery.endpoints import (
    LINKED,
    NEVER,
    BeaconSender,
    Endpoint,
    EndpointTable,
    GossipCandidates,
    PeerInstance,
    shared_address,
    shared_name,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from ipaddress import IPv4Address

    from rmpa.core.identity import Guid, Identity
    from rmpa.discovery.endpoints import OutgoingBeacon

# When a starting agent announces itself, in seconds after its start: Wi-Fi loses multicast, so one beacon is not
# enough.
BURST_OFFSETS: Final = (0.0, 0.1, 0.3, 0.7)
# Paper, section 4.3: "each five seconds a heartbeat will check that network is still alive".
HEARTBEAT_INTERVAL: Final = 5.0
# The shorter burst of beacons after a change of interfaces: most listeners know the agent already.
BURST_AGAIN_OFFSETS: Final = (0.0, 0.2, 0.6)
# The longest random delay of each but the first beacon of a burst: modules on one power switch start together.
BURST_JITTER: Final = 0.05

# The largest random part of the interval by which a heartbeat is sent early, because modules start together.
_HEARTBEAT_JITTER: Final = 0.1
# Newcomers of a large mesh that wait for an answer at one time, from which on one multicast answers all of them: it
# costs each member one packet to read, as much as the answers would cost their senders.
_ANSWERS_TOGETHER: Final = 8
# Newly found peers are gathered for this long before peers without multicast are notified; the first at once.
_DISSEMINATION_INTERVAL: Final = 0.5
# Early heartbeats a second, of all members of a large mesh together: while a thousand agents start, each of them
# finds new peers all the time. So it is for announcements in a flood.
_DISSEMINATIONS_PER_SECOND: Final = 100.0
# Unicast heartbeats, to linked and unlinked peers, in one run of the timer; each takes up to 0.3 ms.
_UNICAST_HEARTBEATS_AT_ONCE: Final = 2

SILENCE: Final = "silent for its lease"
GOODBYE: Final = "said goodbye"
RESTARTED: Final = "started again"
MOVED: Final = "started again at another port"
CONFLICT: Final = "another live peer has its GUID address"


@dataclass(frozen=True, slots=True)
class PeerEvent:
    """Something that happened to a peer.

    Args:
        change: ``found``: it has become a member. ``changed``: the same run has other addresses or another name.
            ``lost``: it is no member any more. ``doubted``: its link is worth a check, as it may have restarted or be
            gone. ``conflict``: it and another live peer claim one GUID address or name; reported once until that is
            over.
        identity: The peer's.
        source: Of one that is found: where its last packet came from; ``None`` if only a link has shown it.
        reason: Why it is lost: ``SILENCE`` and so on. Of a conflict: ``guid``, ``own_guid`` or ``name``, which both
            have.
        text: Of a conflict: what happened and what to do, for the user.
    """

    change: Literal["found", "changed", "lost", "doubted", "conflict"]
    identity: Identity
    source: Address | None = None
    reason: str = ""
    text: str = ""


class MembershipProtocol:
    """The peers of one domain, as one agent knows them.

    Its fields are more than twelve: six are the times at which something is due.

    Args:
        identity: This agent's own.
        rng: Uniform numbers in [0, 1), for jitter; seeded by simulations.
        multicast: Whether to send to the group at all.
        counters: Where refusals are counted.

    Attributes:
        endpoints: The peers, also those that a conflict keeps from being members.
    """

    def __init__(
        self,
        identity: Identity,
        *,
        rng: Callable[[], float],
        multicast: bool = True,
        counters: Counters | None = None,
    ) -> None:
        self.counters = counters if counters is not None else Counters()
        self._rng = rng
        self.endpoints = EndpointTable()
        self._sender = BeaconSender(identity, self.endpoints, self.counters, multicast)
        self._candidates = GossipCandidates(rng)
        self._reported_names: set[frozenset[bytes]] = set()
        self._seeds: tuple[Address, ...] = ()
        self._burst: list[float] = []
        self._heartbeat_at: float | None = None
        self._disseminate_at: float | None = None
        self._disseminated_at = NEVER
        # The peers that get a heartbeat by unicast now, by place.
        self._unicasts: dict[int, PeerInstance] = {}
        self._unicast_at = NEVER
        # The places of newcomers of a large mesh that wait for an answer, oldest first.
        self._late_answers: dict[int, None] = {}
        self._late_answers_at = NEVER
        self._events: list[PeerEvent] = []

    def start(self, now: float) -> None:
        """Announce this agent: a burst of beacons, then only heartbeats."""
        identity = self._sender.identity
        own = PeerInstance(identity, now, now, "link", linked_until=LINKED)
        self.endpoints[identity.guid.place] = Endpoint({identity.instance: own}, own, own=True)
        self.endpoints.index(identity.guid.place)
        self._burst = self._burst_times(now, BURST_OFFSETS)
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
        place = identity.guid.place
        endpoint = self.endpoints.get(place)
        if endpoint is None:
            if not self._has_room(now):
                self.counters.add("roster.full")
                return
            endpoint = self.endpoints[place] = Endpoint()
        gossiped = [self._candidates.answered(address) for address in {identity.guid.endpoint, source}]
        steady = self.endpoints.is_steady(endpoint, beacon)
        run = endpoint.hear(beacon, source, now, multicast=multicast)
        if run is None:
            self.counters.add("beacon.late")
            self.endpoints.index(place)
            return
        # Most heartbeats change nothing but the end of the lease, at which it is settled anyway.
        steady = steady and run.goodbye is None and run.identity == endpoint.member
        found = not steady and self._settle(place, now)
        current = endpoint.current
        if run is not current or run.goodbye is not None:
            if current is not None and current.linked and not endpoint.own:
                self._events.append(PeerEvent("doubted", current.identity))
            if found and current is not None:  # it was in conflict with the run that spoke
                self._sender.send_answer(current, now)
            return
        if found and not multicast:
            self._infer_multicast(run, beacon, source, now, was_candidate=any(gossiped))
        self._answer_if_unknown(endpoint, beacon, now, found=found, multicast=multicast)
        if beacon.gossip or beacon.observed:
            self._apply_gossip(beacon, now)

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
        place = identity.guid.place
        endpoint = self.endpoints.get(place)
        if endpoint is None:
            if not self._has_room(now, linked=True):
                self.counters.add("roster.full")
                return
            endpoint = self.endpoints[place] = Endpoint()
        if endpoint.own:
            self.counters.add("roster.own_link")
            return
        run = endpoint.link_up(identity, now)
        run.source = source or run.source
        self._candidates.answered(identity.guid.endpoint)
        self._late_answers.pop(place, None)
        self._settle(place, now)

    def link_down(self, guid: Guid, now: float, instance: bytes | None = None) -> None:
        """Handle the end of the link to a peer, whose lease begins now.

        Args:
            guid: The peer's.
            now: Monotonic seconds.
            instance: The run's; the link of a run that was superseded meanwhile changes nothing.
        """
        endpoint = self.endpoints.get(guid.place)
        run = endpoint.current if endpoint is not None and not endpoint.own else None
        if run is None or not run.linked or (instance is not None and run.identity.instance != instance):
            return
        run.linked_until = now
        self._settle(guid.place, now, answer=True)

    def interfaces_changed(self, now: float, addresses: tuple[IPv4Address, ...]) -> None:
        """Announce this agent again after a change of interfaces, with its present addresses."""
        if not self._sender.closed:
            self._sender.identity = replace(self._sender.identity, addresses=addresses)
            self._burst = self._burst_times(now, BURST_AGAIN_OFFSETS)
            self.handle_timer(now)

    def beacons_lost(self, now: float) -> None:
        """Announce this agent again soon: in a flood, sockets lose most of the beacons of members.

        The flood of a group reaches each member. Of 20,000 packets a second an agent reads one in five, and the
        beacons of a start are all lost in two starts of five; of two a second some are read within seconds.
        """
        if not self._burst and self._heartbeat_at is not None:
            self._burst = self._burst_times(now, (self._early_interval(),))

    def set_seeds(self, seeds: Iterable[Address]) -> None:
        """Send announcements to these addresses, now and with each heartbeat; they replace the former seeds."""
        known, self._seeds = self._seeds, tuple(dict.fromkeys(seeds))
        if self._heartbeat_at is not None:
            self._announce(address for address in self._seeds if address not in known)

    def goodbye(self, now: float) -> None:
        """Send a goodbye to the peers; afterwards nothing is sent, and beacons are ignored."""
        if not self._sender.closed and self._heartbeat_at is not None:
            self._sender.send_goodbye(self._sender.unheard_by_multicast(now))

    def next_timer(self) -> float | None:
        """When to call ``handle_timer``, in seconds of the clock; ``None``: never."""
        if self._sender.closed:
            return None
        return earliest(
            self._heartbeat_at,
            self._disseminate_at,
            self._late_answers_at if self._late_answers else None,
            self._unicast_at if self._unicasts else None,
            self._burst[0] if self._burst else None,
            self._candidates.next_timer(),
            self.endpoints.timers.next(),
        )

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        if self._sender.closed or self._heartbeat_at is None:
            return
        self._expire_leases(now)
        if self._burst and self._burst[0] <= now:
            self._burst = [at for at in self._burst if at > now]
            self._send_multicast(BeaconKind.ANNOUNCE, now)
            self._announce(self._seeds)
        if self._heartbeat_at <= now:
            self._heartbeat_at = self._next_heartbeat(now)
            self._send_multicast(BeaconKind.HEARTBEAT, now)
            self._plan_unicast_heartbeats(now)
            met = {address for peer in self._members() for address in peer.addresses} if self._seeds else ()
            self._announce(address for address in self._seeds if address not in met)
        if self._disseminate_at is not None and self._disseminate_at <= now:
            # Heartbeats are sent early, so that their gossip reports newly found peers.
            self._disseminate_at, self._disseminated_at = None, now
            self._plan_unicast_heartbeats(now)
            if self._sender.unheard_by_multicast(now):
                self._send_multicast(BeaconKind.HEARTBEAT, now)
        if self._late_answers and self._late_answers_at <= now:
            self._send_late_answers(now)
        known = self._sender.heard_lately(self._members(), now) if self._unicasts else ()
        for place in tuple(islice(self._unicasts, _UNICAST_HEARTBEATS_AT_ONCE)):
            peer = self._unicasts.pop(place)
            gossip = self._sender.gossip(known, peer)
            for address in peer.addresses:
                self._sender.send(BeaconKind.HEARTBEAT, address, gossip)
        self._announce(self._candidates.take_due(now))

    def outputs(self) -> list[OutgoingBeacon]:
        """The beacons to send, in order; each is returned once."""
        return self._sender.take()

    def events(self) -> list[PeerEvent]:
        """What happened, in order; each event is returned once."""
        taken, self._events = self._events, []
        return taken

    def silent_seeds(self) -> list[Address]:
        """The seeds at whose address there is no member."""
        met = {host for peer in self._members() for host, _ in peer.addresses} if self._seeds else ()
        return [seed for seed in self._seeds if seed[0] not in met]

    @property
    def size(self) -> int:
        """How many members there are."""
        return len(self.endpoints.members)

    def is_verified(self, guid: Guid, instance: bytes) -> bool:
        """Whether this run of a peer has or had a link; this agent itself counts as linked."""
        endpoint = self.endpoints.get(guid.place)
        peer = endpoint.current if endpoint is not None else None
        return peer is not None and peer.verified and peer.identity.instance == instance

    def _members(self) -> Iterable[PeerInstance]:
        return self.endpoints.members.values()

    def _settle(self, place: int, now: float, *, answer: bool = False) -> bool:
        """Decide anew about an endpoint, one of whose facts has changed, and report what is different.

        Args:
            place: The endpoint's.
            now: Monotonic seconds.
            answer: Whether a run that is a member from now on is told of this agent.

        Returns:
            Whether a run is a member that was none.
        """
        endpoint = self.endpoints[place]
        before, conflict = endpoint.member, endpoint.conflict
        endpoint.settle(now)
        run = endpoint.current
        if run is not None and endpoint.conflict and not conflict:
            rival = max(endpoint.others(), key=lambda other: other.heard).identity
            text = shared_address(rival, run.identity, own=endpoint.own)
            kind = "own_guid" if endpoint.own else "guid"
            self._events.append(PeerEvent("conflict", rival, reason=kind, text=text))
        if endpoint.own or (endpoint.conflict and run is not None and not run.linked):
            run = None  # a working link survives a conflict
        found = run is not None and (before is None or before.instance != run.identity.instance)
        if before is not None and (run is None or found):
            self._lost(endpoint, before)
        endpoint.member = run.identity if run is not None else None
        if run is not None and found:
            run.since = now
            self._events.append(PeerEvent("found", run.identity, run.source))
            self._remove_predecessors(endpoint, run)
        elif run is not None and run.identity != before:
            self._events.append(PeerEvent("changed", run.identity))
        self.endpoints.index(place)
        if run is not None:
            self._report_name_conflict(endpoint)
            if found:
                self._schedule_dissemination(now)
                if answer:
                    self._sender.send_answer(run, now)
        return found

    def _lost(self, endpoint: Endpoint, identity: Identity, reason: str = "") -> None:
        """Report that a run is no member any more, for a reason that its endpoint shows."""
        if not reason:
            run = endpoint.runs.get(identity.instance)
            if run is not None and run.goodbye is not None:
                reason = GOODBYE
            elif endpoint.conflict:
                reason = CONFLICT
            else:
                reason = SILENCE if endpoint.current is None else RESTARTED
        self._events.append(PeerEvent("lost", identity, reason=reason))
        self._reported_names = {pair for pair in self._reported_names if identity.instance not in pair}

    def _remove(self, place: int, reason: str) -> None:
        """Forget an endpoint whatever its facts are."""
        endpoint = self.endpoints[place]
        if endpoint.member is not None:
            self._lost(endpoint, endpoint.member, reason)
        self.endpoints.remove(place)

    def _remove_predecessors(self, endpoint: Endpoint, peer: PeerInstance) -> None:
        """Remove the former run of an agent that was killed and started again at another port, or the former place.

        It has the same name, the same address or instance, and no link. If it is alive after all, its next beacon
        brings it back.
        """
        for other in self.endpoints.with_name(peer.identity.name):
            former = other.current
            if (
                former is not None
                and other is not endpoint
                and not former.linked
                and former.last_seen < peer.since
                and (
                    former.identity.guid.address == peer.identity.guid.address
                    or former.identity.instance == peer.identity.instance
                )
            ):
                self._remove(former.identity.guid.place, MOVED)

    def _report_name_conflict(self, endpoint: Endpoint) -> None:
        """Report once that two peers share a name, if both are certainly alive."""
        for one, other in self.endpoints.same_name(endpoint):
            pair = frozenset({one.identity.instance, other.identity.instance})
            if pair not in self._reported_names:
                self._reported_names.add(pair)
                text = shared_name(one.identity, other.identity)
                self._events.append(PeerEvent("conflict", one.identity, reason="name", text=text))
                return

    def _expire_leases(self, now: float) -> None:
        for place in sorted(self.endpoints.timers.take(now)):
            endpoint = self.endpoints.get(place)  # handling an earlier one may have removed it
            if endpoint is None:
                continue
            run = endpoint.current
            if run is not None and run.linked and run.deadline <= now and not endpoint.own:
                run.doubted = True  # a link at rest would notice much later that its peer is gone
                self._events.append(PeerEvent("doubted", run.identity))
            self._settle(place, now, answer=True)
            if run is not endpoint.current and run is not None and run.multicast_at + limits.MULTICAST_SILENCE < now:
                # Multicast does not reach this peer, so after a network failure announcements must find it again.
                self._candidates.add(run.identity.guid.endpoint, now)

    def _has_room(self, now: float, *, linked: bool = False) -> bool:
        """Whether there is room for one more peer, made by removing the unlinked one that was silent for longest.

        One that never had a link goes first. For a peer that is only heard none goes but one that never had a link
        and missed a heartbeat.
        """
        if len(self.endpoints) < (core_limits.PEERS_MAX if linked else limits.STRANGERS_MAX):
            return True
        strangers, unlinked = 0, []
        for place, endpoint in self.endpoints.items():  # some thousand, for each forged beacon: no property is asked
            run = endpoint.current
            had_link, seen = (False, NEVER) if run is None else (run.linked_until != NEVER, run.heard)
            strangers += not had_link
            if run is None or run.linked_until != LINKED:
                unlinked.append((had_link, max(seen, run.linked_until) if run is not None else seen, place))
        if not linked and strangers < limits.STRANGERS_MAX and len(self.endpoints) < core_limits.PEERS_MAX:
            return True
        had_link, seen, place = min(unlinked, default=(True, now, 0))
        if not unlinked or (not linked and (had_link or seen > now - limits.HEARTBEAT_LATE)):
            return False
        self._remove(place, SILENCE)
        return True

    def _announce(self, addresses: Iterable[Address]) -> None:
        for address in addresses:
            self._sender.send(BeaconKind.ANNOUNCE, address)

    def _send_multicast(self, kind: BeaconKind, now: float) -> None:
        self._sender.send_multicast(kind, now)
        self._late_answers.clear()  # all have got this beacon

    def _plan_unicast_heartbeats(self, now: float) -> None:
        """Queue unicast heartbeats, with gossip about all peers, for the peers that multicast does not reach."""
        self._unicasts |= {peer.identity.guid.place: peer for peer in self._sender.unheard_by_multicast(now)}
        self._unicast_at = now

    def _schedule_dissemination(self, now: float) -> None:
        """Schedule gossip about a found peer for the peers that multicast does not reach."""
        if self._disseminate_at is None and self._heartbeat_at is not None and len(self.endpoints.members) > 1:
            self._disseminate_at = max(now, self._disseminated_at + self._early_interval())

    def _early_interval(self) -> float:
        """Seconds between two beacons of this agent that are sent before the next heartbeat is due."""
        return max(_DISSEMINATION_INTERVAL, len(self.endpoints.members) / _DISSEMINATIONS_PER_SECOND)

    def _answer_if_unknown(
        self, endpoint: Endpoint, beacon: Beacon, now: float, *, found: bool, multicast: bool
    ) -> None:
        """Answer a sender that does not know this agent, or may not.

        In a large mesh the answers to multicasts would be a storm. Those to one newcomer are spread over a time that
        grows with the number of members; those to many newcomers become one multicast.
        """
        peer = endpoint.current
        if peer is None or peer.linked or endpoint.conflict or beacon.kind is BeaconKind.ANSWER:
            return
        # A unicast heartbeat means that its sender receives none of this agent's multicasts. If this agent receives
        # none of the sender's either, its own heartbeats go there by unicast anyway.
        deaf = not multicast and now - peer.multicast_at <= limits.MULTICAST_SILENCE
        if not (found or deaf or beacon.kind is BeaconKind.ANNOUNCE):
            return
        members = len(self.endpoints.members)
        if not (multicast and self._sender.multicast and members > limits.MANY_MEMBERS):
            self._sender.send_answer(peer, now)
        elif self._burst:
            self.counters.add("beacon.answer_spared")  # the next beacon of this agent's own burst tells the sender
        else:
            if not self._late_answers:
                self._late_answers_at = now + self._rng() * members / limits.ANSWERS_PER_SECOND
            self._late_answers[peer.identity.guid.place] = None

    def _send_late_answers(self, now: float) -> None:
        """Answer the newcomers of a large mesh that got no link meanwhile."""
        if len(self._late_answers) >= _ANSWERS_TOGETHER:
            self._send_multicast(BeaconKind.HEARTBEAT, now)
        known = self._sender.heard_lately(self._sender.unheard_by_multicast(now), now)
        for place in self._late_answers:
            if (endpoint := self.endpoints.get(place)) is not None and (peer := endpoint.current) is not None:
                self._sender.send_answer(peer, now, self._sender.gossip(known, peer))
        self._late_answers.clear()

    def _infer_multicast(
        self, peer: PeerInstance, beacon: Beacon, source: Address, now: float, *, was_candidate: bool
    ) -> None:
        """Infer how a peer was found whose first beacon came by unicast.

        A gossip candidate was found by gossip. A peer that answers without being asked has received a multicast of
        this agent; for a while its own multicasts are expected here too.
        """
        if was_candidate:
            peer.found_by = "gossip"
        elif beacon.kind is BeaconKind.ANSWER and self._sender.multicast and source not in self._seeds:
            peer.multicast_at = now - HEARTBEAT_INTERVAL

    def _apply_gossip(self, beacon: Beacon, now: float) -> None:
        """Announce this agent to unknown peers of the sender."""
        own = self._sender.identity
        mentioned = [guid.endpoint for guid in beacon.gossip if guid.place not in self.endpoints]
        if beacon.observed:
            met = {*own.endpoints}
            for peer in self._members():
                met.update(peer.identity.endpoints, peer.addresses)
            mentioned = [address for address in beacon.observed if address not in met] + mentioned
        for address in mentioned:
            believed = own.guid.is_loopback or not address[0].startswith("127.")
            if believed and not self._candidates.add(address, now):
                self.counters.add("gossip.full")
        self._announce(self._candidates.take_due(now))

    def _burst_times(self, now: float, offsets: tuple[float, ...]) -> list[float]:
        return [now + offset + (BURST_JITTER * self._rng() if offset else 0.0) for offset in offsets]

    def _next_heartbeat(self, now: float) -> float:
        return now + HEARTBEAT_INTERVAL * (1.0 - _HEARTBEAT_JITTER * self._rng())
