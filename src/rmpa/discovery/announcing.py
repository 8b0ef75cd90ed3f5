"""The beacons that an agent sends: their numbers, their gossip, and their rates. Sans-I/O."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Final, NamedTuple

from rmpa.core.identity import serial_add
from rmpa.core.timers import Backoff, TimerQueue, TokenBucket
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon, BeaconKind

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable, Sequence

    from rmpa.core.identity import Guid, Identity
    from rmpa.core.statistics import Counters
    from rmpa.discovery.beacon import Address
    from rmpa.discovery.endpoints import EndpointTable, PeerInstance

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


class AddressLimit:
    """Allows each address so many packets in a while, and forgets the address that was silent for longest.

    Args:
        count: Packets of one address.
        addresses: How many are remembered.
        interval: The while, in seconds.
    """

    def __init__(self, count: int, addresses: int, interval: float = 1.0) -> None:
        self._most = count
        self._addresses = addresses
        self._interval = interval
        self._counts: OrderedDict[Hashable, tuple[float, int]] = OrderedDict()

    def take(self, address: Hashable, now: float) -> bool:
        """Count a packet; return whether it is allowed."""
        since, count = self._counts.get(address, (now, 0))
        if now - since >= self._interval:
            since, count = now, 0
        self._counts[address] = (since, count + 1)
        self._counts.move_to_end(address)
        if len(self._counts) > self._addresses:
            self._counts.popitem(last=False)
        return count < self._most


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


class BeaconSender:
    """Numbers the beacons of one agent and puts gossip into them. It decides nothing about when one is sent.

    Args:
        identity: This agent's own.
        endpoints: The peers.
        lease: Seconds of silence after which peers may count this agent as gone.
        counters: Where answers that were held back are counted.
        multicast: Whether to send to the group at all.

    Attributes:
        closed: Whether nothing is sent any more: a goodbye was the last beacon.
    """

    def __init__(
        self, identity: Identity, endpoints: EndpointTable, lease: float, counters: Counters, *, multicast: bool
    ) -> None:
        self.identity = identity
        self.multicast = multicast
        self.closed = False
        self._endpoints = endpoints
        self._lease_ms = round(lease * 1000)
        self._counters = counters
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
        beacon = Beacon(kind, self.identity, self._lease_ms, self._sequence, gossip, observed)
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
                    gossip = self.gossip(self.heard_lately(self._endpoints.members.values(), now), peer)
                self.send(BeaconKind.ANSWER, address, gossip)
            else:
                self._counters.add("beacon.answer_limited")

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
        members = self._endpoints.members
        if not self.multicast:
            return list(members.values())
        since = now - limits.MULTICAST_SILENCE
        many = len(members) > limits.MANY_MEMBERS  # then a peer that a link brought has some time to be heard
        return [peer for peer in members.values() if peer.multicast_at < since and not (many and peer.since >= since)]

    def _observed(self, gossip: tuple[Guid, ...]) -> tuple[Address, ...]:
        """Source addresses of gossiped peers that differ from the GUID's address, which may not be reachable."""
        sources = [(guid, peer.source) for guid in gossip if (peer := self._endpoints.members.get(guid.place))]
        return tuple(at for guid, at in sources if at and at != guid.endpoint and not at[0].startswith("127."))
