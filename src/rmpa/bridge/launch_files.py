"""The files from which an agent starts resources: those of one folder, which others cannot write."""

from __future__ import annotations

import os
import re
import stat
import tomllib
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rmpa.bridge import limits
from rmpa.config.toml_file import other_writer
from rmpa.config.values import BadValue, read_duration
from rmpa.core.errors import RmpaError
from rmpa.runtime.programs import StartRule

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

REFUSED: Final = "launch-refused"
_TOML: Final = ".resource.toml"
_PYTHON: Final = ".py"
_NAME: Final = re.compile("[A-Za-z][A-Za-z0-9_]{0,63}")


class LaunchFile(NamedTuple):
    """A file of the folder.

    Attributes:
        name: By which it is started: the file's name without its ending.
        path: The file.
        problem: Why it is not started, and what to do; empty: it may be.
        rule: When the agent starts it by itself.
    """

    name: str
    path: Path
    problem: str = ""
    rule: StartRule = StartRule()


def is_name(name: object) -> bool:
    """Whether something can be the name of a resource: no path, no command, nothing of a shell."""
    return isinstance(name, str) and _NAME.fullmatch(name) is not None


def list_files(folder: Path, environ: Mapping[str, str]) -> dict[str, LaunchFile]:
    """The files of resources in a folder, by the names of the resources; reads the disk.

    Args:
        folder: The folder.
        environ: As for ``other_writer``.

    Raises:
        RmpaError: It cannot be read, or another user may write it.
    """
    try:
        if found := other_writer(folder, environ):
            raise RmpaError(f"{found[0]}; {found[1]}", code=REFUSED)
        with os.scandir(folder) as entries:
            paths = [folder / entry.name for entry in entries]
    except OSError as error:
        text = f"the folder {folder} of [resources] cannot be read: {error.strerror}"
        raise RmpaError(text, code=REFUSED) from None
    files: dict[str, LaunchFile] = {}
    imported = _first_problem((each for each in paths if each.suffix == _PYTHON or _is_folder(each)), environ)
    for path in sorted(paths)[: limits.LAUNCH_FILES_MAX]:
        ending = next((each for each in (_TOML, _PYTHON) if path.name.endswith(each)), "")
        if not ending:
            continue
        name = path.name.removesuffix(ending)
        problem = _problem(path, environ) or (imported if ending == _PYTHON else "")
        if not is_name(name):
            problem = "the name of its file is not of 64 letters, digits and _ at most; rename it"
        if name in files:
            problem = f"{files[name].path.name} and {path.name} have one name; rename one"
        rule = StartRule()
        if not problem and ending == _TOML:
            rule, problem = _read_rule(path)
        files[name] = LaunchFile(name, path, problem, rule)
    return files


def _is_folder(path: Path) -> bool:
    return path.is_dir() and path.name != "__pycache__"


def _first_problem(paths: Iterable[Path], environ: Mapping[str, str]) -> str:
    """Why nothing of Python is run from the folder, where a file imports the others."""
    return next((problem for path in paths if (problem := _problem(path, environ, folder=True))), "")


def _problem(path: Path, environ: Mapping[str, str], *, folder: bool = False) -> str:
    """Why a file is not used; empty: it may be."""
    try:
        mode = path.lstat().st_mode
        if stat.S_ISLNK(mode):
            return f"{path.name} is a symbolic link; put the file itself into the folder"
        if not stat.S_ISREG(mode) and not (folder and stat.S_ISDIR(mode)):
            return f"{path.name} is not a regular file"
        found = other_writer(path, environ)
    except OSError as error:
        return f"{path.name}: {error.strerror}"
    return f"{found[0]}; {found[1]}" if found else ""


def _read_rule(path: Path) -> tuple[StartRule, str]:
    """The table ``[start]`` of a file; what else is wrong with the file its start will tell."""
    try:
        with path.open("rb") as file:
            text = file.read(limits.LAUNCH_FILE_BYTES).decode()
        table: dict[str, Any] = tomllib.loads(text).get("start", {})
        raw = table.get("delay", 0)
        delay = read_duration(raw, "a delay") if raw not in (0, "0 s") else 0.0
        topics, after = (tuple(map(str, table.get(key, ()))) for key in ("topics", "after"))
        return StartRule(table.get("boot") is True, delay or 0.0, topics, after), ""
    except (OSError, ValueError, AttributeError, TypeError, BadValue) as error:
        return StartRule(), f"its table [start] cannot be read: {error}"


def circles(rules: Mapping[str, StartRule]) -> dict[str, str]:
    """The resources that wait for themselves, by ``after``, each with the way round: ``a after b after a``."""
    found = {}
    for name in rules:
        ways: list[tuple[str, ...]] = [(name,)]
        while ways and name not in found:
            way = ways.pop()
            for other in rules[way[-1]].after if way[-1] in rules else ():
                if other == name:
                    found[name] = " after ".join((*way, name))
                elif other not in way:
                    ways.append((*way, other))
    return found
