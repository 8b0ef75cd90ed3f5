"""Timers: of a machine, coarse ones, and of the kernel."""

from __future__ import annotations

import asyncio
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.runtime.loop import MachineTimer, TimerFd, call_at_tick, next_tick, sleep_to_tick


class Machine:
    """Is due at each of ``times``, one behind the other."""

    def __init__(self, *times: float) -> None:
        self.times = list(times)
        self.calls: list[float] = []
        self.done = asyncio.Event()

    def next_timer(self) -> float | None:
        return self.times[0] if self.times else None

    def handle_timer(self, now: float) -> None:
        self.calls.append(now)
        self.times.pop(0)
        if not self.times:
            self.done.set()


async def test_calls_at_each_time_and_arms_itself_again() -> None:
    now = asyncio.get_running_loop().time()
    machine = Machine(now, now + 0.002, now + 0.004)
    wanted = list(machine.times)
    timer = MachineTimer(machine.next_timer, machine.handle_timer)
    timer.arm()
    await asyncio.wait_for(machine.done.wait(), 10)
    assert all(call >= due for call, due in zip(machine.calls, wanted, strict=True))
    timer.close()


async def test_never_tells_a_time_before_the_one_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(asyncio.get_running_loop(), "time", lambda: 50.0 - 5e-10)
    machine = Machine(50.0)
    timer = MachineTimer(machine.next_timer, machine.handle_timer)
    timer.arm()
    await asyncio.wait_for(machine.done.wait(), 10)
    assert machine.calls == [50.0]


async def test_a_time_that_moves_forward_is_kept() -> None:
    now = asyncio.get_running_loop().time()
    machine = Machine(now + 3600)
    timer = MachineTimer(machine.next_timer, machine.handle_timer)
    timer.arm()
    machine.times[0] = now
    timer.arm()
    await asyncio.wait_for(machine.done.wait(), 10)
    assert len(machine.calls) == 1


async def test_a_time_that_is_withdrawn_or_a_closed_timer_calls_nothing() -> None:
    now = asyncio.get_running_loop().time()
    withdrawn, closed = Machine(now), Machine(now)
    timers = [MachineTimer(machine.next_timer, machine.handle_timer) for machine in (withdrawn, closed)]
    for timer in timers:
        timer.arm()
    withdrawn.times.clear()
    timers[0].arm()
    timers[1].close()
    timers[1].arm()
    for _ in range(5):
        await asyncio.sleep(0)
    assert withdrawn.calls == closed.calls == []
    timers[0].close()


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


def test_a_blocking_timer_sleeps_until_it_is_due() -> None:
    with TimerFd(blocking=True) as timer:
        due = time.monotonic() + 0.02
        timer.set(due)
        assert timer.wait()
        assert time.monotonic() >= due


def test_a_time_that_is_past_is_due_now() -> None:
    with TimerFd(blocking=True) as timer:
        timer.set(-5.0)
        assert timer.wait()


async def test_a_loop_is_woken_when_it_is_due() -> None:
    loop = asyncio.get_running_loop()
    woken: asyncio.Future[float] = loop.create_future()
    with TimerFd(blocking=False) as timer:
        assert not timer.wait()
        due = time.monotonic() + 0.02
        timer.set(due)

        def due_now() -> None:
            if not woken.done():
                woken.set_result(time.monotonic())

        loop.add_reader(timer.fileno(), due_now)
        async with asyncio.timeout(20):
            assert await woken >= due
        assert timer.wait()
        assert not timer.wait()
        loop.remove_reader(timer.fileno())


def test_a_closed_timer_says_so() -> None:
    timer = TimerFd(blocking=True)
    timer.close()
    timer.close()
    assert timer.fileno() == -1
    with pytest.raises(OSError, match="Bad file descriptor"):
        timer.set(1.0)
