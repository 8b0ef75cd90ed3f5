"""``scripts/run-tests`` on a small tree of its own: what it reports, and how it exits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

_SCRIPT = Path(__file__).parents[2] / "scripts" / "run-tests"
_FAILS_ONCE = """
from pathlib import Path

def test_fails_at_its_first_run():
    mark = Path(__file__).with_name("ran")
    first = not mark.exists()
    mark.touch()
    assert not first
"""
_ALONE = """
import os, pytest

@pytest.mark.alone
def test_measures():
    assert "PYTEST_XDIST_WORKER" not in os.environ
"""
_PASSES = "def test_passes(): pass"


@pytest.mark.parametrize(
    ("texts", "code", "said"),
    [
        ([_PASSES, _ALONE], 0, "1 passed"),
        ([_PASSES, _FAILS_ONCE], 0, "PASSED test_1.py::test_fails_at_its_first_run"),
        ([_PASSES, "def test_fails(): assert False"], 1, "FAILED test_1.py::test_fails"),
        ([_FAILS_ONCE, "import nothing_of_this_name"], 2, "nothing_of_this_name"),
    ],
    ids=["passes", "flaky", "fails twice", "cannot be read"],
)
def test_run(tmp_path: Path, texts: list[str], code: int, said: str) -> None:
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = alone\n")
    for number, text in enumerate(texts):
        (tmp_path / f"test_{number}.py").write_text(text)
    env = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    done = subprocess.run(
        [_SCRIPT, sys.executable, "1"], cwd=tmp_path, env=env, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == code, done.stdout
    assert said in done.stdout
