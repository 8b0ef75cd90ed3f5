"""Fuzz target: the trailer of UDP packets."""

from __future__ import annotations

from rmpa.trust.packets import GroupKey, KeyRing, PacketTrust, Verdict

_RING = KeyRing([GroupKey(3, bytes(range(32)))], 0.0)
_SIGNED = PacketTrust(_RING, lambda: 1_790_000_000.0).sign(bytes(range(60)), 1.0)

SEEDS: list[bytes] = [b"", bytes(31), bytes(64), _SIGNED, _SIGNED[:-1], _SIGNED + b"x", _SIGNED[32:]]


def fuzz(data: bytes) -> None:
    """Whatever comes in: nothing is accepted but the one packet that a member signed."""
    verdict = PacketTrust(_RING, lambda: 1_790_000_001.0).verify(data, (16, 32), 1.0).verdict
    if (verdict is Verdict.ACCEPTED) is not (data == _SIGNED):
        raise AssertionError(f"{data!r} is {verdict}")
