"""How a run goes, on stderr: a bar on a terminal, one line a cell anywhere else."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Final, Self

from rmpa.cli.output import duration, printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.experiments.model import Cell

# Times a second that the bar is drawn anew: seldom, for the machine is being measured.
_REFRESH: Final = 1.0


class Progress:
    """Shows how it goes while cells are measured.

    Args:
        cells: All of them, in their order.
    """

    def __init__(self, cells: Sequence[Cell]) -> None:
        self._total, self._left = len(cells), sum(cell.seconds for cell in cells)
        self._done, self._planned = 0, 0.0
        self._began = time.monotonic()
        self._live = None
        if sys.stderr.isatty():
            from rich import progress
            from rich.console import Console

            columns = (
                progress.TextColumn("{task.description}"),
                progress.BarColumn(24),
                progress.TimeRemainingColumn(),
            )
            self._live = progress.Progress(
                *columns, console=Console(stderr=True), refresh_per_second=_REFRESH, transient=True
            )
            self._task = self._live.add_task("", total=self._left)

    def __enter__(self) -> Self:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def begins(self, cell: Cell, attempt: int) -> None:
        """A cell is tried for the first or the second time."""
        if self._live:
            again = ", second attempt" if attempt > 1 else ""
            self._live.update(self._task, description=f"[{self._done}/{self._total}] {_name(cell)}{again}")

    def ends(self, cell: Cell, seconds: float) -> None:
        """It was measured, and that took so long."""
        self._over(cell)
        gone = time.monotonic() - self._began
        rest = f", about {duration(gone / self._planned * self._left)} left" if self._left > 0 else ""
        if not self._live:
            self._say(f"{_name(cell)}: {duration(seconds)}{rest}")

    def fails(self, cell: Cell, error: str, *, again: bool) -> None:
        """It could not be measured; ``again``: it is tried once more."""
        if not again:
            self._over(cell)
        self._say(f"{_name(cell)} {'failed, and is tried again' if again else 'failed'}: {last_line(error)}")

    def _over(self, cell: Cell) -> None:
        self._done += 1
        self._planned += cell.seconds
        self._left -= cell.seconds
        if self._live:
            self._live.advance(self._task, cell.seconds)

    def _say(self, text: str) -> None:
        line = f"[{self._done:>{len(str(self._total))}}/{self._total}] {text}"
        if self._live:
            self._live.console.print(line, style="yellow", markup=False, highlight=False)
        else:
            print(line, file=sys.stderr, flush=True)


def _name(cell: Cell) -> str:
    return f"{cell.experiment} {' '.join(f'{name}={value}' for name, value in cell.settings.items())}"


def last_line(error: str) -> str:
    """The line of an error that says most: the last of a traceback, the first of what a bed says."""
    lines = error.splitlines() or [""]
    return printable(lines[-1] if lines[0].startswith("Traceback") else lines[0])
