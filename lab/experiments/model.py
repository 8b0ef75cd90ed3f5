"""An experiment as data: cells that are measured one by one, and their samples.

The experiments (``control``, ``rates``, …) know nothing of files or pictures: ``store`` keeps the samples, ``report``
draws and writes the findings (``lab.findings``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pandas import DataFrame

    from lab.bed.plan import Plan
    from lab.bed.stage import Stage
    from lab.findings import Findings

# What a setting or a cell of a table may be.
Value = str | int | float | bool | None


@dataclass(frozen=True, slots=True)
class Cell:
    """What is measured in one go. Its settings decide everything about it: two equal ones are the same measurement.

    Args:
        experiment: The name of the experiment.
        settings: By name, in the order in which a reader wants them: ``{"system": "rmpa", "rate": 10, "round": 1}``.
        seconds: About how long it takes, for the progress bar.
    """

    experiment: str
    settings: Mapping[str, Value]
    seconds: float = 5.0

    @property
    def key(self) -> str:
        """Its name within the experiment, fit for a file's: ``system-rmpa_rate-10_round-1``."""
        return "_".join(f"{name}-{value}" for name, value in self.settings.items())


@dataclass(frozen=True, slots=True)
class Measured:
    """The measured samples of one cell.

    Args:
        tables: Raw samples by name (``lab.frames``); each becomes a CSV file.
        facts: Single values: what was lost, what a process used; they go to the manifest.
    """

    tables: Mapping[str, DataFrame] = field(default_factory=dict)
    facts: Mapping[str, Value] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Results:
    """All that was measured of one experiment.

    Args:
        plan: What was asked for.
        cells: What came, by cell; one that failed is not in it.
    """

    plan: Plan
    cells: Sequence[tuple[Cell, Measured]]

    def select(self, **settings: Value) -> Iterator[tuple[Cell, Measured]]:
        """The cells that have these settings."""
        for cell, measured in self.cells:
            if all(cell.settings.get(name) == value for name, value in settings.items()):
                yield cell, measured


class Experiment(Protocol):
    """One experiment."""

    @property
    def name(self) -> str:
        """As the command line has it: ``control``."""
        ...

    @property
    def title(self) -> str:
        """With the paper's figure: ``1. Rates and control delay (Figs. 8 and 9, Table 1)``."""
        ...

    @property
    def about(self) -> str:
        """What is measured, and how, in Markdown."""
        ...

    def cells(self, plan: Plan) -> list[Cell]:
        """What is to be measured, in an order in which the systems take turns."""
        ...

    def measure(self, cell: Cell, stage: Stage) -> Measured:
        """Measure one cell.

        Raises:
            BedError: Something that takes part did not do what it should.
        """
        ...

    def findings(self, results: Results) -> Findings:
        """Say what follows; cells may be missing."""
        ...
