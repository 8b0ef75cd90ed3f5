"""An experiment that needs no bed, and a stage that is none."""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

from lab.bed.plan import Plan
from lab.experiments.code import Code
from lab.experiments.model import Cell, Measured, Results
from lab.findings import Claim, Findings
from lab.frames import frame

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from lab.bed.stage import Stage

PLAN = Plan(size="short", link="")
CODE = Code(version="1.0", digest="0123456789ab", commit="abc1234")
MACHINE: dict[str, object] = {"cpu": "a cpu", "cores": 2, "kernel": "6.1", "load": (0.1, 0.2, 0.3), "python": "3.11"}


@dataclass
class FakeExperiment:
    """Measures the rate of each cell as the rate of each cell; ``before`` may raise first.

    Args:
        name: Its name.
        rates: One cell a rate and system.
        before: Called with the cell, and how often it was tried with this time.
    """

    name: str = "fake"
    rates: tuple[int, ...] = (10, 20)
    before: Callable[[Cell, int], None] = lambda _cell, _attempt: None
    title: str = "0. Nothing (Fig. 0)"
    about: str = "Measures nothing."
    tried: Counter[str] = field(default_factory=Counter)

    def cells(self, plan: Plan) -> list[Cell]:
        return [
            Cell(self.name, {"system": system, "rate": rate, "round": 1}, seconds=1.0 if plan.short else 4.0)
            for rate in self.rates
            for system in ("classic", "rmpa")
        ]

    def measure(self, cell: Cell, stage: Stage) -> Measured:
        assert stage is not None
        self.tried[cell.key] += 1
        self.before(cell, self.tried[cell.key])
        rate = int(cell.settings["rate"] or 0)
        return Measured({"rates": frame(("topic", "rate"), [("/cmd", rate), ("/vel", rate)])}, {"lost": 0})

    def findings(self, results: Results) -> Findings:
        rates = [float(str(value)) for _, one in results.cells for value in one.tables["rates"]["rate"].tolist()]
        return Findings(claims=(Claim("highest rate", max(rates, default=None), 20.0, unit="Hz"),))


@contextlib.contextmanager
def no_stage(plan: Plan) -> Iterator[Stage]:
    yield cast("Stage", plan)


EXPERIMENT = FakeExperiment()
"""What the registry finds here, once a test has entered this module."""
