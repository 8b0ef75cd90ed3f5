"""How a run goes: two bars on a terminal, one line a cell anywhere else. All of it on stderr."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from lab.experiments.estimate import Estimate
from rmpa.cli.output import duration, printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from rich.console import Console
    from rich.table import Table

    from lab.experiments.model import Cell
    from lab.experiments.runner import Watcher

_REFRESH: Final = 1.0
"""Times a second that the bars are drawn anew: seldom, for the machine is being measured."""


@contextmanager
def watching(cells: Sequence[Cell]) -> Iterator[Watcher]:
    """Show how it goes while these cells are measured."""
    estimate = Estimate([cell.seconds for cell in cells])
    if not sys.stderr.isatty():
        yield Lines(estimate, _write)
        return
    from rich.console import Console
    from rich.live import Live

    console = Console(stderr=True)
    bars = Bars(estimate, console)
    with Live(get_renderable=bars.render, console=console, refresh_per_second=_REFRESH, transient=True):
        yield bars


class Lines:
    """One line for each cell that is over.

    Args:
        estimate: Of the cells' times.
        write: Takes each line.
        now: The clock, in seconds.
    """

    def __init__(
        self, estimate: Estimate, write: Callable[[str], None], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._estimate = estimate
        self._write = write
        self._now = now

    def cell_begins(self, cell: Cell, attempt: int) -> None:  # noqa: ARG002 - the watcher's signature
        """Count the seconds from here."""
        self._estimate.begin(self._now())

    def cell_ends(self, cell: Cell, seconds: float) -> None:
        """Say that it is done, and how long the rest takes."""
        self._estimate.end(self._now())
        self._write(f"{self._count()} {_name(cell)}: {duration(seconds)}{self._rest()}")

    def cell_fails(self, cell: Cell, error: str, *, again: bool) -> None:
        """Say why."""
        if not again:
            self._estimate.end(self._now())
        what = "failed, and is tried again" if again else "failed"
        self._write(f"{self._count()} {_name(cell)} {what}: {last_line(error)}")

    def _count(self) -> str:
        total = len(self._estimate.expected)
        return f"[{self._estimate.done:>{len(str(total))}}/{total}]"

    def _rest(self) -> str:
        left = self._estimate.left(self._now())
        return f", about {duration(left)} left" if left else ""


class Bars:
    """The whole run, and the cell that is being measured.

    Args:
        estimate: Of the cells' times.
        console: Where failures are said, above the bars.
        now: The clock, in seconds.
    """

    def __init__(self, estimate: Estimate, console: Console, now: Callable[[], float] = time.monotonic) -> None:
        self._estimate = estimate
        self._console = console
        self._now = now
        self._began = now()
        self._cell: Cell | None = None
        self._attempt = 1

    def cell_begins(self, cell: Cell, attempt: int) -> None:
        """Show it."""
        self._estimate.begin(self._now())
        self._cell, self._attempt = cell, attempt

    def cell_ends(self, cell: Cell, seconds: float) -> None:  # noqa: ARG002 - the watcher's signature
        """Count it."""
        self._estimate.end(self._now())
        self._cell = None

    def cell_fails(self, cell: Cell, error: str, *, again: bool) -> None:
        """Say why, above the bars."""
        if not again:
            self._estimate.end(self._now())
            self._cell = None
        what = "failed, and is tried again" if again else "failed"
        self._console.print(
            f"! {_name(cell)} {what}: {last_line(error)}", style="yellow", markup=False, highlight=False
        )

    def render(self) -> Table:
        """The bars as they are now."""
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        now, estimate, cell = self._now(), self._estimate, self._cell
        table = Table.grid(padding=(0, 1))
        table.add_column(no_wrap=True)
        table.add_column(width=24)
        table.add_column(no_wrap=True, overflow="ellipsis")
        gone, takes = estimate.cell(now)
        table.add_row(
            Text("all", style="bold"),
            ProgressBar(100.0, 100 * estimate.share(now), width=24),
            Text(
                f"{estimate.done} of {len(estimate.expected)} cells, {duration(now - self._began)}, "
                f"about {duration(estimate.left(now))} left"
            ),
        )
        if cell is not None:
            again = ", second attempt" if self._attempt > 1 else ""
            settings = " ".join(f"{name}={value}" for name, value in cell.settings.items())
            table.add_row(
                Text(cell.experiment, style="bold"),
                ProgressBar(100.0, 100 * min(1.0, gone / takes) if takes else 0.0, width=24),
                Text(f"{duration(gone)} of about {duration(takes)}{again}: {settings}"),
            )
        return table


def _name(cell: Cell) -> str:
    return f"{cell.experiment} {' '.join(f'{name}={value}' for name, value in cell.settings.items())}"


def last_line(error: str) -> str:
    """The line of an error that says most: the last of a traceback, the first of what a bed says."""
    lines = error.splitlines() or [""]
    return printable(lines[-1] if lines[0].startswith("Traceback") else lines[0])


def _write(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
