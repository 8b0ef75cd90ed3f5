"""Serial numbers of 32 bits, which wrap around and are compared as in RFC 1982.

Of two numbers the later one is less than 2³¹ ahead of the other. Code that runs once for each message writes the
expressions out with ``SERIAL_MASK`` and ``SERIAL_HALF``, because a call takes longer than the arithmetic.
"""

from __future__ import annotations

from typing import Final

from rmpa.core.sizes import UINT32_MAX

SERIAL_MASK: Final = UINT32_MAX
"""``number & SERIAL_MASK`` wraps a number."""
SERIAL_HALF: Final = 1 << 31
"""A number that is this far or farther ahead of another number counts as the earlier one of the two."""


def serial_add(number: int, count: int) -> int:
    """The number ``count`` places after ``number``; ``count`` may be negative."""
    return number + count & SERIAL_MASK


def serial_distance(start: int, end: int) -> int:
    """How many places ``end`` is ahead of ``start``: 0 to 2³² - 1; from 2³¹ on it is the earlier one of the two."""
    return end - start & SERIAL_MASK


def is_later(number: int, than: int) -> bool:
    """Whether ``number`` comes after ``than``; false for equal numbers."""
    return 0 < number - than & SERIAL_MASK < SERIAL_HALF


def is_earlier(number: int, than: int) -> bool:
    """Whether ``number`` comes before ``than``; false for equal numbers, true for two that are exactly 2³¹ apart."""
    return number - than & SERIAL_MASK >= SERIAL_HALF
