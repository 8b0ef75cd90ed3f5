"""Runners of tasks: a coroutine function runs in the event loop, a plain function in a thread of its own."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections import deque
from typing import TYPE_CHECKING

from rmpa.resource import limits
from rmpa.resource.run.run_gate import ENTER_SLICE
from rmpa.resource.run.schedule import Schedule, TaskFigures, restart_delay, stuck_after
from rmpa.runtime.loop import TimerFd

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.resource.declare.behaviour import Task
    from rmpa.resource.run.run_gate import RunGate
    from rmpa.ros.node.endpoints import Received

_log = logging.getLogger(__name__)


class TaskProblem:
    """A problem of a task, for the diagnostics and the log."""

    def __init__(self, task: Task, kind: str, text: str) -> None:
        self.task = task
        self.kind = kind
        """``failed``, ``stuck``, ``stopped`` or ``too slow``."""
        self.text = text

    def __str__(self) -> str:
        """The problem as a sentence."""
        return f"task {self.task.name} {self.kind}: {self.text}"


class TaskRunner:
    """Runs one task until it is stopped.

    Args:
        task: The declared task.
        gate: Entered before each run and left after it.
        on_failed: Called in the event loop with the error text of a run that raised.
    """

    def __init__(self, task: Task, gate: RunGate, on_failed: Callable[[str], None]) -> None:
        rate = task.rate_parameter.value if task.rate_parameter is not None else task.rate
        period = 1 / rate if rate else None
        self.task = task
        self.waiting = False
        """Whether the last run failed; the task waits for its back-off."""
        self.lost = 0
        """Number of consecutive runs that were stuck."""
        self.problem: TaskProblem | None = None
        """The problem of the last run; ``None`` after a run that succeeded."""
        self.over = ""
        """Why the task has ended because of a failure; empty: it has not."""
        self.stopped = False
        self.stuck_after = stuck_after(period, task.stuck_after)
        """Seconds after which a run counts as stuck."""
        self.figures = TaskFigures(period)
        self.period = period
        """The period in seconds; ``None`` if the task runs on messages."""
        self._gate = gate
        self._on_failed = on_failed
        self._messages: deque[Received] = deque()

    @property
    def state(self) -> str:
        """``running``, ``waiting`` (it failed), ``stuck``, or ``stopped`` and why."""
        if self.over:
            return f"stopped: {self.over}"
        if self.waiting:
            return "waiting"
        return "stuck" if self.lost else "running"

    def _succeeded(self) -> None:
        """Record a run that has ended without an error."""
        self.figures.ended(time.monotonic())
        self.waiting, self.lost, self.problem = False, 0, None

    def start(self) -> None:
        """Start the runs; must be called in the event loop."""
        raise NotImplementedError

    def stop(self, *, stuck: bool = False) -> None:
        """End the runs; ``stuck``: the present run hangs, so nothing waits for it."""
        raise NotImplementedError

    async def ended(self) -> None:
        """Wait until the last run has ended, at most ``limits.TASK_END_TIMEOUT`` seconds."""
        raise NotImplementedError

    def wake(self) -> None:
        """Wake the run loop: a message has arrived, or the period has changed."""
        raise NotImplementedError

    def retime(self, rate: float) -> None:
        """Change the rate, in Hz: the next run is due one new period after the last one."""
        self.period = 1 / rate
        self.stuck_after = stuck_after(self.period, self.task.stuck_after)
        self.figures.period = self.period
        self.wake()

    def enqueue(self, message: Received) -> None:
        """Queue a message for a run; a full queue (``limits.TASK_QUEUE_MESSAGES``) drops its oldest."""
        if len(self._messages) >= limits.TASK_QUEUE_MESSAGES:
            self._messages.popleft()
            self.figures.dropped += 1
        self._messages.append(message)
        self.wake()

    def _next(self, schedule: Schedule, last: float) -> tuple[Schedule, float]:
        """Advance to the next due time, in monotonic seconds.

        A changed period begins a new schedule: its first due time is one period after ``last``, the last one.
        """
        if self.period is not None and schedule.period != self.period:
            schedule = Schedule(self.period, max(last + self.period, time.monotonic()))
        missed = schedule.missed
        due = schedule.next_due(time.monotonic())
        self.figures.missed += schedule.missed - missed
        return schedule, due

    def _call(self, message: Received | None) -> Awaitable[None] | None:
        return self.task.function() if message is None else self.task.function(message.message)

    def _error(self, error: BaseException) -> str:
        text = f"{type(error).__name__}: {error}"
        if self.problem is None or self.problem.text != text:  # a repeated error is logged once
            _log.warning("! task %s failed:", self.task.name, exc_info=error)
        return text


class AsyncTaskRunner(TaskRunner):
    """Runs a coroutine function in the event loop."""

    def start(self) -> None:
        """Start the runs in a task of the event loop."""
        self._wake = asyncio.Event()
        self._task = asyncio.get_running_loop().create_task(self._run(), name=f"task {self.task.name}")

    def stop(self, *, stuck: bool = False) -> None:
        """Cancel the present run, if any, and end; ``stuck``: the run is no longer counted as inside the gate."""
        self.stopped = True
        if stuck:
            self._gate.leave(self)
        self._task.cancel()

    async def ended(self) -> None:
        """Wait until the last run has ended, at most ``limits.TASK_END_TIMEOUT`` seconds."""
        await asyncio.wait([self._task], timeout=limits.TASK_END_TIMEOUT)

    def wake(self) -> None:
        """Wake the run loop."""
        self._wake.set()

    async def _run(self) -> None:
        if self.lost:
            await asyncio.sleep(restart_delay(self.lost))
        if self.period is None:
            await self._on_messages()
            return
        with TimerFd(blocking=False) as timer:
            loop = asyncio.get_running_loop()
            loop.add_reader(timer.fileno(), self._wake.set)
            try:
                await self._periodically(self.period, timer)
            finally:
                loop.remove_reader(timer.fileno())

    async def _periodically(self, period: float, timer: TimerFd) -> None:
        schedule, last = Schedule(period, time.monotonic()), -math.inf
        while True:
            schedule, due = self._next(schedule, last)
            timer.set(due)
            while not (over := timer.wait()) and schedule.period == self.period:
                self._wake.clear()
                await self._wake.wait()
            if not over:
                continue  # the period has changed meanwhile
            last = due
            if not await self._once(None):
                schedule = Schedule(schedule.period, time.monotonic())

    async def _on_messages(self) -> None:
        while True:
            while self._messages:
                await self._once(self._messages.popleft())
            self._wake.clear()
            await self._wake.wait()

    async def _once(self, message: Received | None) -> bool:
        """Run once; returns false after a failure and its back-off."""
        await self._gate.enter_async(self)
        self.figures.running_since = time.monotonic()
        try:
            try:
                outcome = self._call(message)
                if outcome is not None:
                    await outcome
            finally:
                self._gate.leave(self)
        except (Exception, SystemExit, asyncio.CancelledError) as error:
            own = asyncio.current_task()
            if isinstance(error, asyncio.CancelledError) and own is not None and own.cancelling():
                raise  # this task itself is cancelled, not a task that the run awaits
            text = await asyncio.to_thread(self._error, error)  # the traceback reads source files
        else:
            self._succeeded()
            return True
        self.figures.ended(time.monotonic(), failed=True)
        self.waiting = True
        self._on_failed(text)
        await asyncio.sleep(restart_delay(self.figures.in_a_row))
        return False


class ThreadTaskRunner(TaskRunner):
    """Runs a plain function in a thread of its own."""

    def start(self) -> None:
        """Start the runs in a new thread."""
        self._end = threading.Event()
        self._ready = threading.Semaphore(0)
        self._loop = asyncio.get_running_loop()
        self._done = asyncio.Event()
        name = f"task {self.task.name}"
        # A daemon thread: a stuck one must not keep the process from exiting.
        threading.Thread(target=self._thread, name=name, daemon=True).start()

    def stop(self, *, stuck: bool = False) -> None:
        """End after the present run; ``stuck``: the run hangs, so its thread is left behind."""
        self.stopped = True
        self._end.set()
        self._ready.release()
        if stuck:
            self._gate.leave(self)
            self._done.set()

    async def ended(self) -> None:
        """Wait until the thread has ended, at most ``limits.TASK_END_TIMEOUT`` seconds."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limits.TASK_END_TIMEOUT):
                await self._done.wait()
                return
        _log.warning("! task %s does not end; it is left behind", self.task.name)

    def wake(self) -> None:
        """Wake the run loop."""
        self._ready.release()

    def _thread(self) -> None:
        try:
            if self.lost:
                self._end.wait(restart_delay(self.lost))
            if self.period is None:
                self._on_messages()
            else:
                with TimerFd(blocking=True) as timer:
                    self._periodically(self.period, timer)
        finally:
            with contextlib.suppress(RuntimeError):  # the event loop has ended already
                self._loop.call_soon_threadsafe(self._done.set)

    def _periodically(self, period: float, timer: TimerFd) -> None:
        schedule, last = Schedule(period, time.monotonic()), -math.inf
        while not self._end.is_set():
            schedule, due = self._next(schedule, last)
            while due - time.monotonic() > ENTER_SLICE and schedule.period == self.period:
                if self._end.wait(min(due - time.monotonic() - ENTER_SLICE / 2, ENTER_SLICE)):
                    return
            if schedule.period != self.period:
                continue
            last = due
            timer.set(due)
            timer.wait()
            if not self._once(None):
                schedule = Schedule(schedule.period, time.monotonic())

    def _on_messages(self) -> None:
        while True:
            self._ready.acquire()
            if self._end.is_set():
                return
            with contextlib.suppress(IndexError):  # woken without a message, or the message was dropped
                self._once(self._messages.popleft())

    def _once(self, message: Received | None) -> bool:
        """Run once; returns false after a failure and its back-off, or if the task has to end."""
        if not self._gate.enter(self, self._end.is_set):
            return False
        self.figures.running_since = time.monotonic()
        try:
            try:
                self._call(message)
            finally:
                self._gate.leave(self)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - the top of the user's code
            text = self._error(error)
        else:
            self._succeeded()
            return True
        self.figures.ended(time.monotonic(), failed=True)
        if self._end.is_set():
            return False
        self.waiting = True
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._on_failed, text)
        self._end.wait(restart_delay(self.figures.in_a_row))
        return False
