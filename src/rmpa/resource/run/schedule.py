"""Schedules and statistics of tasks, and back-off times after failures. Pure: the time is an argument."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

RESTART_FIRST: Final = 0.1
"""Seconds of the back-off after a task's first failure."""
RESTART_MAX: Final = 5.0
"""Seconds of the longest back-off."""
STUCK_PERIODS: Final = 10
"""Number of periods after which a run is stuck, unless declared otherwise."""
STUCK_LEAST: Final = 5.0
"""Lower bound in seconds of the time after which a run is stuck, unless declared otherwise."""
_EARLY: Final = 1e-9


class Schedule:
    """The due times of a periodic task: start, start + period, start + 2 periods and so on.

    The times are absolute, so that lateness does not add up. A due time that is a whole period past is skipped.

    Args:
        period: The period in seconds, above 0.
        start: The first due time, in monotonic seconds.
    """

    def __init__(self, period: float, start: float) -> None:
        self.period = period
        self.missed = 0
        """Number of skipped due times."""
        self._start = start
        self._tick = -1

    def next_due(self, now: float) -> float:
        """Advance to the next due time and return it, in monotonic seconds like ``now``."""
        self._tick += 1
        late = math.floor((now - self._start) / self.period + _EARLY) - self._tick
        if late > 0:
            self._tick += late
            self.missed += late
        return self._start + self._tick * self.period


@dataclass(frozen=True, slots=True)
class TaskReport:
    """Statistics of a task over one window.

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


def too_slow(report: TaskReport, period: float | None) -> str:
    """The reason why a task was too slow in a window, for people; empty if it was not.

    A task was too slow if more than a tenth of its runs took longer than its period, or if messages of its input were
    dropped. A single slow run does not count, because load of the machine may have caused it.

    Args:
        report: The statistics of the window.
        period: The period in seconds; ``None`` for a task that runs on messages.
    """
    if report.dropped:
        return f"{report.dropped} messages of its input gave way to newer ones, {report.runs} were taken"
    if period is None or report.overruns * 10 <= report.runs:
        return ""
    left_out = f", {report.missed} times left out" if report.missed else ""
    return f"{report.overruns} of {report.runs} runs took longer than its period of {period:.3g} s{left_out}"


class TaskFigures:
    """Measures one task: updated by the thread that runs the task, read by the event loop.

    Args:
        period: The period in seconds; ``None`` for a task that runs on messages.
    """

    def __init__(self, period: float | None) -> None:
        self.period = period
        self.running_since: float | None = None
        """When the present run began, in monotonic seconds; ``None`` between two runs."""
        self.in_a_row = 0
        """Number of failures since the last run that succeeded."""
        self.missed = 0
        self.dropped = 0
        self._runs = 0
        self._overruns = 0

    def ended(self, now: float, *, failed: bool = False) -> None:
        """Record that the run has ended; ``now`` in monotonic seconds."""
        took = now - self.running_since if self.running_since is not None else 0.0
        self.running_since = None
        self._runs += 1
        self._overruns += self.period is not None and took > self.period
        self.in_a_row = self.in_a_row + 1 if failed else 0

    def window(self) -> TaskReport:
        """End the window and return its statistics."""
        report = TaskReport(self._runs, self._overruns, self.missed, self.dropped)
        self._runs = self._overruns = self.missed = self.dropped = 0
        return report


def restart_delay(in_a_row: int) -> float:
    """The back-off in seconds after ``in_a_row`` consecutive failures."""
    return min(RESTART_FIRST * 2.0 ** min(max(0, in_a_row - 1), 16), RESTART_MAX)


def stuck_after(period: float | None, declared: float | None) -> float:
    """Seconds after which a run counts as stuck: as declared, or else from the period (``None``: on messages)."""
    if declared is not None:
        return declared
    return max(STUCK_LEAST, STUCK_PERIODS * period) if period is not None else STUCK_LEAST
