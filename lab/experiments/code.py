"""Which code measured: figures of one run must come of one."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path
from typing import Final

import msgspec

import rmpa

# What measures, and what is measured.
_PACKAGES: Final = (Path(__file__).parents[1], Path(rmpa.__file__).parent)
# Folders that may change while a run is made: they show what was measured, or are that.
_MEASURE_NOTHING: Final = ("cli/", "experiments/report/", "results/")


class Code(msgspec.Struct, frozen=True, kw_only=True):
    """One state of what measures and of what is measured.

    Attributes:
        version: Of the release.
        digest: Of all files that take part in measuring.
        commit: Of the clone that it runs from; empty where it is installed.
        changed: Whether files differ from that commit.
    """

    version: str
    digest: str
    commit: str = ""
    changed: bool = False


def code_here(*packages: Path) -> Code:
    """The code that runs, of these folders; default: ``lab`` and ``rmpa``."""
    packages = packages or _PACKAGES
    commit = _commit(packages[0])[0]
    changed = any(_commit(package)[1] for package in packages)
    return Code(version=rmpa.__version__, digest=digest(*packages), commit=commit, changed=changed)


def digest(*packages: Path) -> str:
    """Twelve hexadecimal digits that change with any file of these packages that takes part in measuring."""
    total = hashlib.sha256()
    for package, path in ((one, path) for one in packages for path in sorted(one.rglob("*"))):
        name = path.relative_to(package).as_posix()
        if path.is_file() and "__pycache__" not in path.parts and not name.startswith(_MEASURE_NOTHING):
            total.update(f"{name}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()[:12]


def _commit(package: Path) -> tuple[str, bool]:
    """The commit, and whether files differ from it; a package within a clone that it is not part of has none."""

    def git(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", package, *words], capture_output=True, text=True, check=False)
        except FileNotFoundError:
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    if git("ls-files", "--error-unmatch", "__init__.py") is None:
        return "", False
    return git("rev-parse", "--short", "HEAD") or "", bool(git("status", "--porcelain", "--", "."))
