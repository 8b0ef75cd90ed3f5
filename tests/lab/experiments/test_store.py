"""A run directory, written and read again."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import msgspec
import pytest
from pandas.testing import assert_frame_equal

from lab.experiments.model import Cell, Measured
from lab.experiments.store import Store, is_run_directory
from lab.frames import frame
from rmpa.core.errors import ConfigError, StartError
from tests.lab.experiments.fakes import CODE, MACHINE, PLAN, FakeExperiment

if TYPE_CHECKING:
    from pathlib import Path

CELLS = FakeExperiment().cells(PLAN)
MEASURED = Measured(
    {"samples": frame(("topic", "due_ns"), [("/cmd", 1), ("/vel", 2)])},
    {"lost": 3, "worst": 0.5, "fine": True, "why": None},
)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store.create(tmp_path / "run", PLAN, CODE, MACHINE)
    store.expect("fake", "0. Nothing", CELLS)
    return store


def test_what_was_kept_is_read_again(store: Store) -> None:
    store.note(CELLS[2], MEASURED, began="2026-01-01T00:00:00+00:00", seconds=1.5)
    store.note(CELLS[0], MEASURED)
    store.note(CELLS[1], None, attempts=2, error="BedError: no")
    again = Store.load(store.directory)
    assert again.plan == PLAN
    assert again.names == ["fake"]
    assert again.manifest == store.manifest
    assert again.manifest.code == CODE
    results = again.results("fake")
    assert [cell for cell, _ in results.cells] == [CELLS[0], CELLS[2]]  # in the order in which they were planned
    for _, measured in results.cells:
        assert measured.facts == MEASURED.facts
        assert_frame_equal(measured.tables["samples"], MEASURED.tables["samples"])
    assert [(one.settings, one.error, one.attempts) for one in again.records("fake", "failed")] == [
        (CELLS[1].settings, "BedError: no", 2)
    ]
    assert [one.settings for one in again.records("fake", "planned")] == [CELLS[3].settings]
    assert [again.is_done(cell) for cell in CELLS] == [True, False, True, False]


def test_a_cell_counts_once_the_manifest_says_so(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    def cut_off(_: Store) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Store, "save", cut_off)
    with pytest.raises(KeyboardInterrupt):
        store.note(CELLS[0], MEASURED)
    assert not Store.load(store.directory).is_done(CELLS[0])


def test_cells_that_are_known_keep_what_came_of_them(store: Store) -> None:
    store.note(CELLS[0], MEASURED)
    again = Store.load(store.directory)
    more = [*CELLS, Cell("fake", {"system": "rmpa", "rate": 50, "round": 1})]
    again.expect("fake", "0. Nothing", more)
    assert [again.is_done(cell) for cell in more] == [True, False, False, False, False]


def test_a_run_goes_on_with_what_it_was_begun_with(store: Store) -> None:
    busier = {**MACHINE, "load": (2.0, 2.0, 2.0)}
    Store.load(store.directory).require(PLAN, msgspec.structs.replace(CODE, commit="def5678", changed=True), busier)


def test_another_plan_is_refused_by_what_differs(store: Store) -> None:
    with pytest.raises(ConfigError, match=r"was planned otherwise: size short, not full; seed 1, not 7; name a new"):
        store.require(replace(PLAN, size="full", seed=7), CODE, MACHINE)
    with pytest.raises(ConfigError, match=r"link none, not 100mbit"):
        store.require(replace(PLAN, clients=("rospy", "roscpp"), link="100mbit"), CODE, MACHINE)


def test_two_do_not_measure_into_one_directory(store: Store) -> None:
    other = Store.load(store.directory)
    with store.session([]), pytest.raises(StartError, match="another run measures"), other.session([]):
        pass
    with other.session([]):
        pass


def test_a_directory_with_other_things_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(ConfigError, match="is not empty, and no run directory"):
        Store.create(tmp_path, PLAN, CODE, MACHINE)
    assert not is_run_directory(tmp_path)
    with pytest.raises(ConfigError, match="is not empty, and no run directory"):
        Store.create(tmp_path / "thesis.txt", PLAN, CODE, MACHINE)


def test_a_file_that_was_spoiled_is_named(store: Store) -> None:
    store.note(CELLS[0], MEASURED)
    table = store.directory / "fake" / CELLS[0].key / "samples.csv"
    table.write_text("topic,due_ns\n/cmd,soon\n")
    with pytest.raises(ConfigError, match=r"samples\.csv: is not what was measured"):
        store.results("fake")
    table.unlink()
    with pytest.raises(ConfigError, match=r"samples\.csv: cannot be read"):
        store.results("fake")
