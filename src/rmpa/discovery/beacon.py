"""The beacon, senders that are no members of this mesh, and the events that discovery reports.

The beacon: the packet by which peers announce themselves (docs/design/protocol.md, "Beacons").

Errors that ``Beacon.parse`` raises, all of them the sender's fault::

    RemoteProtocolError
    ├── LimitExceeded        longer than one packet may be
    ├── BeaconMalformed      not a beacon, or one that contradicts itself
    ├── BeaconOtherDomain    of another domain: several may share a network, so this is no fault at all
    └── BeaconOtherVersion   of another version of this protocol

The first eight bytes are the same in every version, so the last two errors are found before the rest is parsed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import Enum, IntEnum
from ipaddress import IPv4Address
from typing import Final

from rmpa.core.counters import TokenBucket
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import Guid, Identity, dialable
from rmpa.core.limits import UINT32_MAX
from rmpa.discovery import limits

Address = tuple[str, int]
"""A numeric IPv4 address and a UDP port, as sockets have it."""

MAGIC: Final = b"RMPA"
VERSION: Final = 2

RUN_AT: Final = (16, 32)
"""Where the instance id stands in a beacon of any version 1: begin and end."""
_PREFIX: Final = struct.Struct(">4sBBH")
_FIXED: Final = struct.Struct(">4sBBHQ16sIIB")
_GUID: Final = struct.Struct(">Q")
_ENDPOINT: Final = struct.Struct(">4sH")


class BeaconKind(IntEnum):
    """Why a beacon was sent."""

    ANNOUNCE = 1
    """The sender has just started, or contacts an address that it learnt (seed, gossip); it asks for an answer."""
    HEARTBEAT = 2
    """The sender is still there."""
    ANSWER = 3
    """The unicast reply to a peer that announced itself; it is not answered."""
    GOODBYE = 4
    """The sender leaves."""


@dataclass
class BeaconMalformed(RemoteProtocolError):  # noqa: N818 - the name says what happened, as in core.errors
    """Bytes that are no beacon."""

    problem: str

    def __str__(self) -> str:
        """Say what is wrong with it."""
        return f"malformed beacon: {self.problem}"


@dataclass
class BeaconOtherVersion(RemoteProtocolError):  # noqa: N818
    """A peer of another version of the protocol."""

    version: int

    def __str__(self) -> str:
        """Say both versions and what to do."""
        return f"speaks version {self.version} of the protocol, we speak {VERSION}: update the older one"


@dataclass
class BeaconOtherDomain(RemoteProtocolError):  # noqa: N818
    """A peer of another domain."""

    domain: int

    def __str__(self) -> str:
        """Say which domain."""
        return f"is of domain {self.domain}"


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
            BeaconOtherDomain: The sender is of another domain, whatever its version.
            BeaconOtherVersion: The sender is of this domain and speaks another version.
            BeaconMalformed: Anything else is wrong.
        """
        sender_of(data, domain)
        _, _, kind, _, guid, instance, lease, sequence, name_length = _FIXED.unpack_from(data)
        name, offset = _take(data, _FIXED.size, name_length, "name")
        count, offset = _take(data, offset, 1, "number of addresses")
        if count[0] > limits.BEACON_ADDRESSES_MAX:
            raise BeaconMalformed(f"{count[0]} addresses")
        addresses, offset = _take(data, offset, 4 * count[0], "addresses")
        count, offset = _take(data, offset, 1, "number of gossiped peers")
        if count[0] > limits.BEACON_GOSSIP_MAX:
            raise BeaconMalformed(f"{count[0]} gossiped peers")
        gossip, offset = _take(data, offset, 8 * count[0], "gossip")
        count, offset = _take(data, offset, 1, "number of further addresses")
        if count[0] > limits.BEACON_GOSSIP_MAX:
            raise BeaconMalformed(f"{count[0]} further addresses of gossiped peers")
        observed, _ = _take(data, offset, _ENDPOINT.size * count[0], "gossiped addresses")
        try:
            return cls(
                BeaconKind(kind),
                Identity(
                    Guid(guid),
                    instance,
                    name.decode("ascii"),
                    domain,
                    tuple(IPv4Address(addresses[i : i + 4]) for i in range(0, len(addresses), 4)),
                ),
                lease,
                sequence,
                tuple(Guid(value) for (value,) in _GUID.iter_unpack(gossip)),
                tuple((str(IPv4Address(host)), at) for host, at in _ENDPOINT.iter_unpack(observed)),
            )
        except ValueError as error:
            raise BeaconMalformed(str(error)) from error

    def serialize(self) -> bytes:
        """The packet; never longer than ``limits.BEACON_MAX_BYTES``."""
        identity = self.identity
        name = identity.name.encode("ascii")
        return b"".join(
            (
                _FIXED.pack(
                    MAGIC,
                    VERSION,
                    self.kind,
                    identity.domain,
                    identity.guid.value,
                    identity.instance,
                    self.lease_ms,
                    self.sequence,
                    len(name),
                ),
                name,
                bytes((len(identity.addresses),)),
                *(address.packed for address in identity.addresses),
                bytes((len(self.gossip),)),
                *(_GUID.pack(guid.value) for guid in self.gossip),
                bytes((len(self.observed),)),
                *(_ENDPOINT.pack(IPv4Address(host).packed, at) for host, at in self.observed),
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
    _check_prefix(data, domain)
    if len(data) < _FIXED.size:
        raise BeaconMalformed(f"only {len(data)} bytes")
    _, _, _, _, guid, instance, *_ = _FIXED.unpack_from(data)
    return Guid(guid), instance


def _check_prefix(data: bytes, domain: int) -> None:
    """Refuse by size, magic, domain and version, in this order."""
    if len(data) > limits.BEACON_MAX_BYTES:
        raise LimitExceeded("a beacon", len(data), limits.BEACON_MAX_BYTES)
    if len(data) < _PREFIX.size:
        raise BeaconMalformed(f"only {len(data)} bytes")
    magic, version, _, its_domain = _PREFIX.unpack_from(data)
    if magic != MAGIC:
        raise BeaconMalformed("does not begin with RMPA")
    if its_domain != domain:
        raise BeaconOtherDomain(its_domain)
    if version != VERSION:
        raise BeaconOtherVersion(version)


def _take(data: bytes, offset: int, length: int, what: str) -> tuple[bytes, int]:
    end = offset + length
    if end > len(data):
        raise BeaconMalformed(f"ends inside its {what}")
    return data[offset:end], end


# Modules that are heard in the network and are not of this mesh, for the user: one of the two has not joined.


@dataclass(slots=True)
class Stranger:
    """One module whose beacons are refused. Nothing that it says is proved.

    Args:
        identity: As its last beacon said.
        problem: Why they are refused, and what to do.
        since: When it was first heard, monotonic seconds.
        heard: When it was last heard.
    """

    identity: Identity
    problem: str
    since: float
    heard: float


class Strangers:
    """The modules whose beacons are refused, few at a time: a full table takes no more until one falls silent."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int], Stranger] = {}
        self._rate = TokenBucket(limits.STRANGER_BEACONS_PER_SECOND, limits.STRANGER_BEACONS_PER_SECOND)

    def may_read(self, now: float) -> bool:
        """Whether one more refused beacon may be parsed for its name."""
        return self._rate.take(now)

    def hear(self, beacon: Beacon, problem: str, now: float) -> bool:
        """Take in a refused beacon; return whether its sender is shown."""
        self._expire(now)
        identity = beacon.identity
        key = identity.name, identity.guid.place
        if beacon.kind is BeaconKind.GOODBYE:
            self._known.pop(key, None)
            return False
        known = self._known.get(key)
        if known is not None:
            known.identity, known.problem, known.heard = identity, problem, now
        elif len(self._known) < limits.STRANGERS_SHOWN:
            self._known[key] = Stranger(identity, problem, now, now)
        return key in self._known

    def shown(self, now: float) -> tuple[Stranger, ...]:
        """Those that were heard lately, in the order in which they were found."""
        self._expire(now)
        return tuple(self._known.values())

    def _expire(self, now: float) -> None:
        for key in [key for key, one in self._known.items() if now - one.heard > limits.STRANGER_KEPT]:
            del self._known[key]


# Events and outputs of the membership protocol, and the view of a peer.


class HeardBy(Enum):
    """How a peer was heard."""

    MULTICAST = "multicast"
    UNICAST = "unicast"
    GOSSIP = "gossip"
    """It answered an announcement to an address that another peer's gossip had."""
    LINK = "link"


class LossReason(Enum):
    """Why a peer is no member any more."""

    SILENCE = "silent for its lease"
    GOODBYE = "said goodbye"
    MOVED = "started anew at another port"
    CONFLICT = "another live peer has its GUID address"


class ConflictKind(Enum):
    """The property that two live peers share, though it must be unique."""

    GUID = "guid"
    OWN_GUID = "own guid"
    NAME = "name"


@dataclass(frozen=True, slots=True)
class PeerFound:
    """A peer has become a member.

    Args:
        identity: As in its beacon or handshake.
        source: Where its first packet came from; ``None`` if a link brought it.
        heard: How it was found.
    """

    identity: Identity
    source: Address | None
    heard: HeardBy

    @property
    def guid(self) -> Guid:
        """The peer's GUID."""
        return self.identity.guid


@dataclass(frozen=True, slots=True)
class PeerChanged:
    """The same run of a peer has another identity: addresses or name have changed."""

    identity: Identity
    previous: Identity

    @property
    def guid(self) -> Guid:
        """The peer's GUID as it is now."""
        return self.identity.guid


@dataclass(frozen=True, slots=True)
class PeerRestarted:
    """Another run of an agent is at the endpoint of ``previous``, which is gone."""

    identity: Identity
    previous: Identity
    source: Address | None

    @property
    def guid(self) -> Guid:
        """The new run's GUID."""
        return self.identity.guid


@dataclass(frozen=True, slots=True)
class PeerLost:
    """A peer is no member any more."""

    identity: Identity
    reason: LossReason

    @property
    def guid(self) -> Guid:
        """The GUID it had."""
        return self.identity.guid


@dataclass(frozen=True, slots=True)
class PeerConflict:
    """Two live peers claim the same GUID address or name. ``str`` says what to do. Reported once until it clears.

    Args:
        kind: What they share.
        identity: The peer that was heard now.
        other: The peer that was there; this agent itself for ``OWN_GUID`` and perhaps for ``NAME``.
    """

    kind: ConflictKind
    identity: Identity
    other: Identity

    def __str__(self) -> str:
        """What happened, where, and what to do."""
        host, port = self.identity.guid.endpoint
        if self.kind is ConflictKind.NAME:
            return (
                f"two modules are named {self.identity.name}: {self.identity.guid} and {self.other.guid}, so rules "
                "and commands that name it may mean either; rename one: rmpa up --name"
            )
        if self.kind is ConflictKind.OWN_GUID:
            what = f"the live peer {self.identity.name} has our own GUID address {host}:{port}"
        else:
            what = f"two live peers share one GUID address {host}:{port}: {self.identity.name} and {self.other.name}"
        return f"{what}; give one of them another --port, or fix the NAT between them"


@dataclass(frozen=True, slots=True)
class RunDoubted:
    """Another run was heard at the address of a linked peer: its link is worth a check, as it may have restarted."""

    identity: Identity
    """The linked run."""


@dataclass(frozen=True, slots=True)
class ConflictCleared:
    """Only one of the two peers of a ``PeerConflict`` over a GUID address is left."""

    kind: ConflictKind
    identity: Identity


Event = PeerFound | PeerChanged | PeerRestarted | PeerLost | PeerConflict | RunDoubted | ConflictCleared


@dataclass(frozen=True, slots=True)
class SendMulticast:
    """Send to the group, on every usable interface."""

    beacon: Beacon


@dataclass(frozen=True, slots=True)
class SendUnicast:
    """Send to one address.

    Args:
        beacon: What is sent.
        address: Where to.
        key: Of a secured mesh: the number of the older group key that the receiver has (its low 16 bits); 0: the
            present one.
    """

    beacon: Beacon
    address: Address
    key: int = 0


Output = SendMulticast | SendUnicast


@dataclass(frozen=True, slots=True)
class PeerView:
    """One peer, for display.

    Args:
        identity: As in its last beacon or handshake.
        since: When it was found, in seconds of the protocol's clock.
        heard: When it was last heard by beacon or had a link, on the same clock.
        found_by: How it was found.
        heard_by: How it was last heard.
        source: Where its last packet came from, if there was one.
        linked: Whether it has a link.
        conflicts: Its conflicts, as texts for the user.
        present: Whether it is a member; ``False`` while a conflict prevents it.
    """

    identity: Identity
    since: float
    heard: float
    found_by: HeardBy
    heard_by: HeardBy
    source: Address | None
    linked: bool
    conflicts: tuple[str, ...]
    present: bool
