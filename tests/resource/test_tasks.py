from __future__ import annotations

import asyncio
import re
import threading
import time
from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace
from typing import Any

import pytest

from rmpa.resource.resource import Resource
from rmpa.resource.tasks import TaskReport, Tasks, restart_delay, stuck_after
from tests.waiting import until


@pytest.mark.parametrize(
    ("report", "period", "text"),
    [
        (TaskReport(runs=10, overruns=1), 0.1, ""),  # once is the machine's business
        (
            TaskReport(runs=10, overruns=2, missed=3),
            0.1,
            "2 of 10 runs took longer than its period of 0.1 s, 3 times left out",
        ),
        (TaskReport(runs=1, overruns=1), 2.0, "1 of 1 runs took longer than its period of 2 s"),
        (TaskReport(runs=5, missed=5), 0.1, ""),  # it was held, it did not overrun
        (TaskReport(runs=4, dropped=7), None, "7 messages of its input gave way to newer ones, 4 were taken"),
        (TaskReport(runs=4), None, ""),
    ],
)
def test_a_task_is_too_slow_if_it_overruns_often(report: TaskReport, period: float | None, text: str) -> None:
    assert report.too_slow(period) == text


def test_who_fails_again_and_again_waits_longer() -> None:
    assert [restart_delay(n) for n in (0, 1, 2, 3, 99)] == [0.1, 0.1, 0.2, 0.4, 5.0]


def test_when_a_run_is_stuck() -> None:
    assert stuck_after(0.1, None) == 5.0
    assert stuck_after(2.0, None) == 20.0
    assert stuck_after(None, None) == 5.0
    assert stuck_after(2.0, 0.5) == 0.5


# --- with threads and the event loop


class Bench(Tasks):
    """A resource whose tasks run, without a node."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.resource = Resource("r", role="sensing")
        self.reported: list[str] = []
        self.deactivated: list[str] = []
        self.change = asyncio.Event()
        call = asyncio.get_running_loop().call_soon_threadsafe
        runtime: Any = SimpleNamespace(resource=self.resource, node=SimpleNamespace(name="/r"), call_in_loop=call)
        super().__init__(runtime, self.deactivated.append)

    def begin(self, function: Callable[..., None], **options: Any) -> None:
        """Run a function as the only task, in a thread of its own or as a coroutine."""

        async def coroutine(*args: object) -> None:
            await asyncio.to_thread(function, *args)

        self.resource.task(name="t", **options)(function if self.kind == "thread" else coroutine)
        self.activate()

    def report(self, problem: str) -> str:
        self.reported.append(problem)
        self.change.set()
        return super().report(problem)

    @property
    def kinds(self) -> list[str]:
        return [match[1] for text in self.reported if (match := re.match(r"task \w+ ([\w ]+):", text))]

    async def problem(self, kind: str) -> str:
        async with asyncio.timeout(30):
            while kind not in self.kinds:
                self.change.clear()
                await self.change.wait()
        return self.reported[self.kinds.index(kind)]


@pytest.fixture(params=["thread", "coroutine"])
async def bench(request: pytest.FixtureRequest) -> AsyncIterator[Bench]:
    one = Bench(request.param)
    yield one
    await one.deactivate()


class Counter:
    """Counts runs, from any thread."""

    def __init__(self, enough: int) -> None:
        self.times: list[float] = []
        self.enough = enough
        self.done = threading.Event()

    def __call__(self) -> None:
        self.times.append(time.monotonic())
        if len(self.times) >= self.enough:
            self.done.set()

    async def wait(self) -> None:
        assert await asyncio.to_thread(self.done.wait, 30)


async def test_a_periodic_task_keeps_to_its_schedule(bench: Bench) -> None:
    count = Counter(30)

    bench.begin(count, rate=100)
    await count.wait()
    report = bench._runners["t"].report
    assert report.runs + report.missed >= 29
    # No lateness adds up: the 29 periods took no less than they should, however late each was.
    assert count.times[29] - count.times[0] > 0.2
    await bench.deactivate()
    ran = len(count.times)
    await asyncio.sleep(0.05)
    assert len(count.times) == ran
    assert bench.reported == []


async def test_task_follows_its_rate_parameter(bench: Bench) -> None:
    rate = bench.resource.parameter("hz", 0.01, low=0.01, high=500, unit="Hz")
    count = Counter(21)

    bench.begin(count, rate=rate)
    await until(lambda: count.times)
    # It would sleep for a hundred seconds.
    rate.value = 50
    bench.parameter_changed(rate)
    await count.wait()
    assert count.times[20] - count.times[1] > 0.3, "19 periods of 20 ms, whatever the lateness of the two"
    rate.value = 0.01
    bench.parameter_changed(rate)
    await asyncio.sleep(0.15)
    ran = len(count.times)
    await asyncio.sleep(0.1)
    assert len(count.times) == ran
    assert bench.reported == []


async def test_failing_task_is_restarted_and_each_failure_has_one_traceback(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    count = Counter(4)

    def fail_thrice() -> None:
        count()
        if len(count.times) <= 3:
            raise ValueError("no echo" if len(count.times) <= 2 else "no battery")

    bench.begin(fail_thrice, rate=200)
    assert (await bench.problem("failed")).endswith("failed: ValueError: no echo")
    await count.wait()
    assert bench.kinds == ["failed"] * 3
    assert count.times[2] - count.times[1] > 0.15, "the second pause is longer"
    traced = [record.exc_info[1] for record in caplog.records if record.exc_info]
    assert [str(error) for error in traced] == ["no echo", "no battery"]


async def test_a_task_can_end_at_its_first_failure(bench: Bench) -> None:
    def plain() -> None:
        raise ValueError("no echo")

    bench.begin(plain, rate=200, on_failure="deactivate")
    await bench.problem("stopped")
    assert bench.problems() == ([], ["task t stopped: ValueError: no echo"])
    assert bench.deactivated == ["task t: ValueError: no echo"]


async def test_stuck_task_is_replaced(bench: Bench) -> None:
    count = Counter(3)
    free = threading.Event()

    def plain() -> None:
        count()
        if len(count.times) == 1:
            free.wait(60)

    bench.begin(plain, rate=100, stuck_after=0.3)
    assert "a run has not ended for" in await bench.problem("stuck")
    (trouble,) = bench.problems()[1]
    assert "stuck: a run has not ended for" in trouble
    await count.wait()
    begin = time.monotonic()
    for _ in range(4):  # each would wait a second for the run that was given up
        await bench.pause()
        bench.resume()
    assert time.monotonic() - begin < 3.0, "a profile is held up"
    free.set()
    await until(lambda: not bench.problems()[1])


async def test_overruns_are_reported_once(bench: Bench) -> None:
    slow = threading.Event()
    slow.set()
    count = Counter(4)

    def plain() -> None:
        if slow.is_set():
            time.sleep(0.03)
        count()

    bench.begin(plain, rate=100)
    await count.wait()
    bench.window_ended({})
    assert bench.reported == [], "one window may be the machine's business"
    for _ in range(2):
        count = Counter(4)
        await count.wait()
        bench.window_ended({})
    assert bench.kinds == ["too slow"]
    (trouble,) = bench.problems()[1]
    assert "task t too slow:" in trouble
    assert "runs took longer than its period of 0.01 s" in trouble
    slow.clear()
    async with asyncio.timeout(60):
        while bench.problems()[1]:
            await asyncio.sleep(0.1)
            bench.window_ended({})


async def test_a_task_on_an_input_gets_the_newest_messages(bench: Bench) -> None:
    item = bench.resource.input("orders", "std_msgs/String")
    got: list[str] = []
    gate, first, last = threading.Event(), threading.Event(), threading.Event()

    def plain(message: str) -> None:
        got.append(message)
        if message == "m0":
            first.set()
            gate.wait(30)
        if message == "m14":
            last.set()

    bench.begin(plain, on=item)

    def give(number: int) -> None:
        message: Any = SimpleNamespace(message=f"m{number}", stamp_ns=time.time_ns())
        bench.heard(item, b"", 0, message)

    give(0)
    assert await asyncio.to_thread(first.wait, 30)
    for number in range(1, 15):
        give(number)
    gate.set()
    assert await asyncio.to_thread(last.wait, 30)
    # Ten wait; the oldest four gave way.
    assert got == ["m0", *(f"m{n}" for n in range(5, 15))]
    assert bench._runners["t"].report.dropped == 4


async def test_no_task_runs_while_paused(bench: Bench) -> None:
    count = Counter(20)
    within: list[int] = []

    def plain() -> None:
        within.append(1)
        time.sleep(0.003)
        count()
        within.pop()

    bench.begin(plain, rate=200)
    async with asyncio.timeout(30):
        while len(count.times) < 20:
            await bench.pause()
            assert within == []
            ran = len(count.times)
            await asyncio.sleep(0.01)
            assert len(count.times) == ran
            bench.resume()
            await asyncio.sleep(0.01)


async def test_system_exit_in_a_task_is_a_failure(bench: Bench) -> None:
    count = Counter(2)

    def plain() -> None:
        count()
        if bench.kind == "coroutine":
            raise asyncio.CancelledError  # what it waited for was cancelled, not it
        raise SystemExit(3)

    bench.begin(plain, rate=100)
    assert ("SystemExit" if bench.kind == "thread" else "CancelledError") in await bench.problem("failed")
    await count.wait()
