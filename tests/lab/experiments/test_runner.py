"""Cells are measured one by one, kept, and gone on with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import BedError
from lab.experiments.progress import Progress
from lab.experiments.runner import ATTEMPTS, Outcome, run, to_measure
from lab.experiments.store import Store
from tests.lab.experiments.fakes import CODE, MACHINE, PLAN, FakeExperiment, no_stage

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from lab.experiments.model import Cell


class Heard(Progress):
    """Writes down what it is told."""

    def __init__(self) -> None:
        super().__init__([])
        self.lines: list[str] = []

    def begins(self, cell: Cell, attempt: int) -> None:
        self.lines.append(f"{cell.key} {attempt}")

    def ends(self, cell: Cell, seconds: float) -> None:
        assert seconds >= 0
        self.lines.append(f"{cell.key} done")

    def fails(self, cell: Cell, error: str, *, again: bool) -> None:
        self.lines.append(f"{cell.key} {'again' if again else 'given up'}: {error.splitlines()[-1]}")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store.create(tmp_path / "run", PLAN, CODE, MACHINE)


def measure(store: Store, *experiments: FakeExperiment, cells: Sequence[Cell] | None = None) -> tuple[Outcome, Heard]:
    heard = Heard()
    jobs = [(one, one.cells(PLAN) if cells is None else cells) for one in experiments]
    return run(jobs, store, no_stage, heard, lateness=lambda seconds: [seconds, 12.34567]), heard


def test_all_cells_are_measured_in_their_order_and_kept(store: Store) -> None:
    outcome, heard = measure(store, FakeExperiment("one"), FakeExperiment("two", rates=(50,)))
    assert outcome == Outcome(6, 0, ())
    assert heard.lines[:4] == [
        "system-classic_rate-10_round-1 1",
        "system-classic_rate-10_round-1 done",
        "system-rmpa_rate-10_round-1 1",
        "system-rmpa_rate-10_round-1 done",
    ]
    again = Store.load(store.directory)
    assert again.names == ["one", "two"]
    assert [tuple(measured.tables["rates"].loc[0]) for _, measured in again.results("one").cells] == [
        ("/cmd", 10),
        ("/cmd", 10),
        ("/cmd", 20),
        ("/cmd", 20),
    ]
    assert all(record.attempts == 1 and record.began for record in again.manifest.cells.values())


def test_a_cell_that_fails_once_is_repeated(store: Store) -> None:
    def shaky(cell: Cell, attempt: int) -> None:
        if cell.settings["rate"] == 20 and attempt == 1:
            raise BedError("the agent said nothing\n    its last line")

    outcome, heard = measure(store, FakeExperiment(before=shaky))
    assert outcome == Outcome(4, 0, ())
    assert heard.lines[4:8] == [
        "system-classic_rate-20_round-1 1",
        "system-classic_rate-20_round-1 again:     its last line",
        "system-classic_rate-20_round-1 2",
        "system-classic_rate-20_round-1 done",
    ]
    record = store.manifest.cells["fake/system-classic_rate-20_round-1"]
    assert (record.state, record.attempts) == ("done", 2)
    assert record.error == "BedError: the agent said nothing\n    its last line"


def test_a_cell_that_fails_again_is_noted_and_the_run_goes_on(store: Store) -> None:
    def broken(cell: Cell, _: int) -> None:
        if cell.key == "system-rmpa_rate-10_round-1":
            raise ZeroDivisionError("of ours")

    experiment = FakeExperiment(before=broken)
    outcome, heard = measure(store, experiment)
    ((name, key, error),) = outcome.failed
    assert (outcome.measured, name, key) == (3, "fake", "system-rmpa_rate-10_round-1")
    assert error.startswith("Traceback")
    assert error.endswith("ZeroDivisionError: of ours")
    assert experiment.tried["system-rmpa_rate-10_round-1"] == ATTEMPTS
    assert heard.lines[-1] == "system-rmpa_rate-20_round-1 done"
    again = Store.load(store.directory)
    assert [one.error for one in again.records("fake", "failed")] == [error]
    assert len(again.results("fake").cells) == 3

    experiment.before = lambda _cell, _attempt: None  # what failed is measured when the run is gone on with
    assert measure(again, experiment)[0] == Outcome(1, 3, ())
    assert not again.records("fake", "failed")
    assert again.manifest.cells["fake/system-rmpa_rate-10_round-1"].error == ""


def test_ctrl_c_leaves_what_was_measured_to_go_on_with(store: Store) -> None:
    def interrupt(cell: Cell, _: int) -> None:
        if cell.settings["rate"] == 20:
            raise KeyboardInterrupt

    experiment = FakeExperiment(before=interrupt)
    with pytest.raises(KeyboardInterrupt):
        measure(store, experiment)
    again = Store.load(store.directory)
    jobs = [(experiment, experiment.cells(PLAN))]
    assert [cell.settings["rate"] for _, cell in to_measure(jobs, again)] == [20, 20]
    assert len(again.records("fake", "planned")) == 2

    experiment.before = lambda _cell, _attempt: None
    experiment.tried.clear()
    assert measure(again, experiment)[0] == Outcome(2, 2, ())
    assert set(experiment.tried) == {"system-classic_rate-20_round-1", "system-rmpa_rate-20_round-1"}
    assert measure(again, experiment)[0] == Outcome(0, 4, ())
