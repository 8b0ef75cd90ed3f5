"""The beacons that an agent sends: their numbers, their gossip, and the rate of its answers. Sans-I/O."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.counters import Backoff, TimerQueue, TokenBucket
from rmpa.core.identity import serial_add
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon, BeaconKind, SendMulticast, SendUnicast

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.core.counters import Counters
    from rmpa.core.identity import Guid, Identity
    from rmpa.discovery.beacon import Address, Output
    from rmpa.discovery.endpoints import EndpointTable, PeerInstance


# When an announcement is answered, by the number of members.
#
# With 256 members that start together, an answer of each to each announcement would be 65,000 packets. Up to
# ``limits.MANY_MEMBERS`` nothing here changes what the paper's protocol sends.


class LateAnswers:
    """Answers of a member of a large mesh to multicasts, which it delays: together they would be a storm.

    The answers to one newcomer spread over a time that grows with the number of members; those to many newcomers
    become one multicast.

    Args:
        rng: Uniform numbers in [0, 1).
    """

    def __init__(self, rng: Callable[[], float]) -> None:
        self._rng = rng
        self._places: dict[int, None] = {}
        self.at: float | None = None
        """When ``take`` has something to return; ``None``: there is nothing."""

    def add(self, place: int, members: int, now: float) -> None:
        """Plan an answer to the peer at a place (``Guid.place``), among so many members."""
        self._places[place] = None
        if self.at is None:
            self.at = now + self._rng() * members / limits.ANSWERS_PER_SECOND

    def discard(self, place: int) -> None:
        """The peer at a place has a link: it needs no answer."""
        self._places.pop(place, None)

    def take(self, now: float) -> list[int]:
        """The places whose peers get an answer now, oldest first."""
        if self.at is None or self.at > now:
            return []
        places = list(self._places)
        self.clear()
        return places

    def clear(self) -> None:
        """Forget all: a multicast is about to answer everyone."""
        self._places.clear()
        self.at = None


def is_many(members: int) -> bool:
    """Whether so many members need what protects large meshes from storms."""
    return members > limits.MANY_MEMBERS


def dissemination_interval(members: int) -> float:
    """The shortest time between two early heartbeats about newly found peers, in seconds."""
    return max(limits.DISSEMINATION_INTERVAL, members / limits.DISSEMINATIONS_PER_SECOND * is_many(members))


# The rate of answers to beacons.


class AnswerLimit:
    """At most one answer to an address in ``ANSWER_INTERVAL``, and ``ANSWERS_PER_SECOND`` over all addresses."""

    def __init__(self) -> None:
        self._last: OrderedDict[Address, float] = OrderedDict()
        self._second = float("-inf")
        self._count = 0

    def allows(self, address: Address, now: float) -> bool:
        """Whether an answer may be sent to an address now; if so, it is counted as sent."""
        if now - self._last.get(address, float("-inf")) < limits.ANSWER_INTERVAL:
            return False
        if now - self._second >= 1.0:
            self._second = now
            self._count = 0
        if self._count >= limits.ANSWERS_PER_SECOND:
            return False
        self._count += 1
        self._last[address] = now
        self._last.move_to_end(address)
        if len(self._last) > limits.ANSWER_ADDRESSES_MAX:
            self._last.popitem(last=False)
        return True


# Gossip: the GUIDs of known peers that beacons carry, and the addresses that were learnt from such beacons.


class GossipSelector:
    """Selects the peers that one beacon gossips about, within the room that a beacon has."""

    def __init__(self) -> None:
        self._turn = 0

    def choose(
        self, peers: Sequence[PeerInstance], to: PeerInstance | None, now: float, *, loopback: bool
    ) -> tuple[Guid, ...]:
        """GUIDs for one beacon, in order; if they are too many, the next beacon goes on where this one ends.

        Peers that have no link and were not heard lately are left out: receivers would send announcements to them for
        as long as they are mentioned.

        Args:
            peers: Those that are known.
            to: The receiver, if the beacon is a unicast; its own GUID is left out.
            now: Monotonic seconds.
            loopback: Whether the receivers can reach loopback addresses.
        """
        count = len(peers)
        start = self._turn % count if count > limits.BEACON_GOSSIP_MAX else 0
        guids: list[Guid] = []
        for number in range(start, start + count):
            peer = peers[number % count]
            if peer is to or not (peer.linked or now - peer.heard <= limits.MULTICAST_SILENCE):
                continue
            guid = peer.identity.guid
            if loopback or not guid.is_loopback:
                guids.append(guid)
                if len(guids) == limits.BEACON_GOSSIP_MAX:
                    self._turn = number + 1
                    break
        return tuple(guids)


@dataclass(slots=True)
class _Candidate:
    backoff: Backoff
    gossiped_at: float


class GossipCandidates:
    """Addresses learnt from gossip. Each gets announcements, with back-off, until it answers or gossip about it ends.

    Gossip about a dead peer ends by itself: a beacon only mentions peers that its sender has heard.

    Args:
        rng: Uniform numbers in [0, 1).
    """

    def __init__(self, rng: Callable[[], float]) -> None:
        self._rng = rng
        self._all: dict[Address, _Candidate] = {}
        self._due: TimerQueue[Address] = TimerQueue()
        self._allowed = TokenBucket(limits.CANDIDATES_PER_SECOND, limits.CANDIDATES_BURST)
        self._resume = float("-inf")

    def __contains__(self, address: Address) -> bool:
        return address in self._all

    def __len__(self) -> int:
        return len(self._all)

    def add(self, address: Address, now: float) -> bool:
        """Gossip mentions ``address``; return ``False`` if there is no room for it."""
        candidate = self._all.get(address)
        if candidate is not None:
            candidate.gossiped_at = now
            return True
        if len(self._all) >= limits.CANDIDATES_MAX:
            return False
        backoff = Backoff(limits.CANDIDATE_RETRY_FIRST, limits.CANDIDATE_RETRY_MAX, self._rng)
        self._all[address] = _Candidate(backoff, now)
        self._due.set(address, now)
        return True

    def answered(self, address: Address) -> bool:
        """Remove an address from which a packet arrived; return whether it was a candidate."""
        self._due.set(address, None)
        return self._all.pop(address, None) is not None

    def take_due(self, now: float) -> list[Address]:
        """The addresses that get an announcement now, longest wait first; those beyond the rate go on waiting."""
        due: list[Address] = []
        while now >= self._resume and (address := self._due.pop(now)) is not None:
            candidate = self._all[address]
            if now - candidate.gossiped_at >= limits.CANDIDATE_LIFETIME:
                del self._all[address]
            elif self._allowed.take(now):
                due.append(address)
                self._due.set(address, now + candidate.backoff.delay())
            else:
                self._due.set(address, now)
                self._resume = self._allowed.next(now)
        return due

    def next_timer(self) -> float | None:
        """When the next announcement is due; ``None``: never."""
        due = self._due.next()
        return None if due is None else max(due, self._resume)


_NEVER: Final = float("-inf")


class BeaconSender:
    """Numbers the beacons of one agent and puts gossip into them. It decides nothing about when one is sent.

    Args:
        identity: This agent's own.
        endpoints: The peers.
        lease: Seconds of silence after which peers may count this agent as gone.
        counters: Where answers that were held back are counted.
        multicast: Whether to send to the group at all.
    """

    def __init__(
        self, identity: Identity, endpoints: EndpointTable, lease: float, counters: Counters, *, multicast: bool
    ) -> None:
        self.identity = identity
        """This agent's own, as the next beacon will carry it."""
        self.multicast = multicast
        """Whether it sends to the group at all."""
        self.closed = False
        """Whether nothing is sent any more: a goodbye was the last beacon."""
        self._endpoints = endpoints
        self._lease_ms = round(lease * 1000)
        self._counters = counters
        self._sequence = 0
        self._gossip_selector = GossipSelector()
        self._answers = AnswerLimit()
        self._outputs: list[Output] = []

    def take(self) -> list[Output]:
        """The beacons to send, in order; each is returned once."""
        taken, self._outputs = self._outputs, []
        return taken

    def send(self, kind: BeaconKind, address: Address, gossip: tuple[Guid, ...] = (), *, key: int = 0) -> None:
        """Send a unicast; ``key`` as for ``SendUnicast``."""
        if not self.closed:
            self._outputs.append(SendUnicast(self._beacon(kind, gossip), address, key))

    def send_multicast(self, kind: BeaconKind, now: float) -> None:
        """Send to the group, with gossip about the peers that multicast does not reach."""
        if self.multicast:
            gossip = self.gossip(self.unheard_by_multicast(now), None, now)
            self._outputs.append(SendMulticast(self._beacon(kind, gossip)))

    def send_answer(self, peer: PeerInstance, now: float, gossip: tuple[Guid, ...] | None = None) -> None:
        """Answer a peer at each of its addresses, within the limits of answers; ``gossip``: default: of all peers."""
        for address in peer.addresses:
            if self._answers.allows(address, now):
                gossip = self.gossip(self._endpoints.present(), peer, now) if gossip is None else gossip
                self.send(BeaconKind.ANSWER, address, gossip)
            else:
                self._counters.add("beacon.answer_limited")

    def send_goodbye(self, peers: list[PeerInstance]) -> None:
        """Send a goodbye to the group, and to these peers by unicast; afterwards nothing is sent."""
        if self.multicast:
            self._outputs.append(SendMulticast(self._beacon(BeaconKind.GOODBYE)))
        for peer in peers:
            for address in peer.addresses:
                self.send(BeaconKind.GOODBYE, address)
        self.closed = True

    def gossip(self, peers: list[PeerInstance], to: PeerInstance | None, now: float) -> tuple[Guid, ...]:
        """What the next beacon says about peers; ``to``: its receiver, or ``None`` if it goes to the group."""
        identity = to.identity if to is not None else self.identity
        return self._gossip_selector.choose(peers, to, now, loopback=identity.guid.is_loopback)

    def unheard_by_multicast(self, now: float) -> list[PeerInstance]:
        """Members that get their heartbeats by unicast, because no multicast of theirs was heard lately."""
        members = self._endpoints.present()
        if not self.multicast:
            return list(members)
        many = is_many(len(members))  # then a peer that a link brought has some time to be heard
        since = now - limits.MULTICAST_SILENCE
        return [v for v in members if max(v.multicast_at, v.since if many else _NEVER) < since]

    def _beacon(self, kind: BeaconKind, gossip: tuple[Guid, ...] = ()) -> Beacon:
        self._sequence = serial_add(self._sequence, 1)
        observed = self._endpoints.observed_addresses(gossip)
        return Beacon(kind, self.identity, self._lease_ms, self._sequence, gossip, observed)
