"""The tasks of a resource: periodic ones on an absolute schedule, others on the messages of an input.

A task that raises is reported, and is restarted after a back-off or ends, as declared. A run that does not return is
reported as stuck and given up: a coroutine is cancelled; a thread cannot be stopped, so it is left behind. Unless the
task ends by its declaration, a new coroutine or thread continues it.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Final

from rmpa.resource import limits
from rmpa.resource.declare.behaviour import OnFailure
from rmpa.resource.run.run_gate import RunGate
from rmpa.resource.run.runtime import RuntimePart
from rmpa.resource.run.schedule import too_slow
from rmpa.resource.run.task_runners import AsyncTaskRunner, TaskProblem, ThreadTaskRunner
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.behaviour import Task
    from rmpa.resource.declare.connections import Input
    from rmpa.resource.declare.parameters import Parameter
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.schedule import TaskReport
    from rmpa.resource.run.task_runners import TaskRunner
    from rmpa.ros.node.endpoints import Received
    from rmpa.ros.types.definitions import DiagnosticLevel

_log = logging.getLogger(__name__)
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
