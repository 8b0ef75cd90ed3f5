"""The trailer by which UDP packets of a secured mesh prove that a member sent them (docs/design/trust.md).

It is the last 32 bytes of a packet, in the part that version 1 of the beacon leaves to later versions, so that it is
checked before anything is parsed::

     0 format   1 byte    1
     1 flags    1 byte    bit 0: the sender's clock is set
     2 key      2 bytes   the low 16 bits of the group key's number
     4 number   8 bytes   counts the signed packets of this run, from 1
    12 time     4 bytes   wall clock of the sender, seconds since 1970 modulo 2³²; 0 if it is not set
    16 tag     16 bytes   HMAC-SHA256 over all bytes before it, the first half

It proves membership, not identity: any member has the key. Identity is proved by TLS when a link comes up.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.trust import limits
from rmpa.trust.replay import Freshness, ReplayWindow

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.trust.keyring import KeyPurpose, KeyRing

FORMAT: Final = 1
CLOCK_SET: Final = 1
"""Flag: the sender's clock is set, so its time can be compared."""
_HEAD: Final = struct.Struct(">BBHQI")
_TAG: Final = limits.TAG_BYTES
TRAILER_BYTES: Final = _HEAD.size + _TAG
"""Bytes that the trailer adds to a packet."""
_TIME_MASK: Final = 0xFFFFFFFF
_TIME_HALF: Final = 1 << 31


class Verdict(StrEnum):
    """What the trailer says of a packet; the value is the end of the counter's name (``beacon.forged``)."""

    ACCEPTED = "accepted"
    """A member sent it, just now."""
    OLD_KEY = "old_key"
    """A module with an older group key sent it: it was away, or revoked. It is told where this one is."""
    UNTAGGED = "untagged"
    """It has no trailer that this version knows."""
    UNKNOWN_KEY = "unknown_key"
    """It is signed with a group key that is not known here: of another mesh, or newer than ours."""
    FORGED = "forged"
    """Its tag is wrong."""
    CLOCK = "clock"
    """Its time is far from ours: it is an old packet, or one of the clocks is off."""
    REPEATED = "repeated"
    """It came before, perhaps by another interface."""
    REPLAYED = "replayed"
    """It is older than the last packets of its run."""
    LEAP = "leap"
    """Its number is further ahead than its run can have come: a member claims the run of another one."""


_STALE: Final = {
    Freshness.REPEATED: Verdict.REPEATED,
    Freshness.STALE: Verdict.REPLAYED,
    Freshness.LEAP: Verdict.LEAP,
}


@dataclass(frozen=True, slots=True)
class Verification:
    """The result for one packet.

    Args:
        verdict: Only of an accepted packet anything may be used.
        size: Bytes of the packet without its trailer.
        key: The low 16 bits of the number of its group key, if its tag is right.
        skew: By how many seconds the sender's clock is ahead of ours; 0 if either is not set.
    """

    verdict: Verdict
    size: int = 0
    skew: int = 0
    key: int = field(default=0, compare=False)


class PacketSigner:
    """Signs the packets of one run.

    Args:
        ring: The group keys.
    """

    def __init__(self, ring: KeyRing) -> None:
        self._ring = ring
        self._number = 0

    def sign(self, packet: bytes, purpose: KeyPurpose, now: float, wall: float | None, *, key: int = 0) -> bytes:
        """The packet with its trailer.

        Args:
            packet: As it is without trust.
            purpose: What kind of packet it is.
            now: Monotonic seconds.
            wall: Seconds since 1970; ``None`` if this machine's clock is not set.
            key: The key for a module that has only an older one: the low 16 bits of its number; 0: the present key.
        """
        signing = (self._ring.find(key) if key else None) or self._ring.signing(now)
        self._number += 1
        flags, time = (0, 0) if wall is None else (CLOCK_SET, int(wall) & _TIME_MASK)
        body = packet + _HEAD.pack(FORMAT, flags, signing.short, self._number, time)
        return body + hmac.digest(signing.key_for(purpose), body, hashlib.sha256)[:_TAG]


class PacketVerifier:
    """Checks the trailers of received packets. What is refused leaves nothing behind.

    Args:
        ring: The group keys.
    """

    def __init__(self, ring: KeyRing) -> None:
        self._ring = ring
        self._window = ReplayWindow()
        self._old_window = ReplayWindow(limits.OLD_KEYS_MAX)  # so that old keys push no run out of the other one

    def verify(
        self, data: bytes, purpose: KeyPurpose, run: tuple[int, int], now: float, wall: float | None
    ) -> Verification:
        """Judge one packet.

        Args:
            data: The whole packet.
            purpose: What kind of packet it must be.
            run: Where the sender's instance id stands in it: begin and end.
            now: Monotonic seconds.
            wall: Seconds since 1970; ``None`` if this machine's clock is not set.
        """
        size = len(data) - TRAILER_BYTES
        if size < run[1]:
            return Verification(Verdict.UNTAGGED)
        form, flags, short, number, time = _HEAD.unpack_from(data, size)
        if form != FORMAT:
            return Verification(Verdict.UNTAGGED)
        key = self._ring.find(short)
        if key is None:
            return Verification(Verdict.UNKNOWN_KEY)
        tag = hmac.digest(key.key_for(purpose), data[:-_TAG], hashlib.sha256)[:_TAG]
        if not hmac.compare_digest(tag, data[-_TAG:]):
            return Verification(Verdict.FORGED)
        skew = 0
        if wall is not None and flags & CLOCK_SET:
            skew = (time - int(wall) + _TIME_HALF & _TIME_MASK) - _TIME_HALF
            if abs(skew) > limits.CLOCK_TOLERANCE:
                return Verification(Verdict.CLOCK, skew=skew)
        old = not self._ring.verifies(key, now)
        window = self._old_window if old else self._window
        freshness = window.take((key.number, data[slice(*run)]), number, now)
        if freshness is not Freshness.NEW:
            return Verification(_STALE[freshness])
        return Verification(Verdict.OLD_KEY if old else Verdict.ACCEPTED, size, skew, short)


@dataclass(frozen=True, slots=True)
class PacketTrust:
    """What the senders and receivers of packets need in a secured mesh.

    Args:
        signer: Signs what this agent sends.
        verifier: Judges what it receives.
        wall: Seconds since 1970; ``None`` while this machine's clock is not set.
    """

    signer: PacketSigner
    verifier: PacketVerifier
    wall: Callable[[], float | None]
