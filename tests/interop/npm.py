"""Clients in JavaScript that others wrote: the packages of ``clients/package-lock.json``, installed once by npm."""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

# Our own programs that use those packages, and the versions that are wanted.
CLIENTS: Final = Path(__file__).parent / "clients"
_FILES: Final = ("package.json", "package-lock.json")
_INSTALL: Final = 180.0
_NODE: Final = 18
# How npm says that it reaches no registry; any other failure is one of the test.
_OFFLINE: Final = ("EAI_AGAIN", "ENOTFOUND", "ECONNREFUSED", "ENETUNREACH", "EHOSTUNREACH", "ETIMEDOUT", "ENOTCACHED")


@functools.cache
def why_not() -> str:
    """Why no client in JavaScript can run here, or an empty string."""
    if missing := [name for name in ("node", "npm") if shutil.which(name) is None]:
        return f"no {' and no '.join(missing)} here (apt install nodejs npm)"
    said = subprocess.run(["node", "--version"], capture_output=True, text=True, check=True).stdout.strip()
    return "" if int(said[1:].split(".")[0]) >= _NODE else f"node is {said}, and the clients need {_NODE}"


@functools.cache
def packages() -> Path:
    """The folder ``node_modules`` with the packages; the test is skipped where there is no npm, or no registry.

    It is kept where the XDG Base Directory Specification has a user's caches, once for each version of the lock file.
    """
    if why_not():
        pytest.skip(why_not())
    digest = hashlib.sha256(b"".join((CLIENTS / name).read_bytes() for name in _FILES)).hexdigest()[:12]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rmpa" / "npm"
    folder = cache / digest
    if not folder.exists():
        unfinished = cache / f"{digest}.{os.getpid()}"
        unfinished.mkdir(parents=True)
        try:
            _install(unfinished)
            unfinished.replace(folder)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
    return folder / "node_modules"


def _install(folder: Path) -> None:
    for name in _FILES:
        shutil.copy(CLIENTS / name, folder)
    command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--prefer-offline"]
    done = subprocess.run(command, cwd=folder, capture_output=True, timeout=_INSTALL, text=True, check=False)
    if done.returncode and any(code in done.stderr for code in _OFFLINE):
        pytest.skip("npm reaches no registry")
    assert done.returncode == 0, done.stdout + done.stderr
