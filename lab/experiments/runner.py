"""Measures cell after cell, keeps what comes, and goes on where one fails."""

from __future__ import annotations

import time
import traceback
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lab import machine
from lab.experiments.model import Cell, Experiment, Measured
from lab.experiments.store import Store, utc
from lab.frames import frame
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import AbstractContextManager

    from lab.bed.plan import Plan
    from lab.bed.stage import Stage
    from lab.experiments.progress import Progress

# Each cell's table of how late the machine's own wake-ups came: ``when`` (before, after the cell), ``late_us``.
LATENESS: Final = "lateness"
# Of sleeps before and after each cell.
LATENESS_SECONDS: Final = 0.3
# How often a cell is tried.
ATTEMPTS: Final = 2


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a run.

    Args:
        measured: Cells that were measured now.
        there: Cells that had been measured before.
        failed: Those that could not be: experiment, cell and the last error.
    """

    measured: int
    there: int
    failed: tuple[tuple[str, str, str], ...]


# An experiment, and which of its cells are wanted.
Job = tuple["Experiment", "Sequence[Cell]"]


def to_measure(jobs: Sequence[Job], store: Store) -> list[tuple[Experiment, Cell]]:
    """The cells that are not there yet, in the order in which they are going to be measured."""
    return [(experiment, cell) for experiment, cells in jobs for cell in cells if not store.is_done(cell)]


def run(
    jobs: Sequence[Job],
    store: Store,
    make_stage: Callable[[Plan], AbstractContextManager[Stage]],
    progress: Progress,
    *,
    lateness: Callable[[float], list[float]] = machine.lateness,
) -> Outcome:
    """Measure what is not there yet; call it from the main thread, which child processes are tied to.

    A KeyboardInterrupt ends it, with all that was measured until then kept.

    Args:
        jobs: What is wanted.
        store: Where it is kept.
        make_stage: Sets the stage for one cell.
        progress: Shows how it goes.
        lateness: Says how late sleeps of so many seconds altogether end, in µs.
    """
    for experiment, cells in jobs:
        store.expect(experiment.name, experiment.title, cells)
    measured, failed = 0, []
    waiting = to_measure(jobs, store)
    for experiment, cell in waiting:
        began = time.monotonic()
        error = ""
        for attempt in range(1, ATTEMPTS + 1):
            progress.begins(cell, attempt)
            started, started_utc = time.monotonic(), utc()
            try:
                came = _measure(experiment, cell, store.plan, make_stage, lateness)
                took = time.monotonic() - started
                store.note(cell, came, began=started_utc, seconds=took, attempts=attempt, error=error)
            except Exception as caught:  # noqa: BLE001 - the top of one cell: the others do not depend on it
                error = _told(caught)
                progress.fails(cell, error, again=attempt < ATTEMPTS)
                if attempt == ATTEMPTS:
                    took = time.monotonic() - started
                    store.note(cell, None, began=started_utc, seconds=took, attempts=attempt, error=error)
                    failed.append((cell.experiment, cell.key, error))
            else:
                progress.ends(cell, time.monotonic() - began)
                measured += 1
                break
    return Outcome(measured, sum(len(cells) for _, cells in jobs) - len(waiting), tuple(failed))


def _measure(
    experiment: Experiment,
    cell: Cell,
    plan: Plan,
    make_stage: Callable[[Plan], AbstractContextManager[Stage]],
    lateness: Callable[[float], list[float]],
) -> Measured:
    before = lateness(LATENESS_SECONDS)
    with make_stage(plan) as stage:
        came = experiment.measure(cell, stage)
    after = lateness(LATENESS_SECONDS)
    if LATENESS in came.tables:
        raise ValueError(f"{experiment.name} has a table {LATENESS!r}, which is the runner's")
    rows = [("before", round(late, 1)) for late in before] + [("after", round(late, 1)) for late in after]
    return Measured({**came.tables, LATENESS: frame(("when", "late_us"), rows)}, came.facts)


def _told(error: Exception) -> str:
    """What a bed says is for its user; anything else is a mistake of ours, and its place is needed."""
    if isinstance(error, RmpaError):
        return f"{type(error).__name__}: {error}"
    return "".join(traceback.format_exception(error)).rstrip()
