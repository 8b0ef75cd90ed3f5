"""``python -m lab experiment``, with an experiment and a bed that cost nothing (the real ones: tests/interop)."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, cast

import pytest

from lab.__main__ import main
from lab.bed import stage
from lab.bed.processes import BedError
from lab.experiments import code, runner
from lab.experiments.registry import EXPERIMENTS
from lab.experiments.store import Store
from tests.lab.experiments import fakes
from tests.lab.experiments.fakes import FakeExperiment

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.experiments.model import Cell

DEADLINE = 60.0
ROOT = Path(__file__).parents[3]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[FakeExperiment]:
    """The only experiment that there is, on a bed that has all it needs."""

    table = cast("dict[str, tuple[str, str]]", EXPERIMENTS)
    before = dict(table)
    table.clear()
    table["fake"] = ("tests.lab.experiments.fakes", "nothing at all")
    monkeypatch.setattr(fakes, "EXPERIMENT", FakeExperiment())
    monkeypatch.setattr(stage, "why_not", lambda: "")
    monkeypatch.setattr(stage, "make_stage", fakes.no_stage)
    monkeypatch.setattr(runner, "LATENESS_SECONDS", 0.01)
    monkeypatch.setattr(code, "code_here", lambda: fakes.CODE)  # whoever edits the package while tests run
    monkeypatch.chdir(tmp_path)
    yield fakes.EXPERIMENT
    table.clear()
    table.update(before)


def lab(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    code = main(["experiment", *words])
    out, err = capsys.readouterr()
    return code, out, err


def test_a_run_measures_and_writes_its_report(
    fake: FakeExperiment, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    code, out, err = lab(capsys, "run", "--short", "--out", "mine")
    assert code == 0, err
    lines = out.splitlines()
    assert lines[:2] == [
        "hosts as network namespaces, cables of 100 Mbit/s, nodes of rospy and roscpp, short; 4 cells, about 4.0 s",
        "into mine",
    ]
    assert "fake        reached     20 Hz  ≤ 20 Hz      -  highest rate" in lines
    assert f"report: {Path('mine/report/report.html')}" in lines
    assert "[4/4] fake system=rmpa rate=20 round=1:" in err
    assert err.count(" left\n") == 3  # behind the last one nothing is left to wait for
    store = Store.load(tmp_path / "mine")
    assert store.plan.size == "short"
    assert [session.end for session in store.manifest.sessions] == ["finished"]
    assert store.manifest.sessions[0].argv[:3] == ["python", "-m", "lab"]
    assert (tmp_path / "mine" / "report" / "report.html").exists()
    assert (tmp_path / "mine" / "report" / "report.md").exists()


def test_a_run_goes_on_with_what_is_missing_as_it_was_begun(
    fake: FakeExperiment, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, _ = lab(capsys, "run", "fake", "--short", "--seed", "7", "--out", "mine", "--only", "system=rmpa")
    assert code == 0
    code, out, _ = lab(capsys, "run", "--out", "mine")  # short and its seed are the run's
    assert code == 0
    assert "short; 2 cells" in out
    assert set(fake.tried.values()) == {1}
    assert len(fake.tried) == 4
    code, _, err = lab(capsys, "run", "--out", "mine", "--seed", "8")
    assert (code, err) == (2, "lab: --out: mine was planned otherwise: seed 7, not 8; name a new directory\n")


def test_what_failed_is_told_and_the_exit_code_is_1(fake: FakeExperiment, capsys: pytest.CaptureFixture[str]) -> None:
    def broken(cell: Cell, _: int) -> None:
        if cell.settings["system"] == "rmpa" and cell.settings["rate"] == 20:
            raise BedError("the agent said nothing\n    rmpa up| its last line")

    fake.before = broken
    code, out, err = lab(capsys, "run", "--short", "--out", "mine")
    assert code == 1
    assert "report: " in out
    assert "fake system=rmpa rate=20 round=1 failed, and is tried again: BedError: the agent said nothing" in err
    assert "! fake system-rmpa_rate-20_round-1 could not be measured: BedError: the agent said nothing\n" in err
    said = json.loads(lab(capsys, "run", "--out", "mine", "--json")[1])
    assert [(one["experiment"], one["cell"]) for one in said["failed"]] == [("fake", "system-rmpa_rate-20_round-1")]
    assert said["there"] == 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["run", "fkae"], "fkae: no such experiment; did you mean fake?"),
        (["run", "--only", "rat=10"], "--only: no cell has a setting 'rat'; did you mean rate?"),
        (["run", "--only", "rate=10", "--only", "system=rmpa", "--link", "fast"], "--link: 'fast' is no rate"),
        (["report", "nowhere"], "nowhere: is no run directory"),
        (["compare", "nowhere", "nowhere"], "nowhere: is no run directory"),
    ],
)
def test_what_cannot_be_is_said_and_leaves_nothing_behind(
    fake: FakeExperiment, capsys: pytest.CaptureFixture[str], tmp_path: Path, words: list[str], said: str
) -> None:
    code, out, err = lab(capsys, *words)
    assert (code, out) == (2, "")
    assert said in err
    assert not list(tmp_path.iterdir())


def test_two_runs_are_compared(fake: FakeExperiment, capsys: pytest.CaptureFixture[str]) -> None:
    lab(capsys, "run", "--short", "--out", "a")
    fake.rates = (10, 40)
    lab(capsys, "run", "--short", "--seed", "2", "--out", "b")
    code, out, _ = lab(capsys, "compare", "a", "b")
    assert code == 0
    (row,) = (line.split() for line in out.splitlines() if line.startswith("fake"))
    assert row == ["fake", "highest", "rate", "20", "Hz", "40", "Hz", "2"]
    (differs,) = (line.split() for line in out.splitlines() if "seed" in line)
    assert differs[-2:] == ["1", "2"]
    said = json.loads(lab(capsys, "compare", "a", "b", "--json")[1])
    assert (said["claims"][0]["a"], said["claims"][0]["b"], said["claims"][0]["ratio"]) == (20.0, 40.0, 2.0)


PROGRAM = """
import sys, threading
from lab.__main__ import main
from lab.experiments import code
from lab.bed import stage
from lab.experiments.registry import EXPERIMENTS
from tests.lab.experiments import fakes

def wait(cell, attempt):
    if cell.settings["rate"] == 20:
        print("waiting", flush=True)
        threading.Event().wait()

EXPERIMENTS.clear()
EXPERIMENTS["fake"] = ("tests.lab.experiments.fakes", "nothing")
fakes.EXPERIMENT.before = wait
code.code_here = lambda: fakes.CODE
stage.why_not, stage.make_stage = (lambda: ""), fakes.no_stage
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_a_run_to_go_on_with(
    fake: FakeExperiment, capsys: pytest.CaptureFixture[str], tmp_path: Path, number: signal.Signals
) -> None:
    words = ["experiment", "run", "fake", "--short", "--out", "a b"]
    with subprocess.Popen(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{PROGRAM}", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line == "waiting\n":
                break
        process.send_signal(number)
        _, err = process.communicate(timeout=DEADLINE)
    assert process.returncode == 130, err
    assert err.endswith("! interrupted; go on with: python -m lab experiment run fake --out 'a b'\n")
    assert "Traceback" not in err
    assert [session.end for session in Store.load(tmp_path / "a b").manifest.sessions] == ["interrupted"]
    code, out, _ = lab(capsys, "run", "fake", "--out", "a b")
    assert code == 0
    assert "short; 2 cells" in out
    assert set(fake.tried) == {"system-classic_rate-20_round-1", "system-rmpa_rate-20_round-1"}
