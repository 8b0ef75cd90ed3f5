"""Programs of rmpa start each other as deaf as they are; PYTHONPATH is searched last."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

PROGRAM = "from rmpa.runtime.interpreter import own_command; print(*own_command('web', '--port', '1'))"


@pytest.mark.parametrize(("given", "flag"), [("-I", "-I"), ("-P", "-P"), ("-B", "-P")])
def test_another_program_is_as_deaf(given: str, flag: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, given, "-c", PROGRAM], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [sys.executable, flag, "-m", "rmpa", "web", "--port", "1"]


def test_what_python_path_names_is_found_after_all_else(tmp_path: Path) -> None:
    for name in ("json", "mine"):
        (tmp_path / f"{name}.py").write_text(f"print({name!r}, 'of PYTHONPATH')\n")
    program = "import rmpa.cli, json, os, mine; print(os.environ['PYTHONPATH'])"
    environ = {"PYTHONPATH": f"{tmp_path}:"}
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, cwd="/", env=environ, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["mine of PYTHONPATH", f"{tmp_path}:"]
