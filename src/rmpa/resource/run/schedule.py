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
    """Statistics of a task over one window; values that were not measured are ``None``.

    Args:
        runs: Number of runs.
        failures: Runs that raised.
        overruns: Runs that took more than a period.
        missed: Due times that were skipped because of overruns.
        dropped: Messages of the task's input that were dropped because the task was too slow.
        lateness: Mean time from the due time to the beginning of a run, in seconds.
        lateness_max: The longest such time, in seconds.
        period_sd: Standard deviation of the time between the beginnings of two runs, in seconds.
        busy: Share of the window in which the task ran, 0 to 1.
    """

    runs: int = 0
    failures: int = 0
    overruns: int = 0
    missed: int = 0
    dropped: int = 0
    lateness: float | None = None
    lateness_max: float | None = None
    period_sd: float | None = None
    busy: float = 0.0


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
    """Measures one task: updated by the thread that runs the task, read by the event loop. It keeps only sums.

    Args:
        period: The period in seconds; ``None`` for a task that runs on messages.
        now: The beginning of the first window, in monotonic seconds.
    """

    def __init__(self, period: float | None, now: float) -> None:
        self._period = period
        self._window = now
        self._due = now
        self._began: float | None = None
        self._last: float | None = None
        self.in_a_row = 0
        """Number of failures since the last run that succeeded."""
        self.error = ""
        """The error of the last run; empty if it succeeded."""
        self._clear()

    def _clear(self) -> None:
        self._runs = self._failures = self._overruns = self._missed = self._dropped = 0
        self._late = self._late_max = self._busy = 0.0
        self._lates = self._periods = 0
        self._sum = self._squares = 0.0

    @property
    def running_since(self) -> float | None:
        """When the present run began, in monotonic seconds; ``None`` between two runs."""
        return self._began

    def begun(self, due: float, now: float) -> None:
        """Record that a run begins at ``now`` that was due at ``due``, both in monotonic seconds."""
        self._due, self._began = due, now  # evaluated after the run, so that the run begins sooner

    def _add_beginning(self, now: float) -> None:
        late = max(0.0, now - self._due)
        self._late += late
        self._late_max = max(self._late_max, late)
        self._lates += 1
        if self._last is not None:
            period = now - self._last
            self._periods += 1
            self._sum += period
            self._squares += period * period
        self._last = now

    def ended(self, now: float, error: str = "") -> None:
        """Record that the run has ended; ``error`` is empty if it succeeded."""
        took = 0.0
        if self._began is not None:
            self._add_beginning(self._began)
            took = now - self._began
        self._began = None
        self._runs += 1
        self._busy += took
        if self._period is not None and took > self._period:
            self._overruns += 1
        self.error = error
        if error:
            self._failures += 1
            self.in_a_row += 1
        else:
            self.in_a_row = 0

    def interrupted(self) -> None:
        """Exclude the time until the next run from the periods: the task waited for another reason."""
        self._last = None

    def retimed(self, period: float) -> None:
        """Set the period, in seconds, that applies from now on."""
        self._period = period
        self._last = None

    def missed(self, count: int) -> None:
        """Count skipped due times."""
        self._missed += count

    def dropped(self) -> None:
        """Count a dropped message."""
        self._dropped += 1

    def window(self, now: float) -> TaskReport:
        """End the window and return its statistics."""
        mean = self._sum / self._periods if self._periods else 0.0
        report = TaskReport(
            runs=self._runs,
            failures=self._failures,
            overruns=self._overruns,
            missed=self._missed,
            dropped=self._dropped,
            lateness=self._late / self._lates if self._lates else None,
            lateness_max=self._late_max if self._lates else None,
            period_sd=math.sqrt(max(0.0, self._squares / self._periods - mean * mean)) if self._periods > 1 else None,
            busy=min(1.0, self._busy / max(now - self._window, _EARLY)),
        )
        self._window = now
        self._clear()
        return report


def restart_delay(in_a_row: int) -> float:
    """The back-off in seconds after ``in_a_row`` consecutive failures."""
    return min(RESTART_FIRST * 2.0 ** min(max(0, in_a_row - 1), 16), RESTART_MAX)


def stuck_after(period: float | None, declared: float | None) -> float:
    """Seconds after which a run counts as stuck: as declared, or else from the period (``None``: on messages)."""
    if declared is not None:
        return declared
    return max(STUCK_LEAST, STUCK_PERIODS * period) if period is not None else STUCK_LEAST
