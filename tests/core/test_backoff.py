"""Back-off: doubled, capped, jittered."""

from __future__ import annotations

import random

from rmpa.core.counters import Backoff


def test_doubles_to_its_cap_and_starts_again() -> None:
    backoff = Backoff(0.1, 1.0, lambda: 1.0)
    assert [round(backoff.delay(), 6) for _ in range(6)] == [0.1, 0.2, 0.4, 0.8, 1.0, 1.0]
    backoff.reset()
    assert round(backoff.delay(), 6) == 0.1


def test_spread_between_half_and_all() -> None:
    backoff = Backoff(1.0, 1.0, random.Random(1).random)
    delays = [backoff.delay() for _ in range(1000)]
    assert 0.5 <= min(delays) < 0.51
    assert 0.99 < max(delays) <= 1.0
