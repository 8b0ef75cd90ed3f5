"""Which code measured."""

from __future__ import annotations

import subprocess
from typing import TYPE_CHECKING

import pytest

from lab.experiments.code import code_here, digest

if TYPE_CHECKING:
    from pathlib import Path


def package(root: Path) -> Path:
    where = root / "rmpa"
    (where / "cli").mkdir(parents=True)
    (where / "experiments" / "report").mkdir(parents=True)
    (where / "__init__.py").write_text("")
    (where / "mesh.py").write_text("x = 1\n")
    return where


def git(where: Path, *words: str) -> str:
    who = ["-c", "user.name=x", "-c", "user.email=x@example.org"]
    return subprocess.run(
        ["git", "-C", where, *who, *words], capture_output=True, text=True, check=True
    ).stdout.strip()


def test_the_digest_changes_with_what_measures_and_not_with_what_shows(tmp_path: Path) -> None:
    where = package(tmp_path)
    before = digest(where)
    (where / "cli" / "main.py").write_text("x = 2\n")
    (where / "experiments" / "report" / "html.py").write_text("x = 2\n")
    (where / "__pycache__").mkdir()
    (where / "__pycache__" / "mesh.pyc").write_bytes(b"x")
    assert digest(where) == before
    (where / "mesh.py").write_text("x = 2\n")
    changed = digest(where)
    assert changed != before
    (where / "mesh.py").rename(where / "bridge.py")
    assert digest(where) not in (before, changed)


@pytest.mark.git
def test_what_is_measured_counts_as_what_measures_does(tmp_path: Path) -> None:
    measures, measured = package(tmp_path / "lab"), package(tmp_path / "src")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "x")
    before = code_here(measures, measured)
    (measured / "mesh.py").write_text("x = 2\n")
    after = code_here(measures, measured)
    assert (before.changed, after.changed) == (False, True)
    assert before.digest != after.digest
