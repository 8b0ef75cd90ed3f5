"""The beacon: the packet by which peers announce themselves, and what an agent sends of them. Sans-I/O.

docs/design/protocol.md, "Beacons", has the bytes.

Errors that ``Beacon.parse`` raises, all of them the sender's fault::

    RemoteProtocolError
    ├── LimitExceeded        longer than one packet may be
    └── BeaconRefused        no beacon, or one of another domain or version

The first eight bytes are the same in every version, so domain and version are judged before the rest is parsed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from ipaddress import IPv4Address
from typing import TYPE_CHECKING, Final, NamedTuple

import rmpa
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import Guid, Identity, dialable, serial_add
from rmpa.core.limits import PEER_LEASE, UINT32_MAX
from rmpa.core.timers import AddressLimit, Backoff, TimerQueue, TokenBucket
from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from rmpa.core.statistics import Counters
    from rmpa.discovery.endpoints import EndpointTable, PeerInstance

# A numeric IPv4 address and a UDP port, as sockets have it.
Address = tuple[str, int]

MAGIC: Final = b"RMPA"
VERSION: Final = 2

# Where the kind stands in a beacon, the instance id (begin and end), and the number.
KIND_AT: Final = 5
_SEQUENCE: Final = slice(36, 40)
INSTANCE_AT: Final = (16, 32)
MALFORMED: Final = "beacon.malformed"
OTHER_DOMAIN: Final = "beacon.other_domain"
OTHER_VERSION: Final = "beacon.version"
# Contents of packets that need not be parsed again: of a peer at rest only the number differs.
_CONTENTS_KEPT: Final = 512
_PREFIX: Final = struct.Struct(">4sBBH")
_FIXED: Final = struct.Struct(">4sBBHQ16sII")
_GUID: Final = struct.Struct(">Q")
_ENDPOINT: Final = struct.Struct(">4sH")
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


class BeaconKind(IntEnum):
    """Why a beacon was sent.

    Attributes:
        ANNOUNCE: The sender has just started, or contacts an address that it learnt (seed, gossip); it asks for an
            answer.
        HEARTBEAT: The sender is still there.
        ANSWER: The unicast reply to a peer that announced itself; it is not answered.
        GOODBYE: The sender leaves.
    """

    ANNOUNCE = 1
    HEARTBEAT = 2
    ANSWER = 3
    GOODBYE = 4


@dataclass(eq=False)
class BeaconRefused(RemoteProtocolError):  # noqa: N818 - the name says what happened, as in core.errors
    """A packet that is no beacon for this agent.

    Args:
        counter: Where it is counted: ``MALFORMED``, ``OTHER_DOMAIN`` (several may share a network, so this is no
            fault at all) or ``OTHER_VERSION``.
        problem: What is wrong with it, for the user.
    """

    counter: str
    problem: str

    def __str__(self) -> str:
        """Say what is wrong with it."""
        return self.problem


@dataclass(frozen=True, slots=True)
class Beacon:
    """One beacon.

    Args:
        kind: Why it was sent.
        identity: Who sent it.
        lease_ms: Milliseconds after which the sender is gone if it is silent and has no link; 32 bits.
        sequence: Counts the beacons of this instance; 32 bits, wraps.
        gossip: Peers that the sender knows to be alive, at most ``limits.BEACON_GOSSIP_MAX``.
        observed: Source addresses of gossiped peers, where they differ from the GUID's; at most as many.

    Raises:
        ValueError: A part is out of its range.
    """

    kind: BeaconKind
    identity: Identity
    lease_ms: int
    sequence: int
    gossip: tuple[Guid, ...] = ()
    observed: tuple[Address, ...] = ()

    def __post_init__(self) -> None:
        if not (0 <= self.lease_ms <= UINT32_MAX and 0 <= self.sequence <= UINT32_MAX):
            raise ValueError("lease and sequence have 32 bits")
        if len(self.identity.addresses) > limits.BEACON_ADDRESSES_MAX:
            raise ValueError(f"a beacon carries at most {limits.BEACON_ADDRESSES_MAX} addresses")
        if max(len(self.gossip), len(self.observed)) > limits.BEACON_GOSSIP_MAX:
            raise ValueError(f"a beacon carries at most {limits.BEACON_GOSSIP_MAX} gossiped peers")
        port = self.identity.guid.port
        for address in (self.identity.guid.address, *self.identity.addresses):
            if not dialable(address, port):
                raise ValueError(f"no peer can be reached at {address}:{port}")
        for guid in self.gossip:
            if not guid.dialable:
                raise ValueError(f"no gossiped peer can be reached at {guid}")
        for host, at in self.observed:
            if not dialable(IPv4Address(host), at):
                raise ValueError(f"no gossiped peer can be reached at {host}:{at}")

    @classmethod
    def parse(cls, data: bytes, domain: int) -> Beacon:
        """Read one packet.

        Args:
            data: The whole packet; bytes after the beacon are for later versions and ignored.
            domain: The reader's domain id.

        Raises:
            LimitExceeded: The packet is longer than ``limits.BEACON_MAX_BYTES``.
            BeaconRefused: It is of another domain, whatever its version, or of another version, or malformed.
        """
        sender_of(data, domain)
        content = _content(data[: _SEQUENCE.start] + bytes(4) + data[_SEQUENCE.stop :])
        beacon = object.__new__(cls)
        for name in cls.__slots__:
            object.__setattr__(beacon, name, getattr(content, name))
        object.__setattr__(beacon, "sequence", int.from_bytes(data[_SEQUENCE], "big"))
        return beacon

    def serialize(self) -> bytes:
        """The packet; never longer than ``limits.BEACON_MAX_BYTES``."""
        identity = self.identity
        kind, domain, guid, instance = self.kind, identity.domain, identity.guid.value, identity.instance
        return b"".join(
            (
                _FIXED.pack(MAGIC, VERSION, kind, domain, guid, instance, self.lease_ms, self.sequence),
                bytes((len(identity.name),)),
                identity.name.encode("ascii"),
                bytes((len(identity.addresses),)),
                *(address.packed for address in identity.addresses),
                bytes((len(self.gossip),)),
                *(_GUID.pack(peer.value) for peer in self.gossip),
                bytes((len(self.observed),)),
                *(_ENDPOINT.pack(IPv4Address(host).packed, port) for host, port in self.observed),
            )
        )

    def __str__(self) -> str:
        """``announce 3 of base (10.0.0.1:40001#7), 2 gossiped``; names are ROS names, so no byte can hurt a log."""
        gossip = f", {len(self.gossip)} gossiped" if self.gossip else ""
        return f"{self.kind.name.lower()} {self.sequence} of {self.identity}{gossip}"


def sender_of(data: bytes, domain: int) -> tuple[Guid, bytes]:
    """The GUID and the instance id at the beginning of a packet; the rest is not parsed.

    Args:
        data: The whole packet.
        domain: The reader's domain id.

    Raises:
        RemoteProtocolError: As for ``Beacon.parse``, as far as the beginning shows it.
    """
    if len(data) > limits.BEACON_MAX_BYTES:
        raise LimitExceeded("a beacon", len(data), limits.BEACON_MAX_BYTES)
    if len(data) < _PREFIX.size:
        raise _malformed(f"only {len(data)} bytes")
    magic, version, _, its_domain = _PREFIX.unpack_from(data)
    if magic != MAGIC:
        raise _malformed("does not begin with RMPA")
    if its_domain != domain:
        remedy = f"we are of domain {domain}: start both with the same --domain (ROS_DOMAIN_ID)"
        raise BeaconRefused(OTHER_DOMAIN, f"is of domain {its_domain}, {remedy}")
    if version != VERSION:
        text = (
            f"speaks beacon protocol {version}, we speak {VERSION} (rmpa {rmpa.__version__}): "
            "install the same release of rmpa on both"
        )
        raise BeaconRefused(OTHER_VERSION, text)
    if len(data) < _FIXED.size:
        raise _malformed(f"only {len(data)} bytes")
    _, _, _, _, guid, instance, _, _ = _FIXED.unpack_from(data)
    return Guid(guid), instance


@lru_cache(_CONTENTS_KEPT)
def _content(data: bytes) -> Beacon:
    """The beacon in a packet of this version, whose number was replaced by zeros."""
    _, _, kind, domain, guid, instance, lease, _ = _FIXED.unpack_from(data)
    name, at = _counted(data, _FIXED.size, 1, "name")
    addresses, at = _counted(data, at, 4, "addresses")
    gossip, at = _counted(data, at, _GUID.size, "gossip")
    observed, _ = _counted(data, at, _ENDPOINT.size, "gossiped addresses")
    try:
        others = tuple(IPv4Address(addresses[i : i + 4]) for i in range(0, len(addresses), 4))
        return Beacon(
            BeaconKind(kind),
            Identity(Guid(guid), instance, name.decode("ascii"), domain, others),
            lease,
            0,
            tuple(Guid(value) for (value,) in _GUID.iter_unpack(gossip)),
            tuple((str(IPv4Address(host)), port) for host, port in _ENDPOINT.iter_unpack(observed)),
        )
    except ValueError as error:
        raise _malformed(str(error)) from error


def _counted(data: bytes, at: int, size: int, what: str) -> tuple[bytes, int]:
    """The items of ``size`` bytes behind their number at ``at``, and the offset behind them."""
    end = at + 1 + size * data[at] if at < len(data) else at + 1
    if end > len(data):
        raise _malformed(f"ends inside its {what}")
    return data[at + 1 : end], end


def _malformed(problem: str) -> BeaconRefused:
    return BeaconRefused(MALFORMED, f"malformed beacon: {problem}")


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

    def __init__(self, identity: Identity, endpoints: EndpointTable, counters: Counters, *, multicast: bool) -> None:
        self.identity = identity
        self.multicast = multicast
        self.closed = False
        self._endpoints = endpoints
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
        beacon = Beacon(kind, self.identity, round(PEER_LEASE * 1000), self._sequence, gossip, observed)
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
