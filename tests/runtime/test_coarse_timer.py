from __future__ import annotations

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.runtime.loop import call_at_tick, next_tick, sleep_to_tick


@given(st.floats(0, 1e6), st.sampled_from([0.5, 1.0, 5.0, 10.0]), st.floats(0, 60))
def test_a_tick_is_near_a_period_away_and_on_the_grid(now: float, period: float, origin: float) -> None:
    tick = next_tick(period, now, origin)
    assert period * 0.499 <= tick - now <= period * 1.501
    steps = (tick - origin) / period
    assert steps == pytest.approx(round(steps), abs=1e-6)


@given(st.floats(0, 1e6), st.floats(0, 60))
def test_work_of_longer_periods_falls_on_ticks_of_shorter_ones(now: float, origin: float) -> None:
    tick = next_tick(5.0, now, origin)
    assert next_tick(1.0, tick - 1.0, origin) == pytest.approx(tick, abs=1e-6)


def test_repeated_calls_keep_the_period() -> None:
    now, ticks = 17.3, []
    for _ in range(100):
        now = next_tick(5.0, now, origin=2.0)
        ticks.append(now)
        now += 0.01  # the loop is late
    assert ticks == [pytest.approx(17.0 + 5 * n) for n in range(1, 101)]


async def test_what_is_due_together_wakes_the_loop_once(monkeypatch: pytest.MonkeyPatch) -> None:
    loop = asyncio.get_running_loop()
    called: list[float] = []
    done = asyncio.Event()

    def note() -> None:
        called.append(loop.time())
        if len(called) == 3:
            done.set()

    handles = [call_at_tick(0.05, note) for _ in range(3)]
    assert len({handle.when() for handle in handles}) == 1
    await asyncio.wait_for(done.wait(), 10.0)
    await asyncio.wait_for(sleep_to_tick(0.05), 10.0)


async def test_a_sleep_that_is_cancelled_leaves_no_timer() -> None:
    task = asyncio.ensure_future(sleep_to_tick(60.0))
    await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert task.cancelled()
