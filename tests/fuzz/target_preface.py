"""Fuzz target: the preface of a secured connection."""

from __future__ import annotations

from rmpa.trust.keyring import GroupKey, KeyPurpose, KeyRing
from rmpa.trust.preface import PREFACE_BYTES, Preface, PrefaceError, PrefaceGuard, Purpose

_KEY = GroupKey(3, bytes(range(32)))
_SIGNED = Preface(Purpose.LINK, 3, 1_790_000_000_000, bytes(16)).serialize(_KEY.key_for(KeyPurpose.PREFACE))
_JOIN = Preface(Purpose.JOIN, 0, 0, bytes(16), b"token-id").serialize(bytes(32))

SEEDS: list[bytes] = [b"", b"RMPS", _SIGNED, _SIGNED[:-1], _SIGNED + b"\x16\x03\x01", _JOIN, bytes(56)]


def fuzz(data: bytes) -> None:
    """Whatever comes in: nothing is admitted but what a member signed, or a holder of the token."""
    guard = PrefaceGuard(KeyRing([_KEY], 0.0), {b"token-id": bytes(32)}.get)
    try:
        preface, _ = guard.admit(data, 1.0, 1_790_000_000.0)
    except PrefaceError as error:
        str(error)
        return
    if data[:PREFACE_BYTES] not in (_SIGNED, _JOIN):
        raise AssertionError(f"{data!r} is admitted as {preface}")
