from __future__ import annotations

import asyncio
import time

import pytest

from rmpa.runtime.loop import TimerFd


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
