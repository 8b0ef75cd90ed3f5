"""Tasks of a resource: periodic ones on an absolute schedule, others on the messages of an input.

A task that raises is reported, and is restarted after a back-off or ends, as declared. A run that does not return is
reported as stuck and given up: a coroutine is cancelled; a thread cannot be stopped, so it is left behind. Unless the
task ends by its declaration, a new coroutine or thread continues it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.timers import Schedule
from rmpa.resource import limits
from rmpa.resource.declare import DeclaredTopic, OnFailure, Parameter, Task
from rmpa.resource.runtime import Runtime, RuntimePart
from rmpa.runtime.accept import in_thread
from rmpa.runtime.loop import TimerFd
from rmpa.runtime.tasks import keep_task, start_task

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.resource.quality import Value
    from rmpa.ros.node.endpoints import Received

_log = logging.getLogger(__name__)
# Seconds of the back-off after a task's first failure.
RESTART_FIRST: Final = 0.1
# Seconds of the longest back-off.
RESTART_MAX: Final = 5.0
# Number of periods after which a run is stuck, unless declared otherwise.
STUCK_PERIODS: Final = 10
# Lower bound in seconds of the time after which a run is stuck, unless declared otherwise.
STUCK_LEAST: Final = 5.0
# The longest time in seconds that a waiting thread takes to notice that it has to end.
ENTER_SLICE: Final = 0.1
# Seconds between a waiting coroutine's checks of the gate; polling will do, because changes are rare and short.
_POLL: Final = 0.002
# Seconds between checks for stuck runs.
_STUCK_CHECK: Final = 0.25


class RunGate:
    """Lets runs begin while it is open; after closing it, a closer can wait until no run is inside.

    Thereby a profile is applied between two runs, and no message is computed partly under each of two profiles.
    """

    def __init__(self) -> None:
        self._change = threading.Condition()
        self._closers: set[str] = set()
        self._inside: set[object] = set()

    def enter(self, run: object, ended: Callable[[], bool]) -> bool:
        """Wait in a thread until the gate is open; returns false if ``ended`` returns true while it is closed."""
        with self._change:
            while self._closers:
                if ended():
                    return False
                self._change.wait(ENTER_SLICE)
            self._inside.add(run)
            return True

    async def enter_async(self, run: object) -> None:
        """Wait in the event loop until the gate is open."""
        while True:
            with self._change:
                if not self._closers:
                    self._inside.add(run)
                    return
            await asyncio.sleep(_POLL)

    def leave(self, run: object) -> None:
        """Remove a run that has ended, or a stuck one that closers shall not wait for."""
        with self._change:
            self._inside.discard(run)
            self._change.notify_all()

    def close(self, closer: str) -> None:
        """Let no further run begin until ``closer`` opens the gate again."""
        with self._change:
            self._closers.add(closer)

    def wait_empty(self, timeout: float) -> bool:
        """Wait in a thread until no run is inside; false after ``timeout`` seconds."""
        with self._change:
            return self._change.wait_for(lambda: not self._inside, timeout)

    def open(self, closer: str) -> None:
        """Let runs begin again, unless another closer keeps the gate closed."""
        with self._change:
            self._closers.discard(closer)
            self._change.notify_all()


@dataclass(slots=True)
class TaskReport:
    """Statistics of a task over one window; counted by the thread that runs the task, read by the event loop.

    Args:
        runs: Number of runs.
        overruns: Runs that took more than a period.
        missed: Due times that were skipped because of overruns.
        dropped: Messages of the task's input that were dropped because the task was too slow.
    """

    runs: int = 0
    overruns: int = 0
    missed: int = 0
    dropped: int = 0

    def too_slow(self, period: float | None) -> str:
        """The reason why the task was too slow in the window, for people; empty if it was not.

        A task was too slow if more than a tenth of its runs took longer than its period, or if messages of its input
        were dropped. A single slow run does not count, because load of the machine may have caused it.

        Args:
            period: The period in seconds; ``None`` for a task that runs on messages.
        """
        if self.dropped:
            return f"{self.dropped} messages of its input gave way to newer ones, {self.runs} were taken"
        if period is None or self.overruns * 10 <= self.runs:
            return ""
        left_out = f", {self.missed} times left out" if self.missed else ""
        return f"{self.overruns} of {self.runs} runs took longer than its period of {period:.3g} s{left_out}"


def restart_delay(in_a_row: int) -> float:
    """The back-off in seconds after ``in_a_row`` consecutive failures."""
    return min(RESTART_FIRST * 2.0 ** min(max(0, in_a_row - 1), 16), RESTART_MAX)


def stuck_after(period: float | None, declared: float | None) -> float:
    """Seconds after which a run counts as stuck: as declared, or else from the period (``None``: on messages)."""
    return declared if declared is not None else max(STUCK_LEAST, STUCK_PERIODS * (period or 0.0))


class TaskRunner:
    """Base of what runs one task until it is stopped.

    Args:
        tasks: The tasks of the resource, which are told of failures.
        task: The declared task.
        lost: Number of consecutive runs that were stuck before; the first run is delayed by a back-off.
        problem: The problem of the last run, as a text; empty after a run that succeeded.
    """

    def __init__(self, tasks: Tasks, task: Task, lost: int = 0, problem: str = "") -> None:
        self.task = task
        self.lost = lost
        self.problem = problem
        self.stopped = False
        self.report = TaskReport()
        # When the present run began, in monotonic seconds; ``None`` between two runs.
        self.running_since: float | None = None
        # The period in seconds; ``None`` if the task runs on messages.
        self.period: float | None = None
        # Wakes the run loop: a message has arrived, or the period has changed.
        self.wake: Callable[[], None] = lambda: None
        self._tasks = tasks
        # Number of failures since the last run that succeeded.
        self._in_a_row = 0
        self._messages: deque[Received] = deque()
        if rate := task.rate_parameter.value if task.rate_parameter is not None else task.rate:
            self.period = 1 / rate
        # The due times of a periodic task; ``None``: a new schedule begins.
        self._schedule: Schedule | None = None

    def start(self) -> None:
        """Start the runs."""
        self._running = self._begin()

    def stop(self, *, stuck: bool = False) -> None:
        """End the runs; ``stuck``: the present run hangs, so nothing waits for it."""
        self.stopped = True
        if stuck:
            self._tasks.gate.leave(self)
            self._running.cancel()

    async def ended(self) -> None:
        """Wait until the last run has ended, at most ``limits.TASK_END_TIMEOUT`` seconds."""
        _, left = await asyncio.wait([self._running], timeout=limits.TASK_END_TIMEOUT)
        if left:
            _log.warning("! task %s does not end; the program goes on without it [ending-slowly]", self.task.name)

    def _begin(self) -> asyncio.Task[None]:
        raise NotImplementedError

    def retime(self, rate: float) -> None:
        """Change the rate, in Hz: the next run is due one new period after the last one."""
        self.period = 1 / rate
        self.wake()

    def enqueue(self, message: Received) -> None:
        """Queue a message for a run; a full queue (``limits.TASK_QUEUE_MESSAGES``) drops its oldest."""
        if len(self._messages) >= limits.TASK_QUEUE_MESSAGES:
            self._messages.popleft()
            self.report.dropped += 1
        self._messages.append(message)
        self.wake()

    def _next_due(self, last: float) -> float:
        """The next due time, in monotonic seconds; ``last``: when the last run was due.

        After a change of the period it is one period after the last one, after a failure one from now on.
        """
        now, period = time.monotonic(), self.period or 0.0
        if self._schedule is None or self._schedule.period != period:
            self._schedule = Schedule(period, now if self._schedule is None else max(last + period, now))
        due, missed = self._schedule.next_due(now)
        self.report.missed += missed
        return due

    @property
    def _is_retimed(self) -> bool:
        """Whether the period has changed since the last due time was told."""
        return self._schedule is not None and self._schedule.period != self.period

    def _call(self, message: Received | None) -> Awaitable[None] | None:
        self.running_since = time.monotonic()
        return self.task.function() if message is None else self.task.function(message.message)

    def _ended(self, error: BaseException | None) -> float:
        """Record that a run has ended; returns the seconds of the back-off after an error."""
        took, self.running_since = time.monotonic() - (self.running_since or math.inf), None
        self.report.runs += 1
        self.report.overruns += self.period is not None and took > self.period
        if error is None:
            self.lost, self.problem, self._in_a_row = 0, "", 0
            return 0.0
        self._in_a_row += 1
        self._schedule = None
        before, self.problem = self.problem, f"task {self.task.name} failed: {type(error).__name__}: {error}"
        if self.problem != before:  # a repeated error is logged once
            _log.warning("! task %s failed [resource-trouble]", self.task.name, exc_info=error)
        return restart_delay(self._in_a_row)


class AsyncTaskRunner(TaskRunner):
    """Runs a coroutine function in the event loop."""

    def stop(self, *, stuck: bool = False) -> None:
        """Cancel the present run, if any, and end; ``stuck``: the run is no longer counted as inside the gate."""
        super().stop(stuck=stuck)
        self._running.cancel()

    def _begin(self) -> asyncio.Task[None]:
        self._wake = asyncio.Event()
        self.wake = self._wake.set
        return keep_task(self._run, f"task {self.task.name}")

    async def _run(self) -> None:
        if self.lost:
            await asyncio.sleep(restart_delay(self.lost))
        while self.period is None:
            while self._messages:
                await self._once(self._messages.popleft())
            self._wake.clear()
            await self._wake.wait()
        with TimerFd(blocking=False) as timer:
            loop = asyncio.get_running_loop()
            loop.add_reader(timer.fileno(), self._wake.set)
            try:
                await self._periodically(timer)
            finally:
                loop.remove_reader(timer.fileno())

    async def _periodically(self, timer: TimerFd) -> None:
        last = -math.inf
        while True:
            due = self._next_due(last)
            timer.set(due)
            while not (over := timer.wait()) and not self._is_retimed:
                self._wake.clear()
                await self._wake.wait()
            if over:
                last = due
                await self._once(None)

    async def _once(self, message: Received | None) -> None:
        """Run once; after a failure the back-off follows."""
        await self._tasks.gate.enter_async(self)
        try:
            try:
                outcome = self._call(message)
                if outcome is not None:
                    await outcome
            finally:
                self._tasks.gate.leave(self)
        except (Exception, SystemExit, asyncio.CancelledError) as error:
            own = asyncio.current_task()
            if isinstance(error, asyncio.CancelledError) and own is not None and own.cancelling():
                raise  # this task itself is cancelled, not a task that the run awaits
            delay = await asyncio.to_thread(self._ended, error)  # the traceback reads source files
        else:
            self._ended(None)
            return
        self._tasks.failed(self, self.problem)
        await asyncio.sleep(delay)


class ThreadTaskRunner(TaskRunner):
    """Runs a plain function in a thread of its own."""

    def stop(self, *, stuck: bool = False) -> None:
        """End after the present run; ``stuck``: the run hangs, so its thread is left behind."""
        super().stop(stuck=stuck)
        self._end.set()
        self._ready.release()

    def _begin(self) -> asyncio.Task[None]:
        self._end = threading.Event()
        self._ready = threading.Semaphore(0)
        self.wake = self._ready.release
        name = f"task {self.task.name}"
        return start_task(in_thread(self._run, name), name)

    def _run(self) -> None:
        if self.lost:
            self._end.wait(restart_delay(self.lost))
        if self.period is not None:
            with TimerFd(blocking=True) as timer:
                self._periodically(timer)
        while self._ready.acquire() and not self._end.is_set():
            with contextlib.suppress(IndexError):  # woken without a message, or the message was dropped
                self._once(self._messages.popleft())

    def _periodically(self, timer: TimerFd) -> None:
        last = -math.inf
        while not self._end.is_set():
            due = self._next_due(last)
            while due - time.monotonic() > ENTER_SLICE and not self._is_retimed:
                if self._end.wait(min(due - time.monotonic() - ENTER_SLICE / 2, ENTER_SLICE)):
                    return
            if not self._is_retimed:
                last = due
                timer.set(due)
                timer.wait()
                self._once(None)

    def _once(self, message: Received | None) -> None:
        """Run once, unless the task has to end; after a failure the back-off follows."""
        if not self._tasks.gate.enter(self, self._end.is_set):
            return
        try:
            try:
                self._call(message)
            finally:
                self._tasks.gate.leave(self)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - the top of the user's code
            delay = self._ended(error)
        else:
            self._ended(None)
            return
        if not self._end.is_set():
            self._tasks.call_in_loop(self._tasks.failed, self, self.problem)
            self._end.wait(delay)


class Tasks(RuntimePart):
    """All tasks of one resource.

    Args:
        runtime: The runtime of the resource.
        on_deactivate: Called in the event loop with the reason, when the failure of a task deactivates the resource.
    """

    def __init__(self, runtime: Runtime, on_deactivate: Callable[[str], None]) -> None:
        super().__init__(runtime)
        self.call_in_loop = runtime.call_in_loop
        self._on_deactivate = on_deactivate
        self.gate = RunGate()
        self._runners: dict[str, AsyncTaskRunner | ThreadTaskRunner] = {}
        # The problem of each task that was too slow in the last window in which it ran, by name.
        #
        # It is empty after the first such window, because that alone may be due to load of the machine.
        self._slow: dict[str, str] = {}

    def report(self, problem: str) -> str:
        """Log a new problem of a task, and return it."""
        _log.warning("! %s: %s [resource-trouble]", self._runtime.node.name, problem)
        return problem

    def problems(self) -> tuple[list[str], list[str]]:
        """The present problems of tasks."""
        found = [runner.problem or self._slow.get(name, "") for name, runner in self._runners.items()]
        return [], [problem for problem in found if problem]

    def window_ended(self, measured: Mapping[str, Value]) -> None:  # noqa: ARG002
        """Find the tasks that were too slow in the window."""
        for name, runner in self._runners.items():
            report, runner.report = runner.report, TaskReport()
            if not report.runs and not report.dropped:
                continue  # no run to judge
            before, text = self._slow.pop(name, None), report.too_slow(runner.period)
            if text:
                problem = f"task {name} too slow: {text}" if before is not None else ""
                self._slow[name] = self.report(problem) if problem and not before else problem
            elif before:
                _log.info("= %s: task %s keeps up again", self._runtime.node.name, name)

    async def start(self) -> None:
        """Listen to the inputs on which tasks run."""
        if any(task.on is not None for task in self._runtime.resource.tasks.values()):
            self._runtime.listeners.append(self.heard)

    def activate(self) -> None:
        """Start all tasks."""
        for task in self._runtime.resource.tasks.values():
            self._start_task(task)
        self._work.start(self._watch(), "look for stuck tasks")

    async def deactivate(self) -> None:
        """End all tasks; returns when none runs any more, except those that are stuck."""
        await self._work.close()
        runners, self._runners = list(self._runners.values()), {}
        self._slow.clear()
        for runner in runners:
            runner.stop()
        await asyncio.gather(*(runner.ended() for runner in runners))

    async def close(self) -> None:
        """End all tasks."""
        await self.deactivate()

    async def pause(self, holder: str = "profile") -> None:
        """Let no run begin, and wait until none is under way, at most ``limits.TASK_PAUSE_TIMEOUT`` seconds.

        Args:
            holder: The kind of change; runs begin again when each holder has called ``resume``.
        """
        self.gate.close(holder)
        await asyncio.to_thread(self.gate.wait_empty, limits.TASK_PAUSE_TIMEOUT)

    def resume(self, holder: str = "profile") -> None:
        """Let runs begin again, unless another change is under way."""
        self.gate.open(holder)

    def heard(self, topic: DeclaredTopic, _raw: bytes, _now_ns: int, message: Received | None) -> None:
        """Queue a message for the tasks that run on its input."""
        for runner in self._runners.values():
            if runner.task.on is topic and message is not None:
                runner.enqueue(message)

    def parameter_changed(self, parameter: Parameter) -> None:
        """Change the rate of the tasks that follow the parameter."""
        for runner in self._runners.values():
            if runner.task.rate_parameter is parameter:
                runner.retime(parameter.value)

    def failed(self, runner: TaskRunner, problem: str) -> None:
        """Report a run that has raised, and end the task if it is declared not to restart."""
        if self._runners.get(runner.task.name) is not runner:
            return
        self.report(problem)
        if runner.task.on_failure is not OnFailure.RESTART:
            self._end(runner, problem.removeprefix(f"task {runner.task.name} failed: "))

    def _start_task(self, task: Task, lost: int = 0, problem: str = "") -> None:
        kind = AsyncTaskRunner if asyncio.iscoroutinefunction(task.function) else ThreadTaskRunner
        runner = self._runners[task.name] = kind(self, task, lost, problem)
        runner.start()

    def _end(self, runner: TaskRunner, why: str) -> None:
        runner.stop()
        runner.problem = self.report(f"task {runner.task.name} stopped: {why}")
        if runner.task.on_failure is OnFailure.DEACTIVATE:
            self._on_deactivate(f"task {runner.task.name}: {why}")

    async def _watch(self) -> None:
        """Give up runs that are stuck."""
        while True:
            await asyncio.sleep(_STUCK_CHECK)
            for runner in list(self._runners.values()):
                task, since, now = runner.task, runner.running_since, time.monotonic()
                if since is None or runner.stopped or now - since < stuck_after(runner.period, task.stuck_after):
                    continue
                text = f"a run has not ended for {now - since:.3g} s"
                problem = self.report(f"task {task.name} stuck: {text}")
                runner.stop(stuck=True)
                if task.on_failure is OnFailure.RESTART:
                    self._start_task(task, runner.lost + 1, problem)
                else:
                    self._end(runner, text)
