"""Rooms and families of verbs can be taken out: what remains imports, type-checks and passes its tests."""

from __future__ import annotations

import ast
import itertools
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

ROOT: Final = Path(__file__).parents[2]
# What goes with each, below ``src/rmpa``. import-linter proves that no other module imports it.
ROOMS: Final = {
    "gateway": ("gateway", "cli/gateway.py"),
    "web": ("web", "cli/web.py"),
    "record": ("record", "cli/record.py", "cli/recordings.py", "cli/play.py"),
    "resource": ("resource", "cli/describe.py", "cli/profile.py", "cli/resource.py", "cli/run.py"),
    "doctor": ("observe/doctor", "cli/doctor.py"),
    "verbs": (
        *("cli/agent.py", "cli/boot.py", "cli/bug_report.py", "cli/core.py", "cli/init.py", "cli/messages.py"),
        *("cli/node.py", "cli/param.py", "cli/peer.py", "cli/service.py", "cli/topic.py", "cli/trust.py"),
    ),
}
ALL: Final = [*itertools.chain(*ROOMS.values())]
EACH: Final = [
    pytest.param(ALL, id="all"),
    *(pytest.param(gone, id=room, marks=pytest.mark.long) for room, gone in ROOMS.items()),
]
# Tests that compare the whole tree with its pages and lists; and this one.
OF_THE_WHOLE: Final = (
    *("api/test_names.py", "cli/test_one_name.py", "cli/test_pictures.py"),
    *("config/test_reference.py", "core/test_house.py", "core/test_pages.py", "core/test_rooms.py"),
)
NO_SYSTEM: Final = "not (alone or long or ros or netns or nat or pty or git or packages)"
QUICK: Final = ("tests/cli/test_main.py", "tests/config")
FAST: Final = (*QUICK, "tests/api", "tests/core", "tests/observe", "tests/trust")
IMPORT_ALL: Final = """
import importlib, pkgutil, sys
import rmpa
from rmpa.cli.main import main
assert rmpa.__file__.startswith(sys.argv[1]), rmpa.__file__
for module in pkgutil.walk_packages(rmpa.__path__, "rmpa."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
main(["--help"])
main(["--version", "--json"])
"""
# The clone is installed too: what is gone from the copy would be found there.
TYPES: Final = """
import sys
from mypy.__main__ import console_entry
sys.path = [path for path in sys.path if path != sys.argv[1]]
sys.argv[1:] = ["src"]
console_entry()
"""


class Tree:
    """A copy of the sources in which some modules are missing.

    Args:
        place: Where.
        gone: Paths below ``src/rmpa``.
    """

    def __init__(self, place: Path, gone: Iterable[str]) -> None:
        self.place = place
        self.gone = {f"rmpa/{path}".removesuffix(".py").replace("/", ".") for path in gone}
        shutil.copytree(ROOT / "src", place / "src")
        for name in ("pyproject.toml", "docs", "examples", "lab", "scripts"):
            (place / name).symlink_to(ROOT / name)
        for module in self.gone:
            remove(place / "src" / module.replace(".", "/"))

    def add_tests(self) -> None:
        """Copy the tests, but those that import what is gone, or a module of tests that does."""
        shutil.copytree(ROOT / "tests", self.place / "tests")
        for path in OF_THE_WHOLE:
            remove(self.place / "tests" / path)
        files = {
            ".".join(path.relative_to(self.place).with_suffix("").parts): path
            for path in (self.place / "tests").rglob("*.py")
        }
        needs = {name: imports(path) for name, path in files.items()}
        gone = {*self.gone}
        while more := {name for name, found in needs.items() if name not in gone and self._is_gone(found, gone)}:
            gone |= more
            # A folder's tests have its fixtures.
            folders = tuple(f"{one.removesuffix('conftest')}test_" for one in more if one.endswith(".conftest"))
            gone |= {name for name in files if name.startswith(folders)}
        for name in gone & files.keys():
            files[name].unlink()

    def _is_gone(self, found: Iterable[str], gone: set[str]) -> bool:
        return any(name in gone or any(name.startswith(f"{one}.") for one in self.gone) for name in found)

    def run(self, *words: str) -> str:
        environ = os.environ | {"PYTHONPATH": str(self.place / "src")}
        done = subprocess.run(
            [sys.executable, *words],
            cwd=self.place,
            env=environ,
            capture_output=True,
            text=True,
            timeout=1200,
            check=False,
        )
        assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]
        return done.stdout


def remove(path: Path) -> None:
    """Remove a package or module."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.with_suffix(".py").unlink()


def imports(path: Path) -> set[str]:
    """The modules of rmpa and of the tests that a file names, also in texts of subprocesses and patches."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("rmpa."):
            found.add(node.value)
    return found


@pytest.fixture(scope="session")
def checked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What mypy remembers of the sources: what `make types` left, if it ran."""
    place = tmp_path_factory.mktemp("mypy")
    if (ROOT / ".mypy_cache").is_dir():
        shutil.copytree(ROOT / ".mypy_cache", place, dirs_exist_ok=True)
    subprocess.run([sys.executable, "-m", "mypy", "--cache-dir", place, "src"], cwd=ROOT, check=True, timeout=600)
    return place


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("gone", EACH)
def test_what_remains_imports_and_type_checks(gone: Sequence[str], checked: Path, tmp_path: Path) -> None:
    tree = Tree(tmp_path, gone)
    tree.run("-c", IMPORT_ALL, str(tmp_path))
    shutil.copytree(checked, tmp_path / ".mypy_cache")
    tree.run("-c", TYPES, str(ROOT / "src"))


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("gone", EACH)
def test_what_remains_passes_its_tests(gone: Sequence[str], tmp_path: Path) -> None:
    tree = Tree(tmp_path, gone)
    tree.add_tests()
    there = [each for each in (QUICK if gone == ALL else FAST) if (tmp_path / each).exists()]
    # A command that is gone for good is named by its group, which may be gone.
    tree.run("-m", "pytest", "-q", "--timeout", "600", "-m", NO_SYSTEM, "-k", "not wrong_or_gone", *there)
