"""Definitions on this machine: in the sourced workspaces, and where ROS is installed.

The search order is, in the workspaces:

* genpy's modules below each folder of PYTHONPATH, which rospy's nodes import. They are read, never run;
* the packages below each folder of ROS_PACKAGE_PATH (``ros.types.packages``): ``msg/Name.msg``, ``srv/Name.srv``,
  or ``action/Name.action`` for the messages of an action;
* in each prefix of CMAKE_PREFIX_PATH (a devel or install space) genpy's modules, ``share``, and the source folders
  that its file ``.catkin`` lists.

After the workspaces, ``/opt/ros/*`` (that of ROS_DISTRO first) and ``/usr`` are searched likewise, sourced or not.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core.identity import is_type_name
from rmpa.ros import limits
from rmpa.ros.types.actions import action_message, actions_of
from rmpa.ros.types.definitions import SEPARATOR
from rmpa.ros.types.packages import package_folders, packages_below, read_text

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_DISTRIBUTIONS: Final = Path("/opt/ros")
_SYSTEM: Final = ("/usr",)
_PYTHON: Final = "lib/python3/dist-packages"
_FULL_TEXT: Final = re.compile(
    r'''^class[ ](\w+)\( | ^[ ]+_full_text[ ]=[ ]"""((?: [^"\\] | \\. | "(?!"") )*)"""''',
    re.MULTILINE | re.DOTALL | re.VERBOSE,
)


@dataclass(frozen=True, slots=True)
class SearchPath:
    """The places in which definitions are searched.

    Args:
        python: The folders of PYTHONPATH.
        packages: The folders of ROS_PACKAGE_PATH.
        prefixes: The prefixes of CMAKE_PREFIX_PATH.
        distribution: The value of ROS_DISTRO.
    """

    python: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    prefixes: tuple[str, ...] = ()
    distribution: str = ""

    @classmethod
    def read(cls, environ: Mapping[str, str]) -> SearchPath:
        """Read the search path from environment variables."""
        python, packages, prefixes = (
            tuple(dict.fromkeys(part for part in environ.get(name, "").split(os.pathsep) if part))
            for name in ("PYTHONPATH", "ROS_PACKAGE_PATH", "CMAKE_PREFIX_PATH")
        )
        return cls(python, packages, prefixes, environ.get("ROS_DISTRO", ""))

    @property
    def system(self) -> tuple[str, ...]:
        """The prefixes of ROS installations: that of ``distribution``, the other distributions Z to A, ``/usr``."""
        try:
            found = sorted((str(prefix) for prefix in _DISTRIBUTIONS.iterdir()), reverse=True)
        except OSError:
            found = []
        found.sort(key=lambda prefix: Path(prefix).name != self.distribution)
        return (*found, *_SYSTEM)

    def __str__(self) -> str:
        """The searched places, for the text of errors."""
        variables = (
            ("ROS_PACKAGE_PATH", self.packages),
            ("CMAKE_PREFIX_PATH", self.prefixes),
            ("PYTHONPATH", self.python),
        )
        cut = [root for root in self.packages if not packages_below(root).whole]
        shown = [f"{name} ({_shown(entries)})" for name, entries in variables]
        note = f"; of {_shown(cut)} only the first {limits.PACKAGE_FOLDERS_MAX} folders" if cut else ""
        return ", ".join([*shown, *self.system]) + note


def _shown(entries: tuple[str, ...] | list[str]) -> str:
    shown = ", ".join(entries[: limits.SEARCHED_SHOWN])
    more = len(entries) - limits.SEARCHED_SHOWN
    return f"{shown} and {more} more" if more > 0 else shown or "not set"


@dataclass(frozen=True, slots=True)
class Found:
    """One definition.

    Args:
        text: A message's own text; or a service's request, a line ``---`` and its response.
        embedded: The own texts of embedded types, as far as the file has them.
        where: The file.
    """

    text: str
    embedded: Mapping[str, str]
    where: Path


def find_messages(name: str, path: SearchPath, *, sourced: bool) -> Iterator[Found]:
    """The definitions of a message type, best first: of the workspaces (``sourced``) or of the system."""
    if not is_type_name(name):
        return
    package, _, base = name.partition("/")
    for generated, folder in _places(package, path, sourced=sourced):
        if generated:
            where = folder / "msg" / f"_{base}.py"
            text = _full_texts(where).get(base)
            if text is not None:
                yield Found(*_split(text), where)
        elif (text := _read(folder / "msg" / f"{base}.msg")) is not None:
            yield Found(text, {}, folder / "msg" / f"{base}.msg")
        else:
            yield from _of_action(folder, base)


def find_services(name: str, path: SearchPath, *, sourced: bool) -> Iterator[Found]:
    """The definitions of a service type, as for ``find_messages``."""
    if not is_type_name(name):
        return
    package, _, base = name.partition("/")
    for generated, folder in _places(package, path, sourced=sourced):
        if not generated:
            where = folder / "srv" / f"{base}.srv"
            text = _read(where)
            if text is not None:
                yield Found(text, {}, where)
            continue
        where = folder / "srv" / f"_{base}.py"
        texts = _full_texts(where)
        if f"{base}Request" in texts and f"{base}Response" in texts:
            request, inner = _split(texts[f"{base}Request"])
            response, more = _split(texts[f"{base}Response"])
            mark = "---\n" if request.endswith("\n") or not request else "\n---\n"
            # genmsg has added a line feed to the last line of each half.
            yield Found(f"{request}{mark}{response}".removesuffix("\n"), inner | more, where)


def definitions_of(package: str, path: SearchPath, kind: str) -> tuple[list[Path], list[str]]:
    """The folders of a package on this machine, and the names of its definitions.

    Args:
        package: Its name.
        path: The places to search.
        kind: ``msg`` or ``srv``.
    """
    folders: list[Path] = []
    names: set[str] = set()
    for sourced in (True, False):
        for generated, folder in _places(package, path, sourced=sourced):
            there = _names(folder / kind, ".py" if generated else f".{kind}")
            if there:
                folders.append(folder)
                names |= {name.removeprefix("_") for name in there if not name.startswith("__")}
    return folders, sorted(names)


def _places(package: str, path: SearchPath, *, sourced: bool) -> Iterator[tuple[bool, Path]]:
    """Yield the folders that may be the package's; ``True`` for one with genpy's modules instead of definitions."""
    if sourced:
        for entry in path.python:
            yield True, Path(entry, package)
        for root in path.packages:
            for folder in package_folders(package, root):
                yield False, folder
    for prefix in path.prefixes if sourced else path.system:
        yield True, Path(prefix, _PYTHON, package)
        yield False, Path(prefix, "share", package)
        for root in _sources(prefix) if sourced else ():
            if root not in path.packages:
                for folder in package_folders(package, root):
                    yield False, folder


def _sources(prefix: str) -> list[str]:
    """The source folders of a devel space; empty for an install space."""
    text = read_text(Path(prefix, ".catkin"), limits.PACKAGE_FILE_MAX) or ""
    return [entry for entry in text.strip().split(";") if entry.startswith("/")]


def _of_action(folder: Path, base: str) -> Iterator[Found]:
    for action, part in actions_of(base):
        where = folder / "action" / f"{action}.action"
        text = _read(where)
        message = action_message(action, part, text) if text is not None else None
        if message is not None:
            yield Found(message, {}, where)


def _split(full_text: str) -> tuple[str, dict[str, str]]:
    """Split a full definition into the type's own text and those of the embedded types, by name."""
    own, *rest = full_text.split(f"\n{SEPARATOR}\nMSG: ")
    blocks = (block.partition("\n") for block in rest)
    return own, {name.strip(): text for name, _, text in blocks}


def _full_texts(module: Path) -> dict[str, str]:
    """The ``_full_text`` of each class of a module that genpy made, by the class's name; empty without a module."""
    texts: dict[str, str] = {}
    current = ""
    for match in _FULL_TEXT.finditer(_read(module) or ""):
        if match[1]:
            current = match[1]
        else:
            texts[current] = match[2].replace('\\"', '"')  # genpy escapes nothing else
    return texts


def _names(folder: Path, suffix: str) -> set[str]:
    """The names of a folder's files with a suffix, without the suffix."""
    try:
        return {
            entry.stem for entry in islice(folder.iterdir(), limits.PACKAGE_ENTRIES_MAX) if entry.suffix == suffix
        }
    except OSError:
        return set()


def _read(path: Path) -> str | None:
    return read_text(path, limits.DEFINITION_MAX)
