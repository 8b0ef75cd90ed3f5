"""Seeded mutations of seed inputs: what a broken or hostile sender makes of good bytes."""

from __future__ import annotations

import random
from collections.abc import Sequence

_LENGTHS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
_LONGEST = 64 * 1024


def mutate(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """One input: a seed after one to four of the changes below."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.randint(1, 4)):
        data = rng.choice(_CHANGES)(rng, data, seeds)
    return bytes(data[:_LONGEST])


def _flip(rng: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> bytearray:
    for _ in range(rng.randint(1, 8)):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return data


def _truncate(rng: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> bytearray:
    return data[: rng.randint(0, len(data))]


def _splice(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> bytearray:
    other = rng.choice(seeds)
    return data[: rng.randint(0, len(data))] + other[rng.randint(0, len(other)) :]


def _insert(rng: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> bytearray:
    at = rng.randint(0, len(data))
    return data[:at] + rng.randbytes(rng.randint(1, 16)) + data[at:]


def _delete(rng: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> bytearray:
    at = rng.randint(0, len(data))
    return data[:at] + data[at + rng.randint(1, 16) :]


def _repeat(rng: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> bytearray:
    begin = rng.randint(0, len(data))
    piece = data[begin : begin + rng.randint(1, 32)]
    return data[:begin] + piece * rng.choice((2, 3, 50, 400)) + data[begin:]


def _length(rng: random.Random, data: bytearray, _seeds: Sequence[bytes]) -> bytearray:
    """A length field at a random place, in either byte order, that lies."""
    size = rng.choice((1, 2, 4))
    if len(data) < size:
        return data
    at = rng.randint(0, len(data) - size)
    value = rng.choice((*_LENGTHS, len(data), rng.randrange(1 << 32))) & (1 << 8 * size) - 1
    data[at : at + size] = value.to_bytes(size, rng.choice(("big", "little")))
    return data


_CHANGES = (_flip, _truncate, _splice, _insert, _delete, _repeat, _length)
