"""The beacon: the packet by which peers announce themselves (docs/design/protocol.md, "Beacons").

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
from enum import IntEnum
from ipaddress import IPv4Address
from typing import Final

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
