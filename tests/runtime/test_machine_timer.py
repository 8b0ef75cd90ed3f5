"""The timer of a machine: called when it is due, never early, moved when the machine changes its mind."""

from __future__ import annotations

import asyncio

from rmpa.runtime.loop import MachineTimer


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


async def test_never_tells_a_time_before_the_one_asked_for() -> None:
    machine = Machine(50.0)
    timer = MachineTimer(machine.next_timer, machine.handle_timer, now=lambda: 50.0 - 1e-9)
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
