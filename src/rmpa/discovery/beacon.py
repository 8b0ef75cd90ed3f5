"""The beacon: the packet by which peers announce themselves (docs/design/protocol.md, "Beacons").

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
from typing import Final

import rmpa
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import Guid, Identity, dialable
from rmpa.core.limits import UINT32_MAX
from rmpa.discovery import limits

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
