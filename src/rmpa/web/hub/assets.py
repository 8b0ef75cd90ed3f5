"""Files of ROS packages, for clients that draw a robot: ``package://NAME/PATH``."""

from __future__ import annotations

import os
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import LimitExceeded, RmpaError
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_SCHEME: Final = "package://"
_MANIFESTS: Final = ("package.xml", "manifest.xml")


class AssetError(RmpaError):
    """A file cannot be had."""


def read_asset(uri: str, most: int, environ: Mapping[str, str]) -> bytes:
    """Read a file of a package; this blocks.

    Args:
        uri: ``package://NAME/PATH``.
        most: Bytes.
        environ: Has ROS_PACKAGE_PATH and CMAKE_PREFIX_PATH.

    Raises:
        AssetError: There is no such package or file, or it is outside of the package.
        LimitExceeded: The file is larger than ``most``.
    """
    package, _, path = uri.removeprefix(_SCHEME).partition("/")
    if not uri.startswith(_SCHEME) or not package or not path or "\0" in path:
        raise AssetError(f"{uri[:200]!r} is not the file of a package; write package://NAME/PATH")
    try:
        return _find(package, path, most, environ)
    except OSError as error:  # such as a name that is too long
        raise AssetError(f"{uri[:200]} cannot be read: {error.strerror}") from error


def _find(package: str, path: str, most: int, environ: Mapping[str, str]) -> bytes:
    found = False
    for folder in _folders(package, environ):
        found = True
        root = folder.resolve()
        file = (root / path).resolve()
        if not file.is_relative_to(root):
            raise AssetError(f"{path[:200]} is outside of its package {package[:200]}")
        if file.is_file():
            return _read(file, most)
    if found:
        raise AssetError(f"package {package} has no file {path[:200]}")
    raise AssetError(f"package {package[:200]} is not found; source its workspace where rmpa web starts")


def _read(file: Path, most: int) -> bytes:
    try:
        with file.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size > most:
                raise LimitExceeded(f"asset {file.name}", size, most)
            return stream.read(most)
    except OSError as error:
        raise AssetError(f"{file.name} cannot be read: {error.strerror}") from error


def _folders(package: str, environ: Mapping[str, str]) -> Iterator[Path]:
    """The folders of a package, best first."""
    if package in (".", "..") or os.sep in package:
        return
    sourced = [entry for entry in environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if entry]
    prefixes = [entry for entry in environ.get("CMAKE_PREFIX_PATH", "").split(os.pathsep) if entry]
    roots = [*map(Path, sourced), *(Path(prefix, "share") for prefix in prefixes), Path("/usr/share")]
    for root in roots:
        if _is_package(root / package):
            yield root / package
    for entry in sourced:
        yield from _walk(Path(entry), package)


def _walk(root: Path, package: str) -> Iterator[Path]:
    """The folders of this name below ``root`` that are packages, nearest first; none is within another package."""
    waiting = deque([root])
    for _ in range(limits.PACKAGES_WALKED):
        if not waiting:
            return
        folder = waiting.popleft()
        try:
            below = sorted(entry.path for entry in os.scandir(folder) if entry.is_dir() and entry.name[0] != ".")
        except OSError:
            continue
        for each in map(Path, below):
            if _is_package(each):
                if each.name == package and each.parent != root:
                    yield each
            elif not (each / "CATKIN_IGNORE").exists():
                waiting.append(each)


def _is_package(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _MANIFESTS)
