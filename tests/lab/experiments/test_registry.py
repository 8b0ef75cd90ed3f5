"""The experiments by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.registry import EXPERIMENTS, find_experiment
from lab.experiments.store import Store
from tests.lab.experiments.fakes import CODE, MACHINE

if TYPE_CHECKING:
    from pathlib import Path

PLANS = [
    Plan(),
    Plan(size="short"),
    Plan("short", ("roscpp",), ""),
]


@pytest.mark.parametrize("plan", PLANS)
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_cells_of_each_plan_are_fit_for_a_run_directory(name: str, plan: Plan, tmp_path: Path) -> None:
    found = find_experiment(name)
    cells = found.cells(plan)
    assert cells
    assert {cell.experiment for cell in cells} == {name}
    assert all(cell.settings["system"] in ("classic", "rmpa") for cell in cells)
    assert all(cell.settings["client"] in plan.clients for cell in cells)
    assert all(cell.seconds > 0 for cell in cells)
    assert found.cells(plan) == cells  # by its seed, not by chance
    Store.create(tmp_path / "run", plan, CODE, MACHINE).expect(name, found.title, cells)
