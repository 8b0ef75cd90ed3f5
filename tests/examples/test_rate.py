from __future__ import annotations

import pytest

from rate import Rate


class Time:
    """A clock that moves only by sleeping and by the body's work."""

    def __init__(self) -> None:
        self.now = 100.0
        self.slept: list[float] = []

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds

    def rate(self, hz: float) -> Rate:
        return Rate(hz, now=lambda: self.now, sleep=self.sleep)


async def test_ticks_are_due_at_absolute_times() -> None:
    time = Time()
    seen = []
    async for due in time.rate(10):
        seen.append(due)
        time.now += 0.03 * len(seen) % 0.09
        if len(seen) == 50:
            break
    assert seen == pytest.approx([100.0 + tick / 10 for tick in range(50)])


async def test_the_first_tick_is_at_once() -> None:
    time = Time()
    async for _ in time.rate(1):
        break
    assert time.slept == [0.0]


async def test_after_a_late_tick_the_next_is_on_time() -> None:
    time = Time()
    ticks = time.rate(10)
    await anext(ticks)
    time.now += 0.15
    assert await anext(ticks) == pytest.approx(100.1)
    assert await anext(ticks) == pytest.approx(100.2)
    assert ticks.missed == 0
    assert time.now == pytest.approx(100.2)


async def test_missed_periods_are_left_out() -> None:
    time = Time()
    ticks = time.rate(10)
    await anext(ticks)
    time.now += 1.05
    assert await anext(ticks) == pytest.approx(101.0)
    assert await anext(ticks) == pytest.approx(101.1)
    assert ticks.missed == 9


@pytest.mark.parametrize("hz", [0, -1, float("nan")])
def test_a_rate_is_above_zero(hz: float) -> None:
    with pytest.raises(ValueError, match="above 0 Hz"):
        Rate(hz)
