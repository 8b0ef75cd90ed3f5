"""What RMPA says first under a Python that it cannot run with: one line that says what is so and what to do."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Final

import pytest

_ROOT: Final = Path(__file__).parents[2]
_OLD: Final = ("2.7", "3.6", "3.8", "3.10")


def python(version: str) -> str:
    """The program of a Python: on PATH, or pyenv's."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for found in (shutil.which(f"python{version}"), *pyenv.glob(f"{version}.*/bin/python")):
        # A shim of pyenv is there for versions that are not chosen, too.
        if found and subprocess.run([found, "-c", ""], capture_output=True, check=False).returncode == 0:
            return str(found)
    pytest.skip(f"there is no Python {version}")


def run(*command: str | Path, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", **variables}
    return subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False, timeout=50)


@pytest.mark.parametrize("version", _OLD)
def test_a_clone_on_the_path_of_an_older_python(tmp_path: Path, version: str) -> None:
    old = python(version)
    done = run(old, "-m", "rmpa", "up", cwd=tmp_path, PYTHONPATH=str(_ROOT / "src"))
    said = done.stderr.splitlines()
    assert done.returncode == 1
    assert re.search(rf"rmpa needs Python 3.11 or later, and /\S+ is {version}\.", said[-1])
    assert "docs/start/install.md" in said[-1]
    assert len(said) == 1 or version == "2.7"  # its runpy adds a traceback
    caught = "try: import rmpa.resource\nexcept ImportError as error: print(error)"
    done = run(old, "-c", caught, cwd=tmp_path, PYTHONPATH=str(_ROOT / "src"))
    assert done.stdout.strip() in said[-1]
    assert done.stdout.startswith("rmpa needs")


@pytest.mark.parametrize("version", ["3.8", "3.10"])
def test_pip_of_an_older_python_in_a_clone(tmp_path: Path, version: str) -> None:
    options = "--disable-pip-version-check", "--no-build-isolation", "--no-index", "--target", tmp_path
    done = run(python(version), "-m", "pip", "install", *options, _ROOT, cwd=tmp_path)
    assert done.returncode == 1
    assert f"rmpa needs Python 3.11 or later, and this is {version}." in done.stderr
    assert "docs/start/install.md" in done.stderr


def test_pip_of_an_older_python_does_not_look_for_our_libraries() -> None:
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for requirement in (*project["dependencies"], *extras["web"], *extras["zenoh"], *extras["trust"]):
        assert requirement.endswith("; python_version>='3.11'")


def test_the_package_is_the_program(tmp_path: Path) -> None:
    assert run(sys.executable, "-m", "rmpa", "--version", cwd=tmp_path).stdout.startswith("rmpa ")
