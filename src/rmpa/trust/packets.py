"""Tags of packets by group keys, and which packets are replays.

Group keys: the secrets that all members of a mesh share, and which of them signs and verifies at a time.

A new key verifies at once and signs ``limits.KEY_SPREAD`` later, when it has reached every linked module. The key
before verifies for ``limits.KEY_OVERLAP`` more; older ones are still known, so that a module that was away is
recognised. The key that a revocation makes signs at once, and all before it only recognise from then on: the module
that was revoked has them.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from collections import OrderedDict
from dataclasses import dataclass, field
from enum import Enum, StrEnum, auto
from typing import TYPE_CHECKING, Final

from rmpa.core.limits import UINT32_MAX
from rmpa.trust import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

_LOW: Final = 0xFFFF
_NEVER: Final = float("-inf")


class KeyPurpose(StrEnum):
    """What a key signs. Each has a key of its own, so that no bytes of one can stand for another."""

    BEACON = "rmpa beacon 1"


@dataclass(frozen=True, slots=True)
class GroupKey:
    """One group key.

    Args:
        number: Counts the keys of a mesh from 1; 32 bits.
        secret: ``limits.GROUP_KEY_BYTES`` random bytes; not in ``repr``.

    Raises:
        ValueError: A part is out of its range.
    """

    number: int
    secret: bytes = field(repr=False)
    _derived: dict[KeyPurpose, bytes] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0 < self.number <= UINT32_MAX:
            raise ValueError(f"a group key's number has 32 bits and is not 0, not {self.number}")
        if len(self.secret) != limits.GROUP_KEY_BYTES:
            raise ValueError(f"a group key has {limits.GROUP_KEY_BYTES} bytes, not {len(self.secret)}")

    def key_for(self, purpose: KeyPurpose) -> bytes:
        """The key that signs for one purpose: HMAC-SHA256(secret, purpose)."""
        derived = self._derived.get(purpose)
        if derived is None:
            derived = self._derived[purpose] = hmac.digest(self.secret, purpose.value.encode(), hashlib.sha256)
        return derived

    @property
    def short(self) -> int:
        """The low 16 bits of the number, as packets have them."""
        return self.number & _LOW


@dataclass(slots=True)
class _Term:
    """When a key is used; monotonic seconds."""

    signs_from: float
    verifies_until: float = float("inf")


class KeyRing:
    """The group keys that one agent has.

    Args:
        keys: Those of its files.
        now: Monotonic seconds.
        proves_from: As for ``take``.
        age: Likewise; by default so long ago that the newest key signs.

    Raises:
        ValueError: There is no key.
    """

    def __init__(
        self, keys: Iterable[GroupKey], now: float, *, proves_from: int = 0, age: float = float("inf")
    ) -> None:
        found = sorted({key.number: key for key in keys}.values(), key=lambda key: key.number)
        if not found:
            raise ValueError("a key ring has at least one key")
        self._keys = found[:1]
        self._terms = {found[0].number: _Term(_NEVER)}
        self.take(found[1:-1], now, proves_from=proves_from, age=float("inf"))  # when they were made is not known
        self.take(found[-1:], now, proves_from=proves_from, age=age)

    @property
    def newest(self) -> GroupKey:
        """The key with the highest number, which may not sign yet."""
        return self._keys[-1]

    @property
    def keys(self) -> tuple[GroupKey, ...]:
        """All keys, by number."""
        return tuple(self._keys)

    def take(self, keys: Iterable[GroupKey], now: float, *, proves_from: int = 0, age: float = 0.0) -> None:
        """Take in the keys that are newer than all others; the others are ignored.

        Args:
            keys: A list of the authority.
            now: Monotonic seconds.
            proves_from: The number of the key that the last revocation made: older ones only recognise.
            age: Seconds since the newest of them was made.
        """
        for key in sorted(keys, key=lambda key: key.number):
            if key.number <= self.newest.number:
                continue
            signs_from = now if key.number <= proves_from else now - age + limits.KEY_SPREAD
            for number, term in self._terms.items():
                until = _NEVER if number < proves_from else signs_from + limits.KEY_OVERLAP
                term.verifies_until = min(term.verifies_until, until)
            self._keys.append(key)
            self._terms[key.number] = _Term(signs_from)
        for old in self._keys[: -limits.KEYS_MAX]:
            del self._terms[old.number]
        del self._keys[: -limits.KEYS_MAX]

    def signing(self, now: float) -> GroupKey:
        """The key that signs at ``now``."""
        for key in reversed(self._keys):
            if self._terms[key.number].signs_from <= now:
                return key
        return self._keys[0]

    def find(self, short: int) -> GroupKey | None:
        """The newest key whose number has these low 16 bits."""
        return next((key for key in reversed(self._keys) if key.short == short), None)

    def verifies(self, key: GroupKey, now: float) -> bool:
        """Whether a key proves membership at ``now``; an older one only recognises a module that was away."""
        return now <= self._terms[key.number].verifies_until

    def __repr__(self) -> str:
        """The numbers alone: secrets never come into a log."""
        return f"KeyRing({[key.number for key in self._keys]})"


# Recognises packets that are sent again, by their numbers (RFC 4303, section 3.4.3).


_WINDOW: Final = limits.REPLAY_WINDOW
_MASK: Final = (1 << _WINDOW) - 1


class Freshness(Enum):
    """What a number says of its packet."""

    NEW = auto()
    """It was not seen before."""
    REPEATED = auto()
    """It was seen: the packet came by a second interface, or was sent again."""
    STALE = auto()
    """It is too far behind the highest one to say."""
    LEAP = auto()
    """It is further ahead of the highest one than the run can have come."""


class ReplayWindow:
    """The numbers that were seen of each run. Only numbers of packets with a valid tag may come here.

    Each group key has numbers of its own here: a revoked module, which has the key before, can claim any run and
    number with it, and must not touch what is remembered of the present key's packets.

    Args:
        runs: Runs that are remembered; the one that was silent for longest is forgotten first.
    """

    def __init__(self, runs: int = limits.RUNS_MAX) -> None:
        self._runs = runs
        self._seen: OrderedDict[tuple[int, bytes], tuple[int, int, float]] = OrderedDict()
        # The highest number, a bit for each of the last ones, the lowest for the highest number, and when it came.

    def __len__(self) -> int:
        return len(self._seen)

    def take(self, run: tuple[int, bytes], number: int, now: float) -> Freshness:
        """Judge a number of a run, and remember it unless it is a leap.

        Args:
            run: The number of the group key, and the instance id of the sender.
            number: From 1; 64 bits, never wraps.
            now: Monotonic seconds.
        """
        highest, bits, heard = self._seen.get(run, (0, 0, now))
        ahead = number - highest
        if ahead > 0:
            if highest and ahead > limits.REPLAY_LEAP + (now - heard) * limits.REPLAY_LEAP_RATE:
                return Freshness.LEAP
            bits = (bits << ahead & _MASK if ahead < _WINDOW else 0) | 1
            self._seen[run] = (number, bits, now)
            self._seen.move_to_end(run)
            if len(self._seen) > self._runs:
                self._seen.popitem(last=False)
            return Freshness.NEW
        if -ahead >= _WINDOW or number <= 0:
            return Freshness.STALE
        bit = 1 << -ahead
        if bits & bit:
            return Freshness.REPEATED
        self._seen[run] = (highest, bits | bit, heard)
        return Freshness.NEW


# The trailer by which UDP packets of a secured mesh prove that a member sent them (docs/design/trust.md).
#
# It is the last 32 bytes of a packet, in the part that version 1 of the beacon leaves to later versions, so that
# it is
# checked before anything is parsed::
#
#      0 format   1 byte    1
#      1 flags    1 byte    bit 0: the sender's clock is set
#      2 key      2 bytes   the low 16 bits of the group key's number
#      4 number   8 bytes   counts the signed packets of this run, from 1
#     12 time     4 bytes   wall clock of the sender, seconds since 1970 modulo 2³²; 0 if it is not set
#     16 tag     16 bytes   HMAC-SHA256 over all bytes before it, the first half
#
# It proves membership, not identity: any member has the key. Identity is proved by TLS when a link comes up.


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
