"""``scripts/run-tests`` on a small tree of its own: what it reports, and how it exits."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

_SCRIPT = Path(__file__).parents[2] / "scripts" / "run-tests"
_FAILS_ONCE = """
from pathlib import Path

def test_fails_at_its_first_run() -> None:
    mark = Path(__file__).with_name("ran")
    first = not mark.exists()
    mark.touch()
    assert not first
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
    done = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=60)
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
