"""Digests of catalogues, by which two modules find out whether both have the same one. Pure.

The digest of a catalogue is the sum, modulo 2^64, of a hash of each entry: of the first 8 bytes of BLAKE2b over the
entry's JSON text, as an advertisement has it. So it does not depend on the order of the entries, and changes with one
entry at the cost of one hash. It is a check against errors, not a proof against forgers: in a secured mesh the link
that carries it is authenticated.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.sizes import UINT32_MAX

if TYPE_CHECKING:
    from collections.abc import Iterable

DIGEST_BYTES: Final = 8
"""Two catalogues that differ have the same digest by chance once in 2^64 (10^19) times; a thousand modules compare
10^8 a day at most."""
_MASK: Final = (1 << 8 * DIGEST_BYTES) - 1
_RUN_BYTES: Final = 8
_HELD: Final = struct.Struct(f">{_RUN_BYTES}sIQQ")
_ENCODE: Final = msgspec.json.Encoder().encode


def entry_hash(entry: object) -> int:
    """The hash of one entry: an offer, as a message has it."""
    return int.from_bytes(blake2b(_ENCODE(entry), digest_size=DIGEST_BYTES).digest(), "big")


def with_entry(digest: int, entry: object) -> int:
    """The digest of a catalogue after an entry was added."""
    return digest + entry_hash(entry) & _MASK


def without_entry(digest: int, entry: object) -> int:
    """The digest of a catalogue after an entry was removed."""
    return digest - entry_hash(entry) & _MASK


def digest_of(entries: Iterable[object]) -> int:
    """The digest of a whole catalogue; 0 if it is empty."""
    return sum(map(entry_hash, entries)) & _MASK


def digest_text(digest: int) -> str:
    """A digest as 16 hexadecimal digits, as messages and texts for the user have it."""
    return f"{digest:0{2 * DIGEST_BYTES}x}"


def parse_digest(text: object) -> int | None:
    """Read such a digest; ``None`` if it is none."""
    if not isinstance(text, str) or len(text) != 2 * DIGEST_BYTES:
        return None
    try:
        return int.from_bytes(bytes.fromhex(text), "big")
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class HeldOffers:
    """What a module holds of the offers of one run of a peer, as its hello says it.

    Args:
        run: The first 8 bytes of the peer's instance id.
        version: The version of the peer's offers, 32 bits.
        topics: The digest of the peer's topics.
        services: The digest of the peer's services.
    """

    run: bytes
    version: int
    topics: int
    services: int

    @classmethod
    def of(cls, instance: bytes, version: int, topics: int, services: int) -> HeldOffers:
        """What is held of the offers of the run with this instance id."""
        return cls(instance[:_RUN_BYTES], version, topics, services)

    @classmethod
    def parse(cls, data: bytes) -> HeldOffers | None:
        """Read the bytes of a hello; ``None`` if they say nothing, or are of a later form."""
        if len(data) != _HELD.size:
            return None
        run, version, topics, services = _HELD.unpack(data)
        return cls(run, version, topics, services) if 0 < version <= UINT32_MAX else None

    def serialize(self) -> bytes:
        """The bytes in a hello: 28."""
        return _HELD.pack(self.run, self.version, self.topics, self.services)

    def is_of(self, instance: bytes) -> bool:
        """Whether this is about the run with this instance id."""
        return self.run == instance[:_RUN_BYTES]

    def __str__(self) -> str:
        """``version 3, topics 00…, services 00…``."""
        return f"version {self.version}, topics {digest_text(self.topics)}, services {digest_text(self.services)}"
