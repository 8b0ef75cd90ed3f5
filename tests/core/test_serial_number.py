from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.identity import SERIAL_HALF, SERIAL_MASK, is_earlier, is_later, serial_add, serial_distance
from rmpa.core.limits import INT32_MAX, INT32_MIN, UINT32_MAX

NUMBERS = st.integers(0, UINT32_MAX)
STEPS = st.integers(1, SERIAL_HALF - 1)


def test_bounds_are_those_of_32_bits() -> None:
    assert (INT32_MIN, INT32_MAX, UINT32_MAX) == (-2147483648, 2147483647, 4294967295)
    assert (SERIAL_MASK, SERIAL_HALF) == (4294967295, 2147483648)


@pytest.mark.parametrize(
    ("number", "count", "expected"),
    [(0, 1, 1), (UINT32_MAX, 1, 0), (UINT32_MAX, 3, 2), (0, -1, UINT32_MAX), (5, 0, 5), (7, UINT32_MAX + 1, 7)],
)
def test_addition_wraps(number: int, count: int, expected: int) -> None:
    assert serial_add(number, count) == expected


@pytest.mark.parametrize(
    ("start", "end", "distance"),
    [(3, 3, 0), (3, 10, 7), (UINT32_MAX, 0, 1), (UINT32_MAX - 1, 4, 6), (0, UINT32_MAX, UINT32_MAX)],
)
def test_distance_is_counted_forwards_across_the_wrap(start: int, end: int, distance: int) -> None:
    assert serial_distance(start, end) == distance


@given(NUMBERS)
def test_number_is_neither_later_nor_earlier_than_itself(number: int) -> None:
    assert not is_later(number, number)
    assert not is_earlier(number, number)


@given(NUMBERS, STEPS)
def test_order_holds_across_the_wrap(number: int, step: int) -> None:
    later = serial_add(number, step)
    assert is_later(later, number)
    assert is_earlier(number, later)
    assert not is_later(number, later)
    assert not is_earlier(later, number)
    assert serial_distance(number, later) == step


@given(NUMBERS)
def test_half_the_range_ahead_counts_as_earlier(number: int) -> None:
    """RFC 1982 leaves the order of such two open; both sides must drop rather than accept."""
    opposite = serial_add(number, SERIAL_HALF)
    assert not is_later(opposite, number)
    assert is_earlier(opposite, number)
