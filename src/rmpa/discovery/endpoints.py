"""The runs of agents at each (address, port), which of them is the live one, and the beacons that they get. Sans-I/O.

Two runs may claim one (address, port): a restarted agent and its former run, of which late packets still come, or two
agents behind one NAT. The facts of a run are what was heard of it; ``Endpoint.settle`` decides by them alone, and is
called again whenever one has changed.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

from rmpa.core import limits as core_limits
from rmpa.core.identity import Guid, Identity, is_later, serial_add
from rmpa.core.timers import AddressLimit, Backoff, TimerQueue, TokenBucket, Yielder, earliest
from rmpa.discovery import limits
from rmpa.discovery.beacon import Address, Beacon, BeaconKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from rmpa.core.statistics import Counters

# Seconds after a goodbye in which beacons that were sent before it may still come, or be read from another socket. A
# beacon that comes later refutes the goodbye.
GOODBYE_LATE: Final = 0.2
# The shortest lease: with a shorter one a peer would come and go with every lost packet.
LEASE_MIN: Final = 2.0
# The longest lease: with a longer one a peer would be shown long after its end.
LEASE_MAX: Final = 120.0
# Longest time between two announcements to an address known from gossip.
CANDIDATE_RETRY_MAX: Final = 10.0
# An address that no gossip had for this long (four heartbeats) is given up.
CANDIDATE_LIFETIME: Final = 20.0
# Announcements to addresses known from gossip that may be sent at once.
CANDIDATES_BURST: Final = 256
# Announcements a second to all addresses known from gossip, beyond one for each: gossiped peers may be forged.
CANDIDATES_PER_SECOND: Final = 25.0

# Addresses remembered for ``ANSWER_INTERVAL``; the oldest is forgotten first.
_ANSWER_ADDRESSES_MAX: Final = 1024
# Addresses kept that are known only from gossip; further ones are ignored until there is room.
_CANDIDATES_MAX: Final = 1024
# Delay before the second announcement to an address known from gossip; it doubles each time.
_CANDIDATE_RETRY_FIRST: Final = 0.5

# A packet of a replaced instance after this long is not a late one: two live peers share one GUID.
_CONFLICT_AFTER: Final = 2.0
# Runs remembered for one (address, port): the present one, the last one and two rivals.
_ENDPOINT_RUNS_MAX: Final = 4

# How a peer was heard first; ``gossip``: it answered an announcement to an address that another's gossip had.
HeardBy: TypeAlias = Literal["multicast", "unicast", "gossip", "link"]
NEVER: Final = float("-inf")
# The end of a link that has not ended.
LINKED: Final = float("inf")


@dataclass(slots=True)
class PeerInstance:
    """One run of a peer, as heard here. Times are seconds of the protocol's clock.

    Args:
        identity: As its last beacon or handshake said.
        since: When it began to claim its endpoint, or became the live run there, or a member.
        heard: When its last beacon or handshake came.
        found_by: How it was first heard.
        lease: Seconds of silence after which it counts as gone.
        source: The source address of its last packet; ``None`` if only a link has shown it.
        sequence: The number of its last beacon that was no goodbye.
        multicast_at: When it was last heard by multicast.
        linked_until: When its link ended; ``LINKED`` while there is one, ``NEVER`` if there was none.
        goodbye: The number of its goodbye, behind which nothing came. It may be forged.
        doubted: Whether the silence of its beacons, while it is linked, was reported.
    """

    identity: Identity
    since: float
    heard: float
    found_by: HeardBy
    lease: float = core_limits.PEER_LEASE
    source: Address | None = None
    sequence: int | None = None
    multicast_at: float = NEVER
    linked_until: float = NEVER
    goodbye: int | None = None
    doubted: bool = False

    @property
    def linked(self) -> bool:
        """Whether there is a link with it."""
        return self.linked_until == LINKED

    @property
    def verified(self) -> bool:
        """Whether it has or had a link: it is no forgery."""
        return self.linked_until != NEVER

    @property
    def last_seen(self) -> float:
        """When it was last heard, or its link ended."""
        return self.heard if self.linked else max(self.heard, self.linked_until)

    @property
    def deadline(self) -> float:
        """When its lease is over, if it stays silent."""
        return self.last_seen + self.lease

    @property
    def addresses(self) -> tuple[Address, ...]:
        """Where its unicasts go: its GUID's endpoint, and the source of its packets where that differs."""
        endpoint = self.identity.guid.endpoint
        return (endpoint,) if self.source is None or self.source == endpoint else (endpoint, self.source)

    def gone(self, now: float) -> bool:
        """Whether it said goodbye or its lease is over; never while it is linked."""
        return not self.linked and (self.goodbye is not None or self.deadline <= now)

    def accepts(self, beacon: Beacon, now: float) -> bool:
        """Whether a beacon is newer than the last one (serial numbers, RFC 1982: they wrap).

        A beacon that was late behind a goodbye comes soon after it. One that comes later was sent after it, and shows
        that the goodbye was forged, whatever number that had. A goodbye of an agent is its last beacon.
        """
        last = self.sequence
        if self.goodbye is not None:
            if beacon.kind is BeaconKind.GOODBYE:
                return False
            if now - self.heard < GOODBYE_LATE:
                last = self.goodbye
        return last is None or is_later(beacon.sequence, last)

    def update(self, beacon: Beacon, source: Address, now: float) -> None:
        """Take over the content of a newer beacon; of a goodbye, which may be forged, only that it was said."""
        self.heard = now
        if beacon.kind is BeaconKind.GOODBYE:
            self.goodbye = beacon.sequence
            return
        self.goodbye, self.doubted = None, False
        self.identity, self.sequence, self.source = beacon.identity, beacon.sequence, source
        self.lease = min(max(beacon.lease_ms / 1000, LEASE_MIN), LEASE_MAX)


@dataclass(slots=True)
class Endpoint:
    """The runs heard under one (address, port).

    Args:
        runs: By instance id, at most ``_ENDPOINT_RUNS_MAX``.
        current: The live one.
        claimant: The newest other run. It becomes the live one unless a link or a conflict speaks against it.
        conflict: Whether two live runs claim the endpoint.
        member: The run that is reported as a member, by the identity that it was reported with.
        own: Whether this is this agent's own endpoint, at which no other run becomes the live one.
    """

    runs: dict[bytes, PeerInstance] = field(default_factory=dict)
    current: PeerInstance | None = None
    claimant: PeerInstance | None = None
    conflict: bool = False
    member: Identity | None = None
    own: bool = False

    def settle(self, now: float) -> None:
        """Decide which run is the live one, and whether another one is certainly alive too."""
        current, claimant = self.current, self.claimant
        for run in [run for run in self.runs.values() if run.deadline <= now and not run.linked]:
            del self.runs[run.identity.instance]
        rivals = [run for run in self.others() if current is not None and self._insists(run, current)]
        if current is not None and current.gone(now):
            current = None
        if claimant is not None and claimant.gone(now):
            claimant = None
        if current is None or not (current.linked or self.conflict):
            # A live run sends heartbeats; a single beacon long ago, perhaps forged, is not enough.
            if claimant is not None and now - claimant.heard <= limits.HEARTBEAT_LATE:
                current = claimant
            elif rivals:
                rival = max(rivals, key=lambda run: run.heard)
                # If the live run missed its heartbeat, its packets, and not the rival's, were the late ones.
                if current is None or rival.heard - current.last_seen > limits.HEARTBEAT_LATE:
                    current = rival
        if current is not self.current:
            rivals = []
            if current is not None:
                current.since = now
        self.current, self.claimant = current, claimant if claimant is not current else None
        # A linked run that was not heard since the rival appeared may be without power; its link is checked.
        self.conflict = current is not None and any(
            self.own or current.heard > rival.since or current.since >= rival.since for rival in rivals
        )

    def hear(self, beacon: Beacon, source: Address, now: float, *, multicast: bool) -> PeerInstance | None:
        """Take in one beacon; return the run that sent it, or ``None`` if it is late or repeated."""
        goodbye = beacon.kind is BeaconKind.GOODBYE
        run = self.runs.get(beacon.identity.instance)
        claims = run is None or self.current is None or (run.goodbye is not None and run is not self.current)
        if run is None:
            if goodbye:
                return None
            run = self._add(PeerInstance(beacon.identity, now, now, "multicast" if multicast else "unicast"))
        if multicast:
            run.multicast_at = now
        if not run.accepts(beacon, now):
            return None
        run.update(beacon, source, now)
        if claims and not goodbye:
            run.since, self.claimant = now, run
        return run

    def link_up(self, identity: Identity, now: float) -> PeerInstance:
        """Make the run of a link's handshake the live one, because the handshake proves that it is alive."""
        run = self.runs.get(identity.instance) or self._add(PeerInstance(identity, now, now, "link"))
        # A handshake carries no further addresses; those of the beacons stay.
        run.identity = identity if identity.addresses else replace(identity, addresses=run.identity.addresses)
        run.goodbye, run.doubted, run.heard, run.linked_until = None, False, now, LINKED
        if run is not self.current:
            if self.current is not None:
                self.current.linked_until = min(self.current.linked_until, now)
            self.current, self.claimant, run.since = run, None, now
        return run

    def others(self) -> list[PeerInstance]:
        """The runs beside the live one that have not said goodbye."""
        return [run for run in self.runs.values() if run is not self.current and run.goodbye is None]

    def next_timer(self) -> float | None:
        """When the first lease is over; that of a linked run is only once, which is reported."""
        return earliest(
            *(run.deadline for run in self.runs.values() if not (run.linked and (run.doubted or self.own)))
        )

    @staticmethod
    def _insists(run: PeerInstance, current: PeerInstance) -> bool:
        """Whether a run was heard so long after the other one took its place that the packet was no late one."""
        return run.heard - max(run.since, current.since) >= _CONFLICT_AFTER

    def _add(self, run: PeerInstance) -> PeerInstance:
        if len(self.runs) >= _ENDPOINT_RUNS_MAX:
            oldest = min((r for r in self.runs.values() if r is not self.current), key=lambda r: r.heard)
            del self.runs[oldest.identity.instance]
        self.runs[run.identity.instance] = run
        return run


class PeerView(NamedTuple):
    """One peer, for display.

    Attributes:
        conflicts: Texts for the user.
        present: Whether it is a member; ``False`` while a conflict prevents it.
    """

    run: PeerInstance
    conflicts: tuple[str, ...]
    present: bool


class EndpointTable(dict[int, Endpoint]):
    """The endpoints by place (``Guid.place``), with indexes: a packet never costs a look at every endpoint.

    After a change of an endpoint ``index`` must be called.

    Attributes:
        members: The peers that are members, without this agent, by place; only ``index`` changes it.
        timers: When the first lease at a place is over.
    """

    def __init__(self) -> None:
        super().__init__()
        self.members: dict[int, PeerInstance] = {}
        self.timers: TimerQueue[int] = TimerQueue()
        self._names: dict[int, str] = {}
        self._by_name: defaultdict[str, set[int]] = defaultdict(set)

    def index(self, place: int) -> None:
        """Update the indexes at one place; an endpoint without runs is removed."""
        endpoint = self[place]
        run = endpoint.current
        self.timers.set(place, endpoint.next_timer())
        if not endpoint.runs:
            del self[place]
        if run is not None and endpoint.member is not None:
            self.members[place] = run
        else:
            self.members.pop(place, None)
        name, before = run.identity.name if run is not None else "", self._names.get(place, "")
        if name != before:
            self._by_name[before].discard(place)
            if not self._by_name[before]:
                del self._by_name[before]
            if name:
                self._names[place] = name
                self._by_name[name].add(place)
            else:
                del self._names[place]

    def remove(self, place: int) -> None:
        """Remove an endpoint with all its runs."""
        self[place] = Endpoint()
        self.index(place)

    def is_steady(self, endpoint: Endpoint, beacon: Beacon) -> bool:
        """Whether a beacon of an endpoint's member decides nothing: no other run or name, doubt, shorter lease."""
        run = endpoint.current
        if run is None or endpoint.member is None or len(endpoint.runs) > 1 or run.doubted or run.goodbye is not None:
            return False
        return beacon.lease_ms >= run.lease * 1000 and len(self._by_name[run.identity.name]) == 1

    def with_name(self, name: str) -> list[Endpoint]:
        """The endpoints whose live run has this name, in order; those in conflict and this agent's own included."""
        return [self[place] for place in sorted(self._by_name.get(name, ()))]

    def same_name(self, endpoint: Endpoint) -> list[tuple[PeerInstance, PeerInstance]]:
        """Pairs of this endpoint's peer and each other live peer with its name, the newer peer first."""
        mine = endpoint.current
        pairs = []
        for other in self.with_name(mine.identity.name) if mine is not None else ():
            peer = other.current
            if mine is None or peer is None or other is endpoint or not (other.member is not None or other.own):
                continue
            if peer.identity.instance == mine.identity.instance:
                continue  # it has another address
            newer, older = (mine, peer) if (mine.since, other.own) >= (peer.since, endpoint.own) else (peer, mine)
            if older.linked or older.last_seen >= newer.since:  # this agent itself counts as linked
                pairs.append((newer, older))
        return pairs

    def views(self, yielder: Yielder = iter) -> list[PeerView]:
        """All peers in GUID order, those included that a conflict keeps from being members; not this agent itself."""
        return [
            PeerView(run, self._conflicts(endpoint, run), endpoint.member is not None and run is endpoint.current)
            for _, endpoint in yielder(sorted(self.items(), key=itemgetter(0)))
            for run in (endpoint.current, *(endpoint.others() if endpoint.conflict else ()))
            if run is not None and not (endpoint.own and run is endpoint.current)
        ]

    def _conflicts(self, endpoint: Endpoint, run: PeerInstance) -> tuple[str, ...]:
        texts = []
        if endpoint.conflict and endpoint.current is not None:
            other = endpoint.current if run is not endpoint.current else endpoint.others()[0]
            texts.append(shared_address(run.identity, other.identity, own=endpoint.own))
        if run is endpoint.current:
            texts += [shared_name(one.identity, other.identity) for one, other in self.same_name(endpoint)]
        return tuple(texts)


def shared_address(one: Identity, other: Identity, *, own: bool) -> str:
    """What is said of two live peers with one GUID address; ``own``: the other one is this agent."""
    host, port = one.guid.endpoint
    if own:
        what = f"the live peer {one.name} has our own GUID address {host}:{port}"
    else:
        what = f"two live peers share one GUID address {host}:{port}: {one.name} and {other.name}"
    return f"{what}; give one of them another --port, or fix the NAT between them"


def shared_name(one: Identity, other: Identity) -> str:
    """What is said of two live peers, or this agent and a peer, with one name."""
    return (
        f"two modules are named {one.name}: {one.guid} and {other.guid}, so rules "
        "and commands that name it may mean either; rename one: rmpa up --name"
    )


# The beacons that an agent sends: their numbers, their gossip, and their rates.


class GossipCandidates:
    """Addresses learnt from gossip. Each gets announcements, with back-off, until it answers or gossip about it ends.

    Gossip about a dead peer ends by itself: a beacon only mentions peers that its sender has heard.

    Args:
        rng: Uniform numbers in [0, 1).
    """

    def __init__(self, rng: Callable[[], float]) -> None:
        self._rng = rng
        self._gossiped: dict[Address, float] = {}
        self._backoffs: dict[Address, Backoff] = {}
        self._due: TimerQueue[Address] = TimerQueue()
        self._allowed = TokenBucket(CANDIDATES_PER_SECOND, CANDIDATES_BURST)
        self._resume = float("-inf")

    def add(self, address: Address, now: float) -> bool:
        """Gossip mentions ``address``; return ``False`` if there is no room for it."""
        if address not in self._gossiped:
            if len(self._gossiped) >= _CANDIDATES_MAX:
                return False
            self._backoffs[address] = Backoff(_CANDIDATE_RETRY_FIRST, CANDIDATE_RETRY_MAX, self._rng)
            self._due.set(address, now)
        self._gossiped[address] = now
        return True

    def answered(self, address: Address) -> bool:
        """Remove an address from which a packet arrived; return whether it was a candidate."""
        if self._gossiped.pop(address, None) is None:
            return False
        self._due.set(address, None)
        del self._backoffs[address]
        return True

    def take_due(self, now: float) -> list[Address]:
        """The addresses that get an announcement now, longest wait first; those beyond the rate go on waiting."""
        due: list[Address] = []
        while now >= self._resume and (address := self._due.pop(now)) is not None:
            if now - self._gossiped[address] >= CANDIDATE_LIFETIME:
                self.answered(address)
            elif self._allowed.take(now):
                due.append(address)
                self._due.set(address, now + self._backoffs[address].delay())
            else:
                self._due.set(address, now)
                self._resume = self._allowed.next(now)
        return due

    def next_timer(self) -> float | None:
        """When the next announcement is due; ``None``: never."""
        due = self._due.next()
        return None if due is None else max(due, self._resume)


class OutgoingBeacon(NamedTuple):
    """A beacon to send.

    Attributes:
        address: Where to; ``None``: to the group, on every usable interface.
        key: Of a secured mesh: the low 16 bits of the number of the group key that the receiver has; 0: the present
            one.
    """

    beacon: Beacon
    address: Address | None = None
    key: int = 0


@dataclass(eq=False)
class BeaconSender:
    """Numbers the beacons of one agent and puts gossip into them. It decides nothing about when one is sent.

    Args:
        identity: This agent's own.
        endpoints: The peers.
        counters: Where answers that were held back are counted.
        multicast: Whether to send to the group at all.

    Attributes:
        closed: Whether nothing is sent any more: a goodbye was the last beacon.
    """

    identity: Identity
    endpoints: EndpointTable
    counters: Counters
    multicast: bool

    def __post_init__(self) -> None:
        self.closed = False
        self._sequence = 0
        self._turn = 0
        self._answers = TokenBucket(limits.ANSWERS_PER_SECOND, limits.ANSWERS_PER_SECOND)
        self._answered = AddressLimit(1, _ANSWER_ADDRESSES_MAX, limits.ANSWER_INTERVAL)
        self._outputs: list[OutgoingBeacon] = []

    def take(self) -> list[OutgoingBeacon]:
        """The beacons to send, in order; each is returned once."""
        taken, self._outputs = self._outputs, []
        return taken

    def send(self, kind: BeaconKind, address: Address | None, gossip: tuple[Guid, ...] = (), *, key: int = 0) -> None:
        """Send to an address, or to the group; the arguments as for ``OutgoingBeacon``."""
        if self.closed or (address is None and not self.multicast):
            return
        self._sequence = serial_add(self._sequence, 1)
        observed = self._observed(gossip)
        beacon = Beacon(kind, self.identity, round(core_limits.PEER_LEASE * 1000), self._sequence, gossip, observed)
        self._outputs.append(OutgoingBeacon(beacon, address, key))

    def send_multicast(self, kind: BeaconKind, now: float) -> None:
        """Send to the group, with gossip about the peers that multicast does not reach."""
        self.send(kind, None, self.gossip(self.heard_lately(self.unheard_by_multicast(now), now), None))

    def send_answer(self, peer: PeerInstance, now: float, gossip: tuple[Guid, ...] | None = None) -> None:
        """Answer a peer at each of its addresses, within the limits of answers; ``gossip``: default: of all peers."""
        for address in peer.addresses:
            if self._answers.has(now) and self._answered.take(address, now):
                self._answers.spend()
                if gossip is None:
                    gossip = self.gossip(self.heard_lately(self.endpoints.members.values(), now), peer)
                self.send(BeaconKind.ANSWER, address, gossip)
            else:
                self.counters.add("beacon.answer_limited")

    def send_goodbye(self, peers: Iterable[PeerInstance]) -> None:
        """Send a goodbye to the group, and to these peers by unicast; afterwards nothing is sent."""
        self.send(BeaconKind.GOODBYE, None)
        for address in (address for peer in peers for address in peer.addresses):
            self.send(BeaconKind.GOODBYE, address)
        self.closed = True

    def gossip(self, known: Sequence[PeerInstance], to: PeerInstance | None) -> tuple[Guid, ...]:
        """What the next beacon says about peers; if they are too many, the one behind it goes on where it ends.

        Args:
            known: The peers (``heard_lately``).
            to: The receiver, whose own GUID is left out; ``None``: the group.
        """
        loopback = (self.identity if to is None else to.identity).guid.is_loopback
        start = self._turn % len(known) if len(known) > limits.BEACON_GOSSIP_MAX else 0
        guids: list[Guid] = []
        for number, peer in enumerate((*known[start:], *known[:start]), start + 1):
            guid = peer.identity.guid
            if peer is not to and (loopback or not guid.is_loopback):
                guids.append(guid)
                if len(guids) == limits.BEACON_GOSSIP_MAX:
                    self._turn = number
                    break
        return tuple(guids)

    @staticmethod
    def heard_lately(peers: Iterable[PeerInstance], now: float) -> list[PeerInstance]:
        """The peers that gossip mentions: those with a link, and those that were heard lately.

        Receivers would send announcements to the others for as long as they are mentioned.
        """
        since = now - limits.MULTICAST_SILENCE
        # The last two are ``last_seen``, without its calls: there may be a thousand peers that were invented.
        return [peer for peer in peers if peer.heard >= since or peer.linked_until >= since]

    def unheard_by_multicast(self, now: float) -> list[PeerInstance]:
        """Members that get their heartbeats by unicast, because no multicast of theirs was heard lately."""
        members = self.endpoints.members
        if not self.multicast:
            return list(members.values())
        since = now - limits.MULTICAST_SILENCE
        many = len(members) > limits.MANY_MEMBERS  # then a peer that a link brought has some time to be heard
        return [peer for peer in members.values() if peer.multicast_at < since and not (many and peer.since >= since)]

    def _observed(self, gossip: tuple[Guid, ...]) -> tuple[Address, ...]:
        """Source addresses of gossiped peers that differ from the GUID's address, which may not be reachable."""
        sources = [(guid, peer.source) for guid in gossip if (peer := self.endpoints.members.get(guid.place))]
        return tuple(at for guid, at in sources if at and at != guid.endpoint and not at[0].startswith("127."))
