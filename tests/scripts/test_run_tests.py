"""``scripts/run-tests`` on a small tree of its own: what it reports, and how it exits."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

_SCRIPT = Path(__file__).parents[2] / "scripts" / "run-tests"
_FAILS_ONCE = """
from pathlib import Path

def test_fails_at_its_first_run() -> None:
    mark = Path(__file__).with_name("ran")
    first = not mark.exists()
    mark.touch()
    assert not first
"""


_WAITS_FOR_THE_OTHER = """
import time
from pathlib import Path

def test_the_other_part_runs_now() -> None:
    here = Path(__file__).parent
    here.joinpath("runs").touch()
    deadline = time.monotonic() + 40
    while not all(other.joinpath("runs").exists() for other in (here.parent / "one", here.parent / "two")):
        assert time.monotonic() < deadline
        time.sleep(0.01)
"""
_FAILED = "FAILED tests/shaky/test_it.py::test_fails_at_its_first_run - assert not True"


def _run(root: Path, **files: str) -> tuple[int, list[str]]:
    """Run a copy of the script over ``tests/NAME/test_it.py`` for each name; return its exit code and its lines."""
    script = root / "scripts" / "run-tests"
    script.parent.mkdir()
    shutil.copy(_SCRIPT, script)
    for name, text in files.items():
        folder = root / "tests" / name
        folder.mkdir(parents=True)
        (folder / "test_it.py").write_text(text)
    argv = [sys.executable, str(script), sys.executable, "-j", "1"]
    env = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=60, env=env)
    return done.returncode, done.stdout.splitlines()


def test_a_part_that_passes_alone_is_named_as_flaky(tmp_path: Path) -> None:
    code, lines = _run(tmp_path, shaky=_FAILS_ONCE, steady="def test_passes() -> None: pass")
    assert code == 0
    at = lines.index("flaky: tests/shaky (failed, then passed alone)")
    assert "0 of 2 parts failed, 1 flaky" in lines[at - 1]
    assert lines[at + 1 :] == ["      E       assert not True", f"      {_FAILED}"], "what failed, and why"


def test_a_part_that_fails_twice_fails_the_run(tmp_path: Path) -> None:
    code, lines = _run(tmp_path, broken="def test_fails() -> None: assert False")
    assert code == 1
    assert "1 of 1 parts failed, 0 flaky" in lines[-1]


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one processor: one part computes at a time")
def test_lanes_without_parts_of_their_own_take_those_that_compute(tmp_path: Path) -> None:
    code, lines = _run(tmp_path, one=_WAITS_FOR_THE_OTHER, two=_WAITS_FOR_THE_OTHER)
    assert code == 0, lines


def test_bytecode_is_kept_and_processor_time_is_shown(tmp_path: Path) -> None:
    code, lines = _run(
        tmp_path,
        one="import sys, time\ndef test_it() -> None:\n"
        "    while time.process_time() < 1.0: pass\n    assert not sys.dont_write_bytecode",
    )
    assert code == 0, lines
    shown = re.search(r"ok +[0-9.]+ s +([0-9.]+) s cpu  tests/one", lines[0])
    assert shown is not None, lines
    assert float(shown[1]) >= 1.0
    assert re.search(r"processors busy \d+% of it$", lines[-1])
