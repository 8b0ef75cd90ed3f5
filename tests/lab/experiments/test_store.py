"""A run directory, written and read again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

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
