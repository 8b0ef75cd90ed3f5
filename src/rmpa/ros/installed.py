"""Definitions of service and message types that are installed on this machine: no server of a service sends its own.

Looked at, in this order: the modules that genpy made (``package/srv/_Name.py`` below each folder of PYTHONPATH and
Debian's own), which are read and never run; then ``package/srv/Name.srv`` in the folders of ROS_PACKAGE_PATH and in
``share`` below those of CMAKE_PREFIX_PATH.
"""

from __future__ import annotations

import ast
import os
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core import limits
from rmpa.core.names import is_type_name
from rmpa.ros.definitions import SEPARATOR

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_DEBIAN: Final = ("/usr/lib/python3/dist-packages",)
_SHARES: Final = ("/usr/share",)
_DEPTH: Final = 4
"""Folders between an entry of ROS_PACKAGE_PATH and a package: a workspace's ``src/stack/package``, and one more."""


def find_service(name: str, environ: Mapping[str, str]) -> str | None:
    """The definition of a service type that is installed here, or ``None``."""
    if not is_type_name(name):
        return None
    package, _, base = name.partition("/")
    for folder in _python_folders(environ):
        texts = _full_texts(folder / package / "srv" / f"_{base}.py")
        request, response = texts.get(f"{base}Request"), texts.get(f"{base}Response")
        if request is not None and response is not None:
            return f"{_own(request)}\n---\n{_own(response)}"
    return _read_first(f"srv/{base}.srv", package, environ)


def find_message(name: str, environ: Mapping[str, str]) -> str | None:
    """The own text of a message type that is installed here, or ``None``."""
    if not is_type_name(name):
        return None
    package, _, base = name.partition("/")
    for folder in _python_folders(environ):
        text = _full_texts(folder / package / "msg" / f"_{base}.py").get(base)
        if text is not None:
            return _own(text)
    return _read_first(f"msg/{base}.msg", package, environ)


def _own(full_text: str) -> str:
    """The first of the concatenated texts."""
    return full_text.partition(f"\n{SEPARATOR}\nMSG: ")[0]


def _python_folders(environ: Mapping[str, str]) -> Iterator[Path]:
    for entry in (*environ.get("PYTHONPATH", "").split(os.pathsep), *_DEBIAN):
        if entry:
            yield Path(entry)


def _full_texts(module: Path) -> dict[str, str]:
    """``_full_text`` of each class of a module that genpy made; empty if there is none."""
    text = _read(module)
    if text is None:
        return {}
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return {}
    return {
        part.name: statement.value.value
        for part in tree.body
        if isinstance(part, ast.ClassDef)
        for statement in part.body
        if isinstance(statement, ast.Assign)
        and isinstance(statement.targets[0], ast.Name)
        and statement.targets[0].id == "_full_text"
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    }


def _read_first(inner: str, package: str, environ: Mapping[str, str]) -> str | None:
    for folder in _packages(package, environ):
        text = _read(folder / inner)
        if text is not None:
            return text
    return None


def _packages(package: str, environ: Mapping[str, str]) -> Iterator[Path]:
    """Folders that may be the package."""
    for entry in environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep):
        if entry:
            yield from _below(Path(entry), package, _DEPTH)
    for prefix in environ.get("CMAKE_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            yield Path(prefix) / "share" / package
    for share in _SHARES:
        yield Path(share) / package


def _below(folder: Path, package: str, depth: int) -> Iterator[Path]:
    if folder.name == package:
        yield folder
    if (folder / "package.xml").exists():
        return  # no package is within another
    yield folder / package
    if depth:
        try:
            inner = sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
        except OSError:
            return
        for entry in inner:
            yield from _below(entry, package, depth - 1)


def _read(path: Path) -> str | None:
    try:
        if path.stat().st_size > limits.DEFINITION_MAX:
            return None
        return path.read_text("utf-8", "surrogateescape")
    except OSError:
        return None
