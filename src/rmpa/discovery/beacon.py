"""The beacon, by which peers announce themselves, and which packets are parsed (docs/design/protocol.md, "Beacons").

A ``PacketFilter`` parses no floods, and in a secured mesh only packets with a proof.

Errors that ``Beacon.parse`` raises, all of them the sender's fault::

    RemoteProtocolError
    ├── LimitExceeded        longer than one packet may be
    └── BeaconRefused        no beacon, or one of another domain or version

The first eight bytes are the same in every version, so domain and version are judged before the rest is parsed.
"""

from __future__ import annotations

import logging
import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from ipaddress import IPv4Address
from typing import TYPE_CHECKING, Final

import rmpa
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import Guid, Identity, dialable
from rmpa.core.limits import UINT32_MAX
from rmpa.core.log import RefusalLog
from rmpa.core.timers import AddressLimit, TokenBucket
from rmpa.discovery import limits
from rmpa.trust import limits as trust_limits
from rmpa.trust.packets import PacketTrust, Verdict, Verification
from rmpa.trust.permissions import TrustReason, not_of_this_mesh

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.statistics import Counters

_log = logging.getLogger(__name__)

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


# Which packets of the discovery sockets are parsed.


# How long a module that is not of this mesh is shown after its last beacon: six heartbeats.
STRANGER_KEPT: Final = 30.0

# Packets a second without a valid proof that an agent of a secured mesh looks at: 37 microseconds each, 15 % of a
# core. Above it the socket is not read for a while, and the kernel drops what does not fit its buffer: beacons of
# members too, which are then sent more often (``MembershipProtocol.beacons_lost``), and which links do not need.
_BEACONS_UNPROVED_PER_SECOND: Final = 4000.0
# Refused beacons a second that are parsed for the names of their senders: 0.1 % of a core.
_STRANGER_BEACONS_PER_SECOND: Final = 50.0
# Source addresses whose packets are counted; the oldest is forgotten first.
_BEACON_SOURCES_MAX: Final = 4096

_INTERFACES: Final = 256
# What is told of the senders of packets that are refused; others are only counted.
_REFUSED: Final = {
    Verdict.UNTAGGED: TrustReason.UNSECURED,
    Verdict.UNKNOWN_KEY: TrustReason.KEY,
    Verdict.FORGED: TrustReason.FOREIGN,
}


@dataclass(slots=True)
class Stranger:
    """A module that is heard in the network and is not of this mesh. Nothing that it says is proved.

    Args:
        identity: As its last beacon said.
        problem: Why its beacons are refused, and what to do.
        reason: Likewise, as a word; ``REVOKED``: it has a group key from before a revocation, and the deny list says
            whether that was its own. ``None``: its clock, or its release.
        since: When it was first heard, monotonic seconds.
        heard: When it was last heard.
    """

    identity: Identity
    problem: str
    reason: TrustReason | None
    since: float
    heard: float


@dataclass(eq=False)
class PacketFilter:
    """Parses the packets of the discovery sockets; those that are dropped are counted.

    Dropped are floods, and in a secured mesh packets without a valid proof. A packet that comes by two interfaces is
    parsed twice; its number shows the membership protocol that it is a repeat.

    Args:
        domain: This agent's domain id.
        counters: ``beacon.in``, ``beacon.flood``, ``beacon.unlinked_limited``,
            ``beacon.other_domain``, ``beacon.version``, ``beacon.malformed``.
        is_verified: Whether a run of a peer has or had a link: beacons of such peers, and echoes of this agent's
            own, are not limited in rate.
        trust: Of a secured mesh: only packets whose trailer is accepted are parsed; ``beacon.untagged``,
            ``beacon.forged`` and so on count the others.

    Attributes:
        overrun: Whether packets without a valid proof come faster than they can be looked at: pause the reading.
    """

    domain: int
    counters: Counters
    is_verified: Callable[[Guid, bytes], bool] = lambda *_: False
    trust: PacketTrust | None = None

    def __post_init__(self) -> None:
        self._refusals = RefusalLog(_log, self.counters)
        # The limits, one for each kind of packet and each kind of sender: they are more than twelve fields together.
        self._unlinked: dict[int, TokenBucket] = {}
        self._unproved = TokenBucket(_BEACONS_UNPROVED_PER_SECOND, limits.BEACONS_UNPROVED_BURST)
        self._sources = AddressLimit(limits.BEACONS_PER_SOURCE, _BEACON_SOURCES_MAX)
        self._old_key_sources = AddressLimit(trust_limits.OLD_KEY_PACKETS_PER_ADDRESS, trust_limits.OLD_KEYS_MAX)
        self._old_keys = TokenBucket(trust_limits.OLD_KEY_PACKETS_RATE, trust_limits.OLD_KEY_PACKETS_RATE)
        self._strangers: dict[tuple[str, int], Stranger] = {}
        self._left_out = -math.inf
        self._stranger_beacons = TokenBucket(_STRANGER_BEACONS_PER_SECOND, _STRANGER_BEACONS_PER_SECOND)
        self.overrun = False

    def parse(
        self, data: bytes, source: Address, now: float, *, multicast: bool, interface: int = 0
    ) -> tuple[Beacon, int | None] | None:
        """What a packet contains; ``None`` if it is dropped, which is counted and, where it helps, logged.

        Other domains have other ports, so their multicasts are ignored silently. A unicast of another domain is
        logged: its sender was given this address by a user, and waits for an answer.

        Args:
            data: The packet.
            source: The address and port it came from.
            now: Monotonic seconds.
            multicast: Whether it came to the group.
            interface: The index of the interface it came in by: each has a limit of its own.

        Returns:
            The beacon; and the low 16 bits of the number of the older group key by which it is signed: then nothing
            in it is proved. ``None`` in place of them: it is of a member.
        """
        host, _ = source
        # First, where there is a proof: packets with the forged source of a member must not count as its flood.
        if self.trust is not None:
            if len(data) > limits.BEACON_MAX_BYTES:
                self.counters.add(MALFORMED)
                return None
            proof = self.trust.verify(data, INSTANCE_AT, now)
            if proof.verdict is not Verdict.ACCEPTED:
                return self._parse_unproved(proof, data, host, now)
        if not self._sources.take(host, now):
            text = f"{host} sends too many packets to the discovery port; the rest is ignored"
            self._refusals.refuse(now, "beacon.flood", host, text)
            return None
        beacon = self._read(data, host, now, multicast=multicast, interface=interface)
        return None if beacon is None else (beacon, None)

    def strangers(self, now: float) -> tuple[Stranger, ...]:
        """The modules whose beacons are refused and were heard lately, in the order in which they were found."""
        for key in [key for key, one in self._strangers.items() if now - one.heard > STRANGER_KEPT]:
            del self._strangers[key]
        return tuple(self._strangers.values())

    def strangers_note(self, now: float) -> str:
        """What a user is told while more such modules are heard than are shown; empty: all are shown."""
        if now - self._left_out > STRANGER_KEPT or len(self.strangers(now)) < limits.STRANGERS_SHOWN:
            return ""
        return (
            f"{limits.STRANGERS_SHOWN} modules that are not of this mesh are shown, which is the most; further ones "
            f"are heard, and not shown until one of these was silent for {STRANGER_KEPT:.0f} s"
        )

    def _read(self, data: bytes, host: str, now: float, *, multicast: bool, interface: int) -> Beacon | None:
        """Parse a packet within the limits of its sender."""
        try:
            verified = self.is_verified(*sender_of(data, self.domain))
            if not verified and not self._unlinked_limit(interface).take(now):
                self.counters.add("beacon.unlinked_limited")
                return None
            packet = Beacon.parse(data, self.domain)
        except RemoteProtocolError as error:
            counter = error.counter if isinstance(error, BeaconRefused) else MALFORMED
            if counter == OTHER_DOMAIN and multicast:
                self.counters.add(counter)
                return None
            foreign = f"from {host}: {error}; is another program there?"
            text = foreign if counter == MALFORMED else f"the peer at {host} {error}"
            self._refusals.refuse(now, counter, host, text)
            if counter == OTHER_VERSION:
                # Its name, if another release has it where this one does: a peer list without it would be a riddle.
                self._stranger(data[:4] + bytes([VERSION]) + data[5:], str(error), now)
            return None
        self.counters.add("beacon.in")
        return packet

    def _parse_unproved(
        self, proof: Verification, data: bytes, host: str, now: float
    ) -> tuple[Beacon, int | None] | None:
        """What a packet contains that no member of the secured mesh sent just now, but perhaps a former member.

        Nothing is remembered of other packets, so that forged ones cannot push out what is remembered of real ones.
        """
        verdict = proof.verdict
        if verdict is Verdict.OLD_KEY:
            # One address must not use up what there is for all.
            if self._old_key_sources.take(host, now) and self._old_keys.take(now):
                beacon = self._parsed(data)
                self.counters.add("beacon.old_key" if beacon is not None else MALFORMED)
                if beacon is None:
                    return None
                self._show(beacon, "", TrustReason.REVOKED, now)
                return beacon, proof.key
            self.counters.add("beacon.limited")
        self.overrun = not self._unproved.take(now)
        if verdict is Verdict.OLD_KEY:
            return None
        problem = _problem(proof)
        identity = self._stranger(data, problem, now, _REFUSED.get(verdict)) if problem else None
        if identity is not None:
            at = str(identity.guid.address)  # that of the packet is another one by each interface of a machine
            self._refusals.refuse(now, f"beacon.{verdict}", at, f"{identity.name} at {host} is {problem}")
        else:
            self.counters.add(f"beacon.{verdict}")
        return None

    def _parsed(self, data: bytes) -> Beacon | None:
        try:
            return Beacon.parse(data, self.domain)
        except RemoteProtocolError:
            return None

    def _stranger(self, data: bytes, problem: str, now: float, reason: TrustReason | None = None) -> Identity | None:
        """Take in a refused packet; return its sender if that is shown.

        One of the two modules has not joined a mesh, or is of another release.
        """
        beacon = self._parsed(data) if self._stranger_beacons.take(now) else None
        return None if beacon is None else self._show(beacon, problem, reason, now)

    def _show(self, beacon: Beacon, problem: str, reason: TrustReason | None, now: float) -> Identity | None:
        """Remember the sender of a beacon without a proof: few are, so a full table takes no more."""
        identity = beacon.identity
        key = identity.name, identity.guid.place
        if beacon.kind is BeaconKind.GOODBYE:
            self._strangers.pop(key, None)
            return None
        if key not in self._strangers and len(self.strangers(now)) >= limits.STRANGERS_SHOWN:
            self._left_out = now
            return None
        since = self._strangers[key].since if key in self._strangers else now
        self._strangers[key] = Stranger(identity, problem, reason, since, now)
        return identity

    def _unlinked_limit(self, interface: int) -> TokenBucket:
        """The limit of packets of unlinked peers on this interface."""
        bucket = self._unlinked.get(interface)
        if bucket is None:
            if len(self._unlinked) >= _INTERFACES:
                self._unlinked.clear()  # interfaces of containers come and go, each with a new index
            rate, burst = limits.BEACONS_UNLINKED_PER_SECOND, limits.BEACONS_UNLINKED_BURST
            bucket = self._unlinked[interface] = TokenBucket(rate, burst)
        return bucket


def _problem(found: Verification) -> str:
    """What is told of the sender of a packet that is refused; empty: it is only counted."""
    if found.verdict is Verdict.CLOCK:
        ahead = "ahead of" if found.skew > 0 else "behind"
        return f"refused: its clock is {abs(found.skew)} s {ahead} ours, or its beacons are replayed; set both clocks"
    return not_of_this_mesh(_REFUSED[found.verdict]) if found.verdict in _REFUSED else ""
