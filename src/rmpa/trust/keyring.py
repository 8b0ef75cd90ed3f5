"""Group keys: the secrets that all members of a mesh share, and which of them signs and verifies at a time.

A new key verifies at once and signs ``limits.KEY_SPREAD`` later, when it has reached every linked module. The key
before verifies for ``limits.KEY_OVERLAP`` more; older ones are still known, so that a module that was away is
recognised. The key that a revocation makes signs at once, and all before it only recognise from then on: the module
that was revoked has them.
"""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.core.limits import UINT32_MAX
from rmpa.trust import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

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
