"""How long a run still takes, by how long its cells were expected to take and did."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(slots=True)
class Estimate:
    """Counts cells, and the seconds in them.

    Args:
        expected: Seconds that each cell is expected to take, in their order.
    """

    expected: Sequence[float]
    done: int = 0
    """Cells that are over, measured or not."""
    _began: float | None = None
    _planned: float = 0.0
    _taken: float = 0.0
    _total: float = field(init=False)

    def __post_init__(self) -> None:
        self._total = sum(self.expected)

    def begin(self, now: float) -> None:
        """The next cell begins, or is tried again."""
        self._began = now if self._began is None else self._began

    def end(self, now: float) -> None:
        """The cell is over."""
        if self._began is not None:
            self._planned += self.expected[self.done]
            self._taken += now - self._began
        self._began = None
        self.done += 1

    @property
    def pace(self) -> float:
        """Seconds that pass for each that was expected."""
        return self._taken / self._planned if self._planned > 0 else 1.0

    def cell(self, now: float) -> tuple[float, float]:
        """Seconds of the current cell that are gone, and that it takes by what is known; 0, 0 between cells."""
        if self._began is None:
            return 0.0, 0.0
        return now - self._began, self.expected[self.done] * self.pace

    def share(self, now: float) -> float:
        """How much of the whole is over, from 0 to 1; a cell that takes longer than it should counts for no more."""
        if not self._total:
            return 1.0
        gone, takes = self.cell(now)
        current = self.expected[self.done] * min(1.0, gone / takes) if takes > 0 else 0.0
        return min(1.0, (sum(self.expected[: self.done]) + current) / self._total)

    def left(self, now: float) -> float:
        """Seconds until the end."""
        gone, takes = self.cell(now)
        rest = sum(self.expected[self.done + (self._began is not None) :])
        return rest * self.pace + max(0.0, takes - gone)
