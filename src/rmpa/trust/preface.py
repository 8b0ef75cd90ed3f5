"""The preface: the first bytes of a TCP connection of a secured mesh, in front of TLS (docs/design/trust.md).

::

     0 magic     4 bytes   RMPS
     4 version   1 byte    1
     5 purpose   1 byte    1 link, 2 join, 3 renewal
     6 key       2 bytes   the low 16 bits of the group key's number; 0 for a join
     8 id        8 bytes   join: the token's; else 0
    16 time      8 bytes   the dialler's wall clock in ms since 1970; 0 if it is not set, and for a join
    24 nonce    16 bytes   random
    40 tag      16 bytes   HMAC-SHA256 over all before it, the first half

It shows that the dialler has the group key, or a token, before OpenSSL is given a byte: a TLS handshake costs a
thousand times as much. It proves nothing else; TLS does.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

from rmpa.core.token_bucket import TokenBucket
from rmpa.trust import limits
from rmpa.trust.keyring import KeyPurpose
from rmpa.trust.reasons import TrustError, TrustReason

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.trust.keyring import KeyRing

MAGIC: Final = b"RMPS"
VERSION: Final = 1
_HEAD: Final = struct.Struct(">4sBBH8sQ16s")
PREFACE_BYTES: Final = _HEAD.size + limits.TAG_BYTES
"""Bytes of a preface."""
NO_ID: Final = bytes(8)
"""The id of a preface that belongs to no token."""
Buffer = bytes | bytearray | memoryview


class Purpose(IntEnum):
    """What a connection is for."""

    LINK = 1
    """A lane of a link between two members."""
    JOIN = 2
    """A module that has a token asks for a certificate."""
    RENEWAL = 3
    """A member whose certificate has ended asks for another."""


class PrefaceError(TrustError):
    """Bytes that are not the preface of a secured mesh; ``reason`` is answered where the dialler can read it."""


@dataclass(frozen=True, slots=True)
class Preface:
    """One preface, without its tag.

    Args:
        purpose: What the connection is for.
        key: The low 16 bits of the group key's number; 0 for a join.
        time_ms: The dialler's wall clock; 0 if it is not set.
        nonce: 16 random bytes.
        token_id: The id of a token, 8 bytes.

    Raises:
        ValueError: A part is out of its range.
    """

    purpose: Purpose
    key: int
    time_ms: int
    nonce: bytes
    token_id: bytes = NO_ID

    def __post_init__(self) -> None:
        if len(self.nonce) != limits.PREFACE_NONCE_BYTES or len(self.token_id) != len(NO_ID):
            raise ValueError("a nonce has 16 bytes, and a token's id 8")
        if not (0 <= self.key < 1 << 16 and 0 <= self.time_ms < 1 << 64):
            raise ValueError("the key has 16 bits, and the time 64")

    @classmethod
    def parse(cls, data: Buffer) -> Preface:
        """Read a preface; its tag is not checked.

        Args:
            data: The first ``PREFACE_BYTES`` bytes of the connection, or more.

        Raises:
            PrefaceError: It is none, or of a version that is not known.
        """
        if len(data) < PREFACE_BYTES:
            raise PrefaceError(TrustReason.PLAIN, f"only {len(data)} bytes of a preface")
        magic, version, purpose, key, token_id, time_ms, nonce = _HEAD.unpack_from(data)
        if magic != MAGIC:
            raise PrefaceError(TrustReason.PLAIN, "it does not begin as a secured connection does")
        if version != VERSION or purpose not in _PURPOSES:
            raise PrefaceError(TrustReason.DOWNGRADE, f"version {version}, purpose {purpose} of the preface")
        return cls(Purpose(purpose), key, time_ms, nonce, token_id)

    def serialize(self, key: bytes) -> bytes:
        """The bytes on the wire, signed with a key (``GroupKey.key_for``, or a token's)."""
        head = _HEAD.pack(MAGIC, VERSION, self.purpose, self.key, self.token_id, self.time_ms, self.nonce)
        return head + _tag(key, head)

    def __str__(self) -> str:
        """``link with key 3``."""
        return f"{self.purpose.name.lower()} with key {self.key}"


_PURPOSES: Final = frozenset(Purpose)


def is_preface(data: Buffer) -> bool | None:
    """Whether a connection begins with a preface; ``None``: more bytes are needed to say."""
    begin = bytes(data[: len(MAGIC)])
    if not MAGIC.startswith(begin):
        return False
    return True if len(begin) == len(MAGIC) else None


def signed_with(data: Buffer, key: bytes) -> bool:
    """Whether the preface at the start of ``data`` has the tag of a key."""
    return hmac.compare_digest(_tag(key, bytes(data[: _HEAD.size])), bytes(data[_HEAD.size : PREFACE_BYTES]))


def _tag(key: bytes, head: bytes) -> bytes:
    return hmac.digest(key, head, hashlib.sha256)[: limits.TAG_BYTES]


class _Nonces:
    """The nonces of one kind of dialler: those of another kind cannot use up its places."""

    def __init__(self) -> None:
        self._seen: set[bytes] = set()
        self._there: Counter[str] = Counter()
        self._order: deque[tuple[float, bytes, str]] = deque()

    def __len__(self) -> int:
        return len(self._seen)

    def check(self, nonce: bytes, now: float, host: str) -> None:
        """Raise ``PrefaceError`` if a nonce came before, or there is no place for it."""
        while self._order and self._order[0][0] <= now:
            _, old, there = self._order.popleft()
            self._seen.discard(old)
            self._there[there] -= 1
            if not self._there[there]:
                del self._there[there]
        if nonce in self._seen:
            raise PrefaceError(TrustReason.FLOOD, "the same preface came before")
        if len(self._seen) >= limits.NONCES_MAX or self._there[host] >= limits.NONCES_PER_ADDRESS:
            raise PrefaceError(TrustReason.FLOOD, "too many handshakes at present")

    def keep(self, nonce: bytes, now: float, host: str) -> None:
        """Remember a nonce that was checked."""
        self._seen.add(nonce)
        self._there[host] += 1
        self._order.append((now + limits.NONCE_KEPT, nonce, host))


class PrefaceGuard:
    """Decides which accepted connections may begin a TLS handshake.

    Args:
        ring: The group keys.
        token_key: The key of an open token by its id; ``None`` if there is no such token.
    """

    def __init__(self, ring: KeyRing, token_key: Callable[[bytes], bytes | None] = lambda _: None) -> None:
        self._ring = ring
        self._token_key = token_key
        self._members, self._recognised, self._invited = _Nonces(), _Nonces(), _Nonces()
        self._old_keys = TokenBucket(limits.OLD_KEY_DIALS_RATE, limits.OLD_KEY_DIALS_RATE)
        self._old_keys_there: OrderedDict[str, TokenBucket] = OrderedDict()

    def admit(self, data: Buffer, now: float, wall: float | None, host: str = "") -> tuple[Preface, bool]:
        """The preface of a connection that may go on, and whether it shows a group key that only recognises.

        Args:
            data: Its first bytes, ``PREFACE_BYTES`` or more.
            now: Monotonic seconds.
            wall: Seconds since 1970; ``None`` if this machine's clock is not set.
            host: The address of the dialler: none of them can use up the rates and places of all.

        Raises:
            PrefaceError: The connection is refused; then nothing is remembered of it.
        """
        preface = Preface.parse(data)
        old = self._check_tag(preface, data, now)
        if wall is not None and preface.time_ms:
            skew = preface.time_ms / 1000 - wall
            if abs(skew) > limits.CLOCK_TOLERANCE:
                ahead = "ahead of" if skew > 0 else "behind"
                raise PrefaceError(
                    TrustReason.CLOCK, f"the dialler's clock is {abs(skew):.0f} s {ahead} the acceptor's"
                )
        join = preface.purpose is Purpose.JOIN
        nonces = self._invited if join else self._recognised if old else self._members
        nonces.check(preface.nonce, now, host)
        if old and not self._take_old(host, now):
            raise PrefaceError(TrustReason.FLOOD, "too many connections with an old group key")
        nonces.keep(preface.nonce, now, host)
        return preface, old

    def _check_tag(self, preface: Preface, data: Buffer, now: float) -> bool:
        """Check the tag, and return whether it is of a group key that only recognises."""
        if preface.purpose is Purpose.JOIN:
            key = self._token_key(preface.token_id)
            if key is None or not signed_with(data, key):
                raise PrefaceError(TrustReason.KEY, "the dialler's token is unknown here, was used or has ended")
            return False
        group = self._ring.find(preface.key)
        if group is None:
            raise PrefaceError(TrustReason.KEY, f"the dialler's group key {preface.key} is unknown to the acceptor")
        if not signed_with(data, group.key_for(KeyPurpose.PREFACE)):
            raise PrefaceError(TrustReason.KEY, f"the dialler does not have the acceptor's group key {preface.key}")
        return not self._ring.verifies(group, now)

    def _take_old(self, host: str, now: float) -> bool:
        """Whether one more connection with an old group key is within the rates of its address and of all."""
        there = self._old_keys_there.get(host)
        if there is None:
            there = TokenBucket(limits.OLD_KEY_DIALS_PER_ADDRESS, limits.OLD_KEY_DIALS_PER_ADDRESS)
            self._old_keys_there[host] = there
            if len(self._old_keys_there) > limits.OLD_KEYS_MAX:
                self._old_keys_there.popitem(last=False)
        self._old_keys_there.move_to_end(host)
        return there.take(now) and self._old_keys.take(now)
