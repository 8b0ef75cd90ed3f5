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
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Final

import msgspec

from rmpa.core.limits import UINT32_MAX
from rmpa.trust import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

_NEVER: Final = float("-inf")
# What the tags of a group key are for, so that no bytes of another use can stand for one.
_PURPOSE: Final = b"rmpa beacon 1"


class GroupKey(msgspec.Struct, frozen=True):
    """One group key, as the signed list has it.

    Attributes:
        number: Counts the keys of a mesh from 1.
        secret: Random bytes; not in ``repr``.
    """

    number: Annotated[int, msgspec.Meta(ge=1, le=UINT32_MAX)]
    secret: Annotated[bytes, msgspec.Meta(min_length=limits.GROUP_KEY_BYTES, max_length=limits.GROUP_KEY_BYTES)] = (
        msgspec.field(name="key")
    )

    @property
    def short(self) -> int:
        """The low 16 bits of the number, as packets have them."""
        return self.number & 0xFFFF

    def tag(self, data: bytes) -> bytes:
        """The tag of a packet, by the key for packets: HMAC-SHA256(secret, purpose)."""
        return hmac.digest(hmac.digest(self.secret, _PURPOSE, hashlib.sha256), data, hashlib.sha256)[:_TAG]

    def __repr__(self) -> str:
        """The number alone: secrets never come into a log."""
        return f"GroupKey({self.number})"


@dataclass(slots=True)
class _Term:
    """A key, and when it is used; monotonic seconds."""

    key: GroupKey
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
        found = sorted(keys, key=lambda key: key.number)
        if not found:
            raise ValueError("a key ring has at least one key")
        # By number, in order.
        self._terms = {found[0].number: _Term(found[0], _NEVER)}
        self.take(found[1:-1], now, proves_from=proves_from, age=float("inf"))  # when they were made is not known
        self.take(found[-1:], now, proves_from=proves_from, age=age)

    @property
    def keys(self) -> tuple[GroupKey, ...]:
        """All keys, by number."""
        return tuple(term.key for term in self._terms.values())

    @property
    def newest(self) -> GroupKey:
        """The key with the highest number, which may not sign yet."""
        return self.keys[-1]

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
            self._terms[key.number] = _Term(key, signs_from)
        for number in list(self._terms)[: -limits.KEYS_MAX]:
            del self._terms[number]

    def signing(self, now: float) -> GroupKey:
        """The key that signs at ``now``."""
        signs = [term.key for term in self._terms.values() if term.signs_from <= now]
        return signs[-1] if signs else self.keys[0]

    def find(self, short: int) -> GroupKey | None:
        """The newest key whose number has these low 16 bits."""
        return next((key for key in reversed(self.keys) if key.short == short), None)

    def verifies(self, key: GroupKey, now: float) -> bool:
        """Whether a key proves membership at ``now``; an older one only recognises a module that was away."""
        return now <= self._terms[key.number].verifies_until

    def __repr__(self) -> str:
        """The numbers alone: secrets never come into a log."""
        return f"KeyRing({[key.number for key in self.keys]})"


_WINDOW: Final = limits.REPLAY_WINDOW
_MASK: Final = (1 << _WINDOW) - 1


class Verdict(StrEnum):
    """What the trailer says of a packet; the value is the end of the counter's name (``beacon.forged``)."""

    # A member sent it, just now.
    ACCEPTED = "accepted"
    # A module with an older group key sent it: it was away, or revoked. It is told where this one is.
    OLD_KEY = "old_key"
    # It has no trailer that this version knows.
    UNTAGGED = "untagged"
    # It is signed with a group key that is not known here: of another mesh, or newer than ours.
    UNKNOWN_KEY = "unknown_key"
    # Its tag is wrong.
    FORGED = "forged"
    # Its time is far from ours: it is an old packet, or one of the clocks is off.
    CLOCK = "clock"
    # It came before, perhaps by another interface.
    REPEATED = "repeated"
    # It is older than the last packets of its run.
    REPLAYED = "replayed"
    # Its number is further ahead than its run can have come: a member claims the run of another one.
    LEAP = "leap"


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

    def take(self, run: tuple[int, bytes], number: int, now: float) -> Verdict:
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
                return Verdict.LEAP
            bits = (bits << ahead & _MASK if ahead < _WINDOW else 0) | 1
            self._seen[run] = (number, bits, now)
            self._seen.move_to_end(run)
            if len(self._seen) > self._runs:
                self._seen.popitem(last=False)
            return Verdict.ACCEPTED
        if -ahead >= _WINDOW or number <= 0:
            return Verdict.REPLAYED
        bit = 1 << -ahead
        if bits & bit:
            return Verdict.REPEATED
        self._seen[run] = (highest, bits | bit, heard)
        return Verdict.ACCEPTED


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
# Flag: the sender's clock is set, so its time can be compared.
CLOCK_SET: Final = 1
_HEAD: Final = struct.Struct(">BBHQI")
_TAG: Final = limits.TAG_BYTES
# Bytes that the trailer adds to a packet.
TRAILER_BYTES: Final = _HEAD.size + _TAG
_TIME_MASK: Final = 0xFFFFFFFF
_TIME_HALF: Final = 1 << 31


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


class PacketTrust:
    """Signs the packets of one run, and judges those of others. What is refused leaves nothing behind.

    Args:
        ring: The group keys.
        wall: Seconds since 1970; ``None`` while this machine's clock is not set.
    """

    def __init__(self, ring: KeyRing, wall: Callable[[], float | None]) -> None:
        self.ring = ring
        self.wall = wall
        self._number = 0
        self._window = ReplayWindow()
        self._old_window = ReplayWindow(limits.OLD_KEYS_MAX)  # so that old keys push no run out of the other one

    def sign(self, packet: bytes, now: float, key: int = 0) -> bytes:
        """The packet with its trailer.

        Args:
            packet: As it is without trust.
            now: Monotonic seconds.
            key: The key for a module that has only an older one: the low 16 bits of its number; 0: the present key.
        """
        signing = (self.ring.find(key) if key else None) or self.ring.signing(now)
        self._number += 1
        wall = self.wall()
        flags, time = (0, 0) if wall is None else (CLOCK_SET, int(wall) & _TIME_MASK)
        body = packet + _HEAD.pack(FORMAT, flags, signing.short, self._number, time)
        return body + signing.tag(body)

    def verify(self, data: bytes, run: tuple[int, int], now: float) -> Verification:
        """Judge one packet.

        Args:
            data: The whole packet.
            run: Where the sender's instance id stands in it: begin and end.
            now: Monotonic seconds.
        """
        size = len(data) - TRAILER_BYTES
        if size < run[1]:
            return Verification(Verdict.UNTAGGED)
        form, flags, short, number, time = _HEAD.unpack_from(data, size)
        if form != FORMAT:
            return Verification(Verdict.UNTAGGED)
        key = self.ring.find(short)
        if key is None:
            return Verification(Verdict.UNKNOWN_KEY)
        if not hmac.compare_digest(key.tag(data[:-_TAG]), data[-_TAG:]):
            return Verification(Verdict.FORGED)
        skew, wall = 0, self.wall()
        if wall is not None and flags & CLOCK_SET:
            skew = (time - int(wall) + _TIME_HALF & _TIME_MASK) - _TIME_HALF
            if abs(skew) > limits.CLOCK_TOLERANCE:
                return Verification(Verdict.CLOCK, skew=skew)
        old = not self.ring.verifies(key, now)
        window = self._old_window if old else self._window
        verdict = window.take((key.number, data[slice(*run)]), number, now)
        if verdict is not Verdict.ACCEPTED:
            return Verification(verdict)
        return Verification(Verdict.OLD_KEY if old else Verdict.ACCEPTED, size, skew, short)
