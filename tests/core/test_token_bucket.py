"""So many at once, so many a second."""

from __future__ import annotations

import pytest

from rmpa.core.counters import TokenBucket


def test_a_burst_then_the_rate_and_after_a_rest_a_burst_again() -> None:
    bucket = TokenBucket(rate=10, burst=3)
    assert [bucket.take(5.0) for _ in range(4)] == [True, True, True, False]
    assert bucket.next(5.0) == pytest.approx(5.1)
    taken = sum(bucket.take(5.0 + step / 1000) for step in range(1, 2001))
    assert taken == 20
    assert [bucket.take(60.0) for _ in range(4)] == [True, True, True, False]


def test_returned_token_can_be_taken_again_up_to_the_burst() -> None:
    bucket = TokenBucket(rate=1, burst=2)
    assert bucket.take(0.0)
    assert bucket.take(0.0)
    bucket.put_back()
    assert [bucket.take(0.0) for _ in range(2)] == [True, False]
    for _ in range(5):
        bucket.put_back()
    assert [bucket.take(0.0) for _ in range(3)] == [True, True, False]


def test_it_is_let_through_at_the_moment_that_was_named() -> None:
    bucket = TokenBucket(rate=7, burst=1)
    now = 1234.567
    for _ in range(1000):
        assert bucket.take(now)
        assert not bucket.take(now)
        now = bucket.next(now)


def test_a_clock_that_stands_still_gives_nothing() -> None:
    bucket = TokenBucket(rate=10, burst=1)
    assert bucket.take(3.0)
    assert not bucket.take(2.0)
    assert bucket.next(3.0) == pytest.approx(3.1)
