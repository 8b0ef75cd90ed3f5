"""A run directory, written and read again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from pandas.testing import assert_frame_equal

from lab.experiments.model import Measured
from lab.experiments.store import Store
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


def test_two_do_not_measure_into_one_directory(store: Store) -> None:
    other = Store.load(store.directory)
    with store.session([]), pytest.raises(StartError, match="another run measures"), other.session([]):
        pass
    with other.session([]):
        pass


def test_a_file_that_was_spoiled_is_named(store: Store) -> None:
    store.note(CELLS[0], MEASURED)
    table = store.directory / "fake" / CELLS[0].key / "samples.csv"
    table.write_text("topic,due_ns\n/cmd,soon\n")
    with pytest.raises(ConfigError, match=r"samples\.csv: is not what was measured"):
        store.results("fake")
    table.unlink()
    with pytest.raises(ConfigError, match=r"samples\.csv: cannot be read"):
        store.results("fake")
