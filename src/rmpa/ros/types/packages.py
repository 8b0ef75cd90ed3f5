"""Finds the ROS packages below a folder as rospack does (wiki.ros.org/rospack).

A folder with a ``package.xml`` (catkin) or ``manifest.xml`` (rosbuild) is a package, and none is within another.
``CATKIN_IGNORE`` hides a folder and all below it, ``rospack_nosubdirs`` only the folders below. Symbolic links are
followed; each folder is searched once. The search is bounded (``limits.PACKAGE_*``) and breadth first; unreadable
folders are skipped. Only folders with definitions (``msg``, ``srv``, ``action``) are found.
"""

from __future__ import annotations

import functools
import os
import re
import stat
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

DEFINITIONS: Final = frozenset(("msg", "srv", "action"))
"""The folders of a package with definitions."""
_COMMENT: Final = re.compile(r"<!--.*?-->", re.DOTALL)
_NAME: Final = re.compile(r"<name(?:\s[^>]*)?>\s*([^<\s]+)\s*</name>")


@dataclass(frozen=True, slots=True)
class Packages:
    """The packages with definitions below a folder.

    Args:
        folders: The folders of each package, by its name.
        whole: Whether the search was complete; ``False`` if a limit ended it.
    """

    folders: Mapping[str, tuple[Path, ...]]
    whole: bool


@functools.lru_cache(maxsize=64)
def packages_below(root: str) -> Packages:
    """Search a folder for packages; ``packages_below.cache_clear()`` makes the next call search again."""
    search = _Search()
    whole = search.run(Path(root))
    folders: dict[str, tuple[Path, ...]] = {}
    for name, folder in (*search.packages, *search.loose):
        folders[name] = (*folders.get(name, ()), folder)
    return Packages(folders, whole)


def package_folders(package: str, root: str) -> Iterator[Path]:
    """Yield the folders of a package below a root, first one directly below it, which needs no search."""
    direct = Path(root, package)
    is_direct = _is_package(direct, package)
    if is_direct:
        yield direct
    for folder in packages_below(root).folders.get(package, ()):
        if not is_direct or folder != direct:
            yield folder


def _is_package(folder: Path, package: str) -> bool:
    try:
        if (folder / "CATKIN_IGNORE").exists():
            return False
        if (folder / "package.xml").exists():
            return _declared_name(folder) == package
        return (folder / "manifest.xml").exists()
    except OSError:
        return False


class _Search:
    """One search, breadth first."""

    def __init__(self) -> None:
        self.packages: list[tuple[str, Path]] = []
        self.loose: list[tuple[str, Path]] = []
        """Folders with definitions but without a manifest, which ROS does not count as packages."""
        self._seen: set[tuple[int, int]] = set()
        self._entries = 0

    def run(self, root: Path) -> bool:
        """Search; return ``False`` if a limit ended the search."""
        waiting = deque([(root, 0)])
        whole = True
        for _ in range(limits.PACKAGE_FOLDERS_MAX):
            if not waiting or self._entries >= limits.PACKAGE_ENTRIES_MAX:
                break
            folder, depth = waiting.popleft()
            below = self._look(folder)
            if depth < limits.PACKAGE_DEPTH_MAX:
                waiting += [(folder / name, depth + 1) for name in below]
            else:
                whole = whole and not below
        return whole and not waiting

    def _look(self, folder: Path) -> list[str]:
        """Add a folder if it has definitions; return the names of the folders in it to search next."""
        files, inner = self._entries_of(folder)
        if "CATKIN_IGNORE" in files:
            return []
        manifest = "package.xml" in files or "manifest.xml" in files
        if not DEFINITIONS.isdisjoint(inner):
            name = _declared_name(folder) if "package.xml" in files else folder.name
            (self.packages if manifest else self.loose).append((name, folder))
        if manifest or "rospack_nosubdirs" in files:
            return []
        return sorted(name for name in inner - DEFINITIONS if not name.startswith("."))

    def _entries_of(self, folder: Path) -> tuple[set[str], set[str]]:
        """The names of a folder's files and folders; empty if it was searched before or cannot be read."""
        files: set[str] = set()
        folders: set[str] = set()
        try:
            about = folder.stat()
            if (about.st_dev, about.st_ino) in self._seen:
                return files, folders
            self._seen.add((about.st_dev, about.st_ino))
            with os.scandir(folder) as entries:
                for entry in entries:
                    self._entries += 1
                    if self._entries >= limits.PACKAGE_ENTRIES_MAX:
                        break
                    (folders if _is_folder(entry) else files).add(entry.name)
        except OSError:
            pass
        return files, folders


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a symbolic link to itself
        return False


def _declared_name(folder: Path) -> str:
    """The name in a ``package.xml``, which need not be the folder's."""
    text = _COMMENT.sub("", read_text(folder / "package.xml", limits.PACKAGE_FILE_MAX) or "")
    match = _NAME.search(text)
    return match[1] if match else folder.name


def read_text(path: Path, size_max: int) -> str | None:
    """A file's text; ``None`` if it is unreadable, above ``size_max`` bytes, or no regular file (a FIFO would block).

    Bytes that are not UTF-8 are kept as lone surrogates.
    """
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode) or about.st_size > size_max:
            return None
        return path.read_text("utf-8", "surrogateescape")
    except (OSError, ValueError):  # a NUL in a name
        return None
