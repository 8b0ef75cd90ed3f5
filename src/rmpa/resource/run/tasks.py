"""Tasks of a resource: their runs, and the gate between runs and changes of profile or context.

A gate that separates the runs of tasks from changes of the profile, the context or several parameters.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from rmpa.resource import limits
from rmpa.resource.declare.parameters import OnFailure
from rmpa.resource.run.descriptor import Schedule, TaskFigures, restart_delay, stuck_after, too_slow
from rmpa.resource.run.runtime import RuntimePart
from rmpa.runtime.loop import MachineTimer, TimerFd

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.parameters import Input, Parameter, Task
    from rmpa.resource.run.descriptor import TaskReport
    from rmpa.resource.run.runtime import Runtime
    from rmpa.ros.node.endpoints import Received
    from rmpa.ros.types.definitions import DiagnosticLevel

ENTER_SLICE: Final = 0.1
"""The longest time in seconds that a waiting thread takes to notice that it has to end."""
_POLL: Final = 0.002
"""Seconds between a waiting coroutine's checks of the gate; polling will do, because changes are rare and short."""


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
        # An open gate is entered without the lock: a closer examines the runs inside only after it has closed.
        self._inside.add(run)
        if not self._closers:
            return True
        with self._change:
            self._inside.discard(run)
            self._change.notify_all()
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
        self._inside.discard(run)
        if self._closers:
            with self._change:
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


# Runners of tasks: a coroutine function runs in the event loop, a plain function in a thread of its own.


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


# The tasks of a resource: periodic ones on an absolute schedule, others on the messages of an input.
#
# A task that raises is reported, and is restarted after a back-off or ends, as declared. A run that does not
# return is
# reported as stuck and given up: a coroutine is cancelled; a thread cannot be stopped, so it is left behind.
# Unless the
# task ends by its declaration, a new coroutine or thread continues it.


_STUCK_CHECK: Final = 0.25
"""Seconds between checks for stuck runs."""


class Tasks(RuntimePart):
    """All tasks of one resource.

    Args:
        runtime: The runtime of the resource.
        on_problem: Called in the event loop with each new problem of a task.
        on_deactivate: Called in the event loop with the reason, when the failure of a task deactivates the resource.
    """

    def __init__(
        self,
        runtime: Runtime,
        *,
        on_problem: Callable[[TaskProblem], None],
        on_deactivate: Callable[[str], None],
    ) -> None:
        self._runtime = runtime
        self._on_problem = on_problem
        self._on_deactivate = on_deactivate
        self._runners: dict[str, TaskRunner] = {}
        self._slow: dict[str, TaskProblem] = {}
        """The problem of each task that was too slow in the last two windows in which it ran, by name."""
        self._lagged: set[str] = set()
        """Names of tasks that were too slow in the last window; one alone may be due to load of the machine."""
        self._next_check: float | None = None
        self._timer = MachineTimer(lambda: self._next_check, self._check_stuck, now=time.monotonic)
        self._gate = RunGate()

    @property
    def running(self) -> Mapping[str, str]:
        """State by task: ``running``, ``waiting`` (the last run failed), ``stuck``, or ``stopped`` and why.

        ``waiting`` and ``stuck`` last until a run succeeds.
        """
        return {name: runner.state for name, runner in self._runners.items()}

    @property
    def problems(self) -> list[str]:
        """The present problems of tasks, as texts for people."""
        found = []
        for name, runner in self._runners.items():
            if runner.over:
                found.append(f"task {name} {runner.state}")
            elif runner.problem is not None:
                found.append(str(runner.problem))
            elif name in self._slow:
                found.append(str(self._slow[name]))
        return found

    def window_ended(self, level: DiagnosticLevel, message: str, measured: Mapping[str, Value]) -> None:  # noqa: ARG002
        """Find the tasks that were too slow in the window."""
        for name, report in self.reports().items():
            if not report.runs and not report.dropped:
                continue  # no run to judge
            runner, known = self._runners[name], self._slow.pop(name, None)
            if text := too_slow(report, runner.period):
                if name in self._lagged:
                    self._slow[name] = TaskProblem(runner.task, "too slow", text)
                    if known is None:
                        self._on_problem(self._slow[name])
                self._lagged.add(name)
                continue
            self._lagged.discard(name)
            if known is not None:
                _log.info("= /%s: task %s keeps up again", self._runtime.resource.name, name)

    def activate(self) -> None:
        """Start all tasks."""
        for task in self._runtime.resource.tasks.values():
            self._start_task(task)
        self._next_check = time.monotonic() + _STUCK_CHECK
        self._timer.arm()

    async def deactivate(self) -> None:
        """End all tasks; returns when none runs any more, except those that are stuck."""
        self._next_check = None
        self._timer.arm()
        runners, self._runners = list(self._runners.values()), {}
        self._slow.clear()
        self._lagged.clear()
        for runner in runners:
            runner.stop()
        await asyncio.gather(*(runner.ended() for runner in runners))

    async def pause(self, holder: str = "profile") -> None:
        """Let no run begin, and wait until none is under way, at most ``limits.TASK_PAUSE_TIMEOUT`` seconds.

        Args:
            holder: The kind of change; runs begin again when each holder has called ``resume``.
        """
        self._gate.close(holder)
        await asyncio.to_thread(self._gate.wait_empty, limits.TASK_PAUSE_TIMEOUT)

    def resume(self, holder: str = "profile") -> None:
        """Let runs begin again, unless another change is under way."""
        self._gate.open(holder)

    async def close(self) -> None:
        """End all tasks, because the resource ends."""
        await self.deactivate()

    def reports(self) -> dict[str, TaskReport]:
        """Measurements of each task since the last call."""
        return {name: runner.figures.window() for name, runner in self._runners.items()}

    def received(self, item: Input, message: Received) -> None:
        """Queue a message for the tasks that run on its input."""
        for runner in self._runners.values():
            if runner.task.on is item:
                runner.enqueue(message)

    def parameter_changed(self, parameter: Parameter) -> None:
        """Change the rate of the tasks that follow the parameter."""
        for runner in self._runners.values():
            if runner.task.rate_parameter is parameter:
                runner.retime(parameter.value)

    # --- inside -------------------------------------------------------------------------------------------------

    def _start_task(self, task: Task, *, lost: int = 0, problem: TaskProblem | None = None) -> None:
        """Start a task, after a back-off if ``lost`` consecutive runs were stuck."""
        kind = AsyncTaskRunner if asyncio.iscoroutinefunction(task.function) else ThreadTaskRunner
        runner = kind(task, self._gate, lambda text: self._failed(task, text))
        runner.lost, runner.problem = lost, problem
        self._runners[task.name] = runner
        runner.start()

    def _failed(self, task: Task, text: str) -> None:
        """Report a run that has raised, and end the task if it is declared not to restart."""
        runner = self._runners.get(task.name)
        if runner is None:
            return
        problem = TaskProblem(task, "failed", text)
        if runner.waiting:
            runner.problem = problem
        self._on_problem(problem)
        if task.on_failure is not OnFailure.RESTART:
            self._end(runner, text)

    def _end(self, runner: TaskRunner, text: str) -> None:
        runner.stop()
        runner.over = text
        self._on_problem(TaskProblem(runner.task, "stopped", text))
        if runner.task.on_failure is OnFailure.DEACTIVATE:
            self._on_deactivate(f"task {runner.task.name}: {text}")

    def _check_stuck(self, now: float) -> None:
        self._next_check = now + _STUCK_CHECK
        for runner in list(self._runners.values()):
            since = runner.figures.running_since
            if since is None or runner.stopped or now - since < runner.stuck_after:
                continue
            text = f"a run has not ended for {now - since:.3g} s"
            problem = TaskProblem(runner.task, "stuck", text)
            self._on_problem(problem)
            runner.stop(stuck=True)
            if runner.task.on_failure is OnFailure.RESTART:
                self._start_task(runner.task, lost=runner.lost + 1, problem=problem)
            else:
                self._end(runner, text)
