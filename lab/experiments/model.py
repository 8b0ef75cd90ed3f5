"""What an experiment is made of: cells that are measured one by one, their samples, and what follows from them.

All of it is data. Who measures (``control``, ``rates``, …) knows nothing of files or pictures; ``store`` keeps what
was measured, ``report`` draws and writes what was found.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from lab.bed.system import Stage

Value = str | int | float | bool | None
"""What a setting or a cell of a table may be."""
Size = Literal["short", "full"]
Client = Literal["rospy", "roscpp", "own"]
"""Whose nodes: those of the two ROS client libraries, or our own where ROS is not installed."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What a run was asked for.

    Args:
        size: ``full`` for figures to quote; ``short`` to see in a minute or two that everything works.
        bed: ``namespaces``: hosts with real ROS; ``loopback``: all on this machine with our own nodes and core.
        clients: Whose nodes take part.
        link: What each host's cable carries, as ``tc`` writes it (``100mbit``); empty for unshaped.
        seed: Of all that is left to chance (the order of cells, phases).
    """

    size: Size = "full"
    bed: Literal["namespaces", "loopback"] = "namespaces"
    clients: tuple[Client, ...] = ("rospy", "roscpp")
    link: str = "100mbit"
    seed: int = 1

    @property
    def short(self) -> bool:
        """Whether this is only to see that everything works."""
        return self.size == "short"


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
class Table:
    """Samples as they were taken: one row a message, a second, a process.

    Args:
        columns: Names with their unit: ``("topic", "sequence", "due_ns", "came_ns")``.
        rows: As many values each.
    """

    columns: tuple[str, ...]
    rows: Sequence[tuple[Value, ...]]

    def column(self, name: str) -> list[Value]:
        """One column's values.

        Raises:
            ValueError: There is no such column.
        """
        at = self.columns.index(name)
        return [row[at] for row in self.rows]


@dataclass(frozen=True, slots=True)
class Measured:
    """What came of one cell.

    Args:
        tables: Raw samples by name; each becomes a CSV file.
        facts: Single values: what was lost, what a process used; they go to the manifest.
    """

    tables: Mapping[str, Table] = field(default_factory=dict)
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


# --- what follows ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Series:
    """One set of points in a panel.

    Args:
        label: For the legend.
        x: In the panel's unit.
        y: As many.
        style: ``points`` for samples, ``line``, ``steps`` for a distribution function, ``bars``; ``spans`` for thick
            horizontal bars, one for each pair of points: ``x`` where it begins and ends, ``y`` its row, twice;
            ``box`` for samples ``y`` grouped by their ``x`` (quartiles, p5 to p95, p99), groups equally far apart.
        system: Decides the colour, the same in all figures: ``classic``, ``rmpa`` or something else.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    style: Literal["points", "line", "steps", "bars", "spans", "box"] = "points"
    system: str = ""


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes.

    Args:
        title: Above it.
        xlabel: With the unit.
        ylabel: With the unit.
        series: What is drawn.
        logx: A logarithmic axis.
        logy: Likewise.
        marks: Horizontal lines by what they say: ``{"to reach": 1.0}``.
        moments: Vertical lines likewise: ``{"pc killed": 0.0}``.
        names: What ``y`` = 0, 1, 2 … are called, from the top down, in place of numbers.
        ticks: What stands below the horizontal axis in place of numbers: ``{"1 KB": 1024.0}``.
        distribution: Draw beside it how often its points have which ``y``, on the same axis.
    """

    title: str
    xlabel: str
    ylabel: str
    series: tuple[Series, ...]
    logx: bool = False
    logy: bool = False
    marks: Mapping[str, float] = field(default_factory=dict)
    moments: Mapping[str, float] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    ticks: Mapping[str, float] = field(default_factory=dict)
    distribution: bool = False


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture of the report; the sleep-lateness histogram of its cells is drawn beside it by the report.

    Args:
        name: Its file's: ``fig-10-rates``.
        title: Above it, with the paper's number.
        caption: What is to be seen.
        panels: From left to right.
        columns: How many stand side by side, the next ones below them; 0: as it fits. Those below each other share
            their horizontal axis if they have the same label there.
    """

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    columns: int = 0


@dataclass(frozen=True, slots=True)
class Grid:
    """A table of the report, ready to read.

    Args:
        title: With the paper's number.
        columns: Heads.
        rows: As many texts each.
        note: Below it.
    """

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Claim:
    """A figure that is held against what it should be.

    Args:
        text: What should hold: ``period sd of CMD, RMPA / classic``.
        value: What came out; ``None`` where the samples are too few to say.
        limit: What it may be at the most, or at the least.
        at_least: Which of the two.
        unit: Of both; empty for a ratio.
        paper: What the paper had, if it had it.
    """

    text: str
    value: float | None
    limit: float
    at_least: bool = False
    unit: str = ""
    paper: float | None = None

    @property
    def reached(self) -> bool | None:
        """Whether it holds; ``None`` if nobody knows."""
        if self.value is None:
            return None
        return self.value >= self.limit if self.at_least else self.value <= self.limit


@dataclass(frozen=True, slots=True)
class Findings:
    """What the report says of one experiment."""

    figures: tuple[Figure, ...] = ()
    grids: tuple[Grid, ...] = ()
    claims: tuple[Claim, ...] = ()
    notes: tuple[str, ...] = ()


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
