"""All experiments in a short form on real hosts with real ROS: that they run, and leave what the documents promise.

Not how soon anything was: figures have no place in a verdict on a shared machine.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from lab.experiments.registry import EXPERIMENTS
from lab.experiments.store import Store

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(300)]
ROOT: Final = Path(__file__).parents[2]
# What is enough to see that it works, where the short form has more.
_ONLY: Final = {"control": ("mode=event",), "scaling": ("modules=2",)}
# Those of the suite; the others are of the same shape.
_SHORT: Final = ("control",)
# Tables that must have something in them; of the others, each that there is.
_ROWS: Final = {
    "failure": ("flows", "moments"),
    "scaling": ("joins", "processes", "traffic", "arrivals", "sent"),
    "images": ("commands", "images"),
}


def run(*words: str | Path) -> None:
    """Run it to a good end; none of the hosts that it made is there afterwards."""
    command = subprocess.Popen(
        [sys.executable, "-m", "lab", "experiment", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
    )
    with command:
        try:
            output, _ = command.communicate(timeout=240)
        finally:
            command.terminate()
    assert command.returncode == 0, output
    left = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True, timeout=20).stdout
    assert f"rmpa-{command.pid}-" not in left


@pytest.mark.parametrize(
    "name", [name if name in _SHORT else pytest.param(name, marks=pytest.mark.long) for name in EXPERIMENTS]
)
@pytest.mark.long
def test_an_experiment_measures_both_systems_and_reports(name: str, tmp_path: Path) -> None:
    out = tmp_path / "run"
    only = [word for setting in _ONLY.get(name, ()) for word in ("--only", setting)]
    run("run", name, "--short", "--client", "roscpp", "--out", out, *only)

    store = Store.load(out)
    assert store.names == [name]
    assert not store.records(name, "failed")
    results = store.results(name)
    assert {cell.settings["system"] for cell, _ in results.cells} == {"classic", "rmpa"}
    for cell, measured in results.cells:
        for table in _ROWS.get(name, tuple(measured.tables)):
            assert not measured.tables[table].empty, f"{cell.key}: nothing in {table}"
            assert (out / name / cell.key / f"{table}.csv").is_file()
        assert not measured.tables["lateness"].empty
    manifest = json.loads((out / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["plan"]["size"] == "short"
    assert {"kernel", "cores", "rmpa"} <= manifest["machine"].keys()

    report = out / "report"
    words = (report / "report.md").read_text(encoding="utf-8")
    assert "classic" in words
    assert "RMPA" in words
    drawn = {path.suffix for path in (report / "figures").iterdir()}
    assert drawn == {".png", ".svg"}
    assert "data:image/" in (report / "report.html").read_text(encoding="utf-8")
