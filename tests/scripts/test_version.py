"""The version comes from the tag, with and without git, and each way of building writes it down."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

import rmpa

ROOT = Path(__file__).parents[2]
ENVIRONMENT: Final = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}


def run(*command: str | Path, folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def version(tree: Path, *options: str) -> str:
    return run(sys.executable, tree / "scripts/version", *options, folder=tree)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """What a build needs of this repository, without git."""
    tree = tmp_path / "clone"
    for name in ("scripts/version", "src/rmpa/__init__.py", "src/rmpa/cli/__init__.py", "README.md", "setup.py"):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tree / name)
    for name in ("pyproject.toml", "MANIFEST.in"):
        shutil.copy(ROOT / name, tree)
    return tree


@pytest.fixture
def git(tree: Path) -> Callable[..., str]:
    def git(*words: str) -> str:
        me = "-c", "user.name=a", "-c", "user.email=a@example.invalid", "-c", "commit.gpgsign=false"
        return run("git", *me, *words, folder=tree)

    git("init", "-q")
    (tree / ".gitignore").write_text("__pycache__\n*.egg-info\nbuild\n")
    git("add", ".")
    git("commit", "-qm", "one")
    return git


def test_a_tree_without_git_is_on_its_way_to_the_next_release(tree: Path) -> None:
    run("git", "init", "-q", folder=tree.parent)  # somebody else's repository around it
    assert version(tree, "--long") == version(tree) == "0.2.0.dev0"
    assert version(tree, "--deb") == "0.2.0~dev0"


def test_the_next_release_is_what_the_changelog_begins_with() -> None:
    text = (ROOT / "src/rmpa/__init__.py").read_text()
    uppermost = re.search(r"^## \[(\S+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert uppermost is not None
    assert f'"{uppermost[1]}.dev0"' in text


@pytest.mark.git
def test_the_tag_of_a_clean_tree_is_the_version(tree: Path, git: Callable[..., str]) -> None:
    assert version(tree) == "0.2.0.dev1"
    git("tag", "v0.2.0")
    commit, date = git("log", "-1", "--abbrev=10", "--format=%h %cs").split()
    assert version(tree) == version(tree, "--deb") == "0.2.0"
    assert version(tree, "--long") == f"0.2.0 ({commit}, {date})"
    (tree / "README.md").write_text("changed")
    assert version(tree, "--long") == f"0.2.1.dev0 ({commit}+, {date})"
    git("commit", "-qam", "two")
    assert version(tree) == "0.2.1.dev1"
    git("tag", "v0.3.0rc1")
    assert version(tree, "--deb") == "0.3.0~rc1"


@pytest.mark.git
@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_a_clone_of_another_user_is_asked_by_an_old_git_too(
    tree: Path, git: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = tmp_path / "bin/git"
    old.parent.mkdir()
    old.write_text(
        f'#!/bin/sh\nshift; at=$1; shift; [ "$1" != -c ] || shift 2; exec {shutil.which("git")} -C "$at" "$@"'
    )
    old.chmod(0o755)
    monkeypatch.setitem(ENVIRONMENT, "PATH", f"{old.parent}:{os.environ['PATH']}")
    for path in (tree, *tree.rglob("*")):
        os.chown(path, 65534, 65534)
    assert version(tree) == "0.2.0.dev1"
    assert int(version(tree, "--epoch")) > 10**9


@pytest.mark.git
def test_a_shallow_clone_has_no_count(tree: Path, git: Callable[..., str]) -> None:
    git("commit", "-qm", "two", "--allow-empty")
    run("git", "clone", "-q", "--depth=1", tree.as_uri(), "shallow", folder=tree.parent)
    assert version(tree.parent / "shallow") == "0.2.0.dev0"


@pytest.mark.git
def test_wheel_and_sdist_carry_version_and_commit_beyond_git(tree: Path, git: Callable[..., str]) -> None:
    git("tag", "v0.2.0")
    long = version(tree, "--long")
    run(sys.executable, "setup.py", "-q", "sdist", "-d", tree.parent, "bdist_wheel", "-d", tree.parent, folder=tree)
    assert git("status", "--porcelain") == "", "a build must not write into the tree"
    run("tar", "xf", "rmpa-0.2.0.tar.gz", folder=tree.parent)
    assert version(tree.parent / "rmpa-0.2.0", "--long") == long
    with zipfile.ZipFile(tree.parent / "rmpa-0.2.0-py3-none-any.whl") as wheel:
        wheel.extractall(tree.parent / "installed")
    program = "import rmpa; print(f'{rmpa.__version__} ({rmpa.COMMIT}, {rmpa.DATE})')"
    assert run(sys.executable, "-Pc", program, folder=tree.parent) != long
    program = f"import sys; sys.path.insert(0, 'installed'); {program}"
    assert run(sys.executable, "-Pc", program, folder=tree.parent) == long


def test_the_program_of_a_clone_shows_what_git_says_now() -> None:
    said = run(sys.executable, "-m", "rmpa.cli.main", "--version", folder=ROOT)
    assert said == f"rmpa {version(ROOT, '--long')}"
    assert rmpa.__version__.endswith(".dev0"), "a build has written into the clone, which is then never asked again"
