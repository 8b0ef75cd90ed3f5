"""Runs the tasks of a resource: each periodic one on an absolute schedule, each other one on its input's messages.

A plain function has a thread of its own, so that it may block and sleep; a coroutine function runs in the loop. One
that raises is reported and goes on after a pause that grows (or ends, as it was declared). One that does not come
back is reported as stuck: a coroutine is cancelled; a thread cannot be, so it is given up, and a new one takes over.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

from rmpa.resource import limits
from rmpa.resource.declare.resource import OnFailure
from rmpa.resource.run.runtime import RuntimePart
from rmpa.resource.run.schedule import Schedule, TaskFigures, restart_delay, stuck_after, too_slow
from rmpa.runtime.timerfd import TimerFd

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.resource.declare.resource import Input, Parameter, Task
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.schedule import TaskReport
    from rmpa.ros.node.topics import Received

_log = logging.getLogger(__name__)
_LOOK: Final = 0.25
"""Seconds between looks whether a task is stuck."""
_GATE_LOOK: Final = 0.002
"""Seconds between a coroutine's looks whether it may go on; a profile is applied seldom, and soon."""
_SLICE: Final = 0.1
"""Seconds that a thread sleeps at most without a look whether it is to end."""


class Gate:
    """Lets runs through while it is open; who closes it waits until none is within.

    So that a profile is applied between two runs: no message is made half under the one and half under the other.
    """

    def __init__(self) -> None:
        self._change = threading.Condition()
        self._closers: set[str] = set()
        self._within: set[object] = set()

    def enter(self, who: object, ended: Callable[[], bool]) -> bool:
        """Wait in a thread until it is open, or ``ended`` says that nobody need go in any more (then false)."""
        # No lock on the way of a task that is due: whoever closes looks within only after that.
        self._within.add(who)
        if not self._closers:
            return True
        with self._change:
            self._within.discard(who)
            self._change.notify_all()
            while self._closers:
                if ended():
                    return False
                self._change.wait(_SLICE)
            self._within.add(who)
            return True

    def leave(self, who: object) -> None:
        """The run has ended; or it is stuck, and nobody is to wait for it any more."""
        self._within.discard(who)
        if self._closers:
            with self._change:
                self._change.notify_all()

    def close(self, who: str) -> None:
        """Let nobody in any more."""
        with self._change:
            self._closers.add(who)

    def empty(self, timeout: float) -> bool:
        """Wait in a thread until nobody is within; false if that takes longer than so many seconds."""
        with self._change:
            return self._change.wait_for(lambda: not self._within, timeout)

    def open(self, who: str) -> None:
        """Let runs through again, if nobody else keeps it closed."""
        with self._change:
            self._closers.discard(who)
            self._change.notify_all()

    async def enter_soon(self, who: object) -> None:
        """As ``enter``, in the loop."""
        while True:
            with self._change:
                if not self._closers:
                    self._within.add(who)
                    return
            await asyncio.sleep(_GATE_LOOK)


class TaskProblem:
    """What went wrong with a task, for the diagnostics and the log."""

    def __init__(self, task: Task, kind: str, text: str) -> None:
        self.task = task
        self.kind = kind
        """``failed``, ``stuck``, ``stopped`` or ``too slow``."""
        self.text = text

    def __str__(self) -> str:
        """Say which task, and what."""
        return f"task {self.task.name} {self.kind}: {self.text}"


class Tasks(RuntimePart):
    """All tasks of one resource.

    Args:
        runtime: Of the resource.
        on_problem: Called in the loop.
        on_deactivate: Called in the loop with the reason when a task's failure is to deactivate the resource.
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
        self._runners: dict[str, _Runner] = {}
        self._slow: dict[str, TaskProblem] = {}
        """Tasks that were too slow in the last two windows in which they ran."""
        self._lagged: set[str] = set()
        """Those that were in the last one: once is the machine's business."""
        self._looker: asyncio.TimerHandle | None = None
        self._gate = Gate()

    @property
    def running(self) -> Mapping[str, str]:
        """By task: ``running``, ``waiting`` (it failed), ``stuck`` (it did not come back) or ``stopped`` and why.

        The middle two last until a run ends well.
        """
        return {name: runner.state for name, runner in self._runners.items()}

    @property
    def troubles(self) -> list[str]:
        """What does not work, for people."""
        found = []
        for name, runner in self._runners.items():
            if runner.over:
                found.append(f"task {name} {runner.state}")
            elif runner.problem is not None:
                found.append(str(runner.problem))
            elif name in self._slow:
                found.append(str(self._slow[name]))
        return found

    def judge(self) -> None:
        """A window of quality ends: see which tasks were too slow in it."""
        for name, report in self.reports(time.monotonic()).items():
            if not report.runs and not report.dropped:
                continue  # nothing that could be judged
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
        """Begin all tasks."""
        for task in self._runtime.resource.tasks.values():
            self._begin(task)
        self._look()

    async def deactivate(self) -> None:
        """End all tasks; returns when none runs any more, but for those that are stuck."""
        if self._looker is not None:
            self._looker.cancel()
            self._looker = None
        runners, self._runners = list(self._runners.values()), {}
        self._slow.clear()
        self._lagged.clear()
        for runner in runners:
            runner.stop()
        await asyncio.gather(*(runner.ended() for runner in runners))

    async def pause(self, who: str = "profile") -> None:
        """Let no run begin, and wait until none is under way; one that is stuck is not waited for.

        Args:
            who: What changes; runs begin again when the last change is over.
        """
        self._gate.close(who)
        await asyncio.to_thread(self._gate.empty, limits.TASK_PAUSE_TIMEOUT)

    def resume(self, who: str = "profile") -> None:
        """Let the tasks go on, if nothing else changes."""
        self._gate.open(who)

    async def close(self) -> None:
        """End with the resource."""
        await self.deactivate()

    def reports(self, now: float) -> dict[str, TaskReport]:
        """What was measured of each task since the last call."""
        return {name: runner.figures.window(now) for name, runner in self._runners.items()}

    def received(self, item: Input, message: Received) -> None:
        """Hand a message to the tasks that run on its input."""
        for runner in self._runners.values():
            if runner.task.on is item:
                runner.give(message)

    def parameter_changed(self, parameter: Parameter) -> None:
        """Let the tasks go on whose rate it is."""
        for runner in self._runners.values():
            if runner.task.follows is parameter:
                runner.retime(parameter.value)

    # --- inside -------------------------------------------------------------------------------------------------

    def _begin(self, task: Task, *, lost: int = 0, problem: TaskProblem | None = None) -> None:
        """Begin a task; after ``lost`` runs in a row that did not come back, behind a pause."""
        kind = _AsyncRunner if asyncio.iscoroutinefunction(task.function) else _ThreadRunner
        runner = kind(task, self._gate, lambda text: self._failed(task, text))
        runner.lost, runner.problem = lost, problem
        self._runners[task.name] = runner
        runner.start()

    def _failed(self, task: Task, text: str) -> None:
        """A run raised; called in the loop."""
        runner = self._runners.get(task.name)
        if runner is None:
            return
        problem = TaskProblem(task, "failed", text)
        if runner.waiting:
            runner.problem = problem
        self._on_problem(problem)
        if task.on_failure is not OnFailure.RESTART:
            self._end(runner, text)

    def _end(self, runner: _Runner, text: str) -> None:
        runner.stop()
        runner.over = text
        self._on_problem(TaskProblem(runner.task, "stopped", text))
        if runner.task.on_failure is OnFailure.DEACTIVATE:
            self._on_deactivate(f"task {runner.task.name}: {text}")

    def _look(self) -> None:
        """See whether a task is stuck."""
        self._looker = asyncio.get_running_loop().call_later(_LOOK, self._look)
        now = time.monotonic()
        for runner in list(self._runners.values()):
            since = runner.figures.running_since
            if since is None or runner.stopped or now - since < runner.patience:
                continue
            text = f"a run has not ended for {now - since:.3g} s"
            problem = TaskProblem(runner.task, "stuck", text)
            self._on_problem(problem)
            runner.stop(stuck=True)
            if runner.task.on_failure is OnFailure.RESTART:
                self._begin(runner.task, lost=runner.lost + 1, problem=problem)
            else:
                self._end(runner, text)


class _Runner:
    """Runs one task until it is stopped."""

    def __init__(self, task: Task, gate: Gate, on_failed: Callable[[str], None]) -> None:
        rate = task.follows.value if task.follows is not None else task.rate
        period = 1 / rate if rate else None
        self.task = task
        self.waiting = False
        """Whether its last run failed."""
        self.lost = 0
        """Runs in a row that did not come back."""
        self.problem: TaskProblem | None = None
        """What was wrong with its last run; ``None`` once one ended well."""
        self.over = ""
        """Why it ended by itself, or empty."""
        self.stopped = False
        self.patience = stuck_after(period, task.stuck_after)
        self.figures = TaskFigures(period, time.monotonic())
        self.period = period
        """Seconds, of a periodic one, else ``None``."""
        self._gate = gate
        self._on_failed = on_failed
        self._messages: deque[Received] = deque()

    @property
    def state(self) -> str:
        """For people."""
        if self.over:
            return f"stopped: {self.over}"
        if self.waiting:
            return "waiting"
        return "stuck" if self.lost else "running"

    def _well(self) -> None:
        """A run has ended well."""
        self.figures.ended(time.monotonic())
        self.waiting, self.lost, self.problem = False, 0, None

    def start(self) -> None:
        raise NotImplementedError

    def stop(self, *, stuck: bool = False) -> None:
        raise NotImplementedError

    async def ended(self) -> None:
        raise NotImplementedError

    def wake(self) -> None:
        raise NotImplementedError

    def retime(self, rate: float) -> None:
        """Go on with another rate, Hz: the next run is due one new period behind the last one."""
        self.period = 1 / rate
        self.patience = stuck_after(self.period, self.task.stuck_after)
        self.figures.retimed(self.period)
        self.wake()

    def give(self, message: Received) -> None:
        """Queue a message; the oldest gives way."""
        if len(self._messages) >= limits.TASK_QUEUE_MESSAGES:
            self._messages.popleft()
            self.figures.dropped()
        self._messages.append(message)
        self.wake()

    def _arguments(self, message: Received | None) -> tuple[Any, ...]:
        return () if message is None else (message.message,)

    def _error(self, error: BaseException) -> str:
        text = f"{type(error).__name__}: {error}"
        known = self.problem is not None and self.problem.text == text
        if not known:  # the same again needs no other traceback
            _log.warning("! task %s failed:", self.task.name, exc_info=error)
        return text


class _AsyncRunner(_Runner):
    """A coroutine function, in the loop."""

    def start(self) -> None:
        """Begin."""
        self._wake = asyncio.Event()
        self._task = asyncio.get_running_loop().create_task(self._run(), name=f"task {self.task.name}")

    def stop(self, *, stuck: bool = False) -> None:
        """End, in the middle of a run too."""
        self.stopped = True
        if stuck:
            self._gate.leave(self)
        self._task.cancel()

    async def ended(self) -> None:
        """Wait until it has."""
        await asyncio.wait([self._task], timeout=limits.TASK_END_TIMEOUT)

    def wake(self) -> None:
        """A message is there."""
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
            if schedule.period != self.period:
                period = self.period or period
                schedule = Schedule(period, max(last + period, time.monotonic()))
            missed = schedule.missed
            due = schedule.next_due(time.monotonic())
            self.figures.missed(schedule.missed - missed)
            timer.set(due)
            while not (over := timer.wait()) and schedule.period == self.period:
                self._wake.clear()
                await self._wake.wait()
            if not over:
                continue  # it has another period meanwhile
            last = due
            if not await self._once(due, None):
                schedule = Schedule(period, time.monotonic())

    async def _on_messages(self) -> None:
        while True:
            while self._messages:
                message = self._messages.popleft()
                await self._once(message.stamp_ns / 1e9 - time.time() + time.monotonic(), message)
            self._wake.clear()
            await self._wake.wait()

    async def _once(self, due: float, message: Received | None) -> bool:
        """One run; false after a failure and its pause."""
        await self._gate.enter_soon(self)
        self.figures.begun(due, time.monotonic())
        try:
            try:
                outcome = self.task.function(*self._arguments(message))
                if outcome is not None:
                    await outcome
            finally:
                self._gate.leave(self)
        except (Exception, SystemExit, asyncio.CancelledError) as error:
            own = asyncio.current_task()
            if isinstance(error, asyncio.CancelledError) and own is not None and own.cancelling():
                raise  # it is us that are to end, not something that the run waited for
            text = await asyncio.to_thread(self._error, error)  # the traceback reads source files
        else:
            self._well()
            return True
        self.figures.ended(time.monotonic(), text)
        self.waiting = True
        self._on_failed(text)
        await asyncio.sleep(restart_delay(self.figures.in_a_row))
        self.figures.interrupted()
        return False


class _ThreadRunner(_Runner):
    """A plain function, in a thread of its own."""

    def start(self) -> None:
        """Begin."""
        self._end = threading.Event()
        self._ready = threading.Semaphore(0)
        self._loop = asyncio.get_running_loop()
        self._done = asyncio.Event()
        name = f"task {self.task.name}"
        # A daemon: one that is stuck must not keep the process from its end.
        threading.Thread(target=self._thread, name=name, daemon=True).start()

    def stop(self, *, stuck: bool = False) -> None:
        """End behind the present run; a stuck one is not waited for."""
        self.stopped = True
        self._end.set()
        self._ready.release()
        if stuck:
            self._gate.leave(self)
            self._done.set()

    async def ended(self) -> None:
        """Wait until it has, a while at the most."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limits.TASK_END_TIMEOUT):
                await self._done.wait()
                return
        _log.warning("! task %s does not end; it is left behind", self.task.name)

    def wake(self) -> None:
        """A message is there."""
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
            with contextlib.suppress(RuntimeError):  # the loop has ended before us
                self._loop.call_soon_threadsafe(self._done.set)

    def _periodically(self, period: float, timer: TimerFd) -> None:
        schedule, last = Schedule(period, time.monotonic()), -math.inf
        while not self._end.is_set():
            if schedule.period != self.period:
                period = self.period or period
                schedule = Schedule(period, max(last + period, time.monotonic()))
            missed = schedule.missed
            due = schedule.next_due(time.monotonic())
            self.figures.missed(schedule.missed - missed)
            while due - time.monotonic() > _SLICE and schedule.period == self.period:
                if self._end.wait(min(due - time.monotonic() - _SLICE / 2, _SLICE)):
                    return
            if schedule.period != self.period:
                continue
            last = due
            timer.set(due)
            timer.wait()
            if not self._once(due, None):
                schedule = Schedule(period, time.monotonic())

    def _on_messages(self) -> None:
        while True:
            self._ready.acquire()
            if self._end.is_set():
                return
            with contextlib.suppress(IndexError):  # it gave way to newer ones
                message = self._messages.popleft()
                self._once(message.stamp_ns / 1e9 - time.time() + time.monotonic(), message)

    def _once(self, due: float, message: Received | None) -> bool:
        """One run; false after a failure and its pause."""
        if not self._gate.enter(self, self._end.is_set):
            return False
        self.figures.begun(due, time.monotonic())
        try:
            try:
                self.task.function(*self._arguments(message))
            finally:
                self._gate.leave(self)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - the top of the user's code
            text = self._error(error)
        else:
            self._well()
            return True
        self.figures.ended(time.monotonic(), text)
        if self._end.is_set():
            return False
        self.waiting = True
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._on_failed, text)
        self._end.wait(restart_delay(self.figures.in_a_row))
        self.figures.interrupted()
        return False
