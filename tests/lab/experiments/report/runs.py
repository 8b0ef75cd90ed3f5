"""Run directories made by hand, of an experiment whose findings are known."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from lab.bed.plan import Plan
from lab.experiments.code import Code
from lab.experiments.model import Cell, Measured, Results
from lab.experiments.store import Store
from lab.findings import Claim, Figure, Findings, Grid, Panel, Series
from lab.frames import frame
from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from lab.bed.stage import Stage

MACHINE = {"cpu": "Some | CPU", "cores": 2, "kernel": "6.1", "load": [0.5, 0.2, 0.1]}


@dataclass
class Latencies:
    """An experiment whose finding is the largest latency of each system."""

    name: str = "rates"
    title: str = "2. Latency against rate (Fig. 10)"
    about: str = "Messages are **counted**."
    broken: bool = False

    def cells(self, plan: Plan) -> list[Cell]:
        return [Cell(self.name, {"system": system, "round": 1}) for system in ("classic", "rmpa")]

    def measure(self, cell: Cell, stage: Stage) -> Measured:
        raise NotImplementedError  # nothing is measured here

    def findings(self, results: Results) -> Findings:
        if self.broken:
            raise ZeroDivisionError("made so")
        series = tuple(
            Series(
                str(cell.settings["system"]), [10.0] * 3, _latencies(measured), "box", str(cell.settings["system"])
            )
            for cell, measured in results.cells
        )
        panel = Panel("latency", "rate, Hz", "latency, ms", series)
        tops = [max(one.y) for one in series]
        return Findings(
            figures=(Figure("fig-10-rates", "Fig. 10: latency | rate", "Lower is better.", (panel,)),),
            grids=(Grid("Table", ("system", "largest"), [("classic", "1.5"), ("RMPA", "2")], "A note."),),
            claims=(
                Claim("largest of RMPA / classic", tops[-1] / tops[0], 1.1, paper=1.9),
                Claim("R² of the fit", None, 0.99, at_least=True),
                Claim("largest of RMPA", tops[-1], 5.0, unit="ms"),
            ),
            notes=("Look at the p99.",),
        )


def _latencies(measured: Measured) -> list[float]:
    return [float(str(value)) for value in measured.tables["arrivals"]["late_ms"].tolist()]


@dataclass
class Known:
    """Finds experiments by name in place of the registry."""

    experiments: Mapping[str, Latencies] = field(default_factory=lambda: {"rates": Latencies()})

    def __call__(self, name: str) -> Latencies:
        if name not in self.experiments:
            raise ConfigError(name, "no such experiment")
        return self.experiments[name]


def make_run(
    directory: Path,
    *,
    plan: Plan | None = None,
    largest: float = 3.0,
    names: tuple[str, ...] = ("rmpa", "classic"),
    experiment: str = "rates",
    fail: bool = False,
    machine: Mapping[str, object] | None = None,
) -> Path:
    """Make a run directory; ``largest`` is RMPA's largest latency in ms, classic's is 1.5."""
    asked = Latencies(experiment)
    code = Code(version="0.1.0", digest="abc", commit="1234567")
    store = Store.create(directory, plan or Plan(), code, machine or MACHINE)
    cells = asked.cells(store.plan)
    with store.session(["rmpa", "experiment", "run", "--out", "a run"]):
        store.expect(experiment, asked.title, cells)
        for cell in cells:
            if cell.settings["system"] not in names:
                continue
            top = largest if cell.settings["system"] == "rmpa" else 1.5
            table = frame(("sequence", "late_ms"), [(0, 1.0), (1, top), (2, 1.25)])
            late = frame(("when", "late_us"), [("before", 60.0), ("after", 75.5)] * 10)
            store.note(cell, Measured({"arrivals": table, "lateness": late}), seconds=3.0)
        if fail:
            store.note(cells[0], None, attempts=2, error="no answer <script>")
    return directory
