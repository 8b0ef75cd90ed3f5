"""The files that describe this module's resources (``camera.resource.toml``), which pages under control change.

A token of ``rmpa web`` must not become a shell. So a page changes only files that are there, in the folder that
``[resources]`` names, and nothing in them that says how a program is started. The text is checked by ``rmpa resource
check`` in a process of its own: nothing of ``rmpa.resource`` runs here.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import stat
import subprocess
import tempfile
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import msgspec

from rmpa.core.errors import ConfigError, RmpaError
from rmpa.runtime.interpreter import own_command
from rmpa.runtime.programs import replace_file
from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

_log = logging.getLogger(__name__)
# The end of the name of such a file, and what stands before it.
SUFFIX: Final = ".resource.toml"
_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,100}" + re.escape(SUFFIX))
# What a page may change of a [node.*], and of a [parameter.*] that is an argument of a launch file: an argument can
# be any program (launch-prefix), so its choices and bounds are part of how nodes are started.
_OF_NODE: Final = frozenset({"restart", "stop_after"})
_OF_ARGUMENT: Final = frozenset({"default", "description", "unit"})
STARTS: Final = "how nodes are started is changed in the module's own files only"
_TIMEOUT: Final = 20.0
Problems: TypeAlias = list[dict[str, Any]]  # each: ``line``, ``problem``, ``remedy``


class _Misfit(msgspec.Struct, frozen=True):
    """A mistake, as ``rmpa resource check --json`` has it."""

    line: int
    where: str
    problem: str
    remedy: str = ""


class _Checked(msgspec.Struct, frozen=True):
    """All that it says."""

    found: list[_Misfit]


class Descriptions:
    """The files of one folder. All methods block.

    Args:
        folder: ``[resources] folder``; empty for none.
        check: Says what is wrong with a file.
    """

    def __init__(self, folder: str = "", check: Callable[[Path], Problems] | None = None) -> None:
        self._folder = os.path.expanduser(folder)  # noqa: PTH111 - empty stays empty
        self._check = check or checked
        self._help: dict[str, str] = {}

    def read(self, file: str) -> dict[str, Any]:
        """A file's ``text``, its ``digest``, and ``help``: what each key means, by table and key (``node.run``).

        Raises:
            RmpaError: There is no such file, or it cannot be shown.
        """
        text = self._text(file)
        self._help = self._help or _read_help()
        return {"text": text, "digest": _digest(text), "help": self._help}

    def check(self, file: str, text: str) -> Problems:
        """What is wrong with a text for a file; empty: nothing.

        Raises:
            RmpaError: There is no such file, or the text cannot be checked.
        """
        return self._problems(file, self._text(file), text)

    def save(self, file: str, text: str, digest: str) -> dict[str, Any]:
        """Replace a file at once, and keep its old text as ``FILE.bak``; return its ``problems`` or new ``digest``.

        Args:
            file: Its base name.
            text: Its new text, which is not saved while something is wrong with it.
            digest: That of the text that the page has changed.

        Raises:
            RmpaError: Another one has changed it meanwhile, or it cannot be written.
        """
        before = self._text(file)
        if _digest(before) != digest:
            problem = "it has changed since this page read it, and is not saved"
            raise ConfigError(file, problem, "copy what you have typed, and load the file again")
        if problems := self._problems(file, before, text):
            return {"problems": problems}
        path = Path(self._folder, file)
        try:
            mode = stat.S_IMODE(path.stat().st_mode)
            for target, content in ((path.with_name(f"{file}.bak"), before), (path, text)):
                replace_file(target, content.encode())
                target.chmod(mode)
        except OSError as error:
            raise ConfigError(str(path), f"it cannot be written: {error.strerror}", "look at its owner") from None
        _log.info("= a page has changed %s; the text before is in %s.bak", path, file)
        return {"problems": [], "digest": _digest(text), "backup": f"{file}.bak"}

    def _text(self, file: str) -> str:
        if not self._folder:
            remedy = "name one as folder of [resources] in rmpa.toml"
            raise ConfigError("resources.folder", "this module has no folder of resources", remedy)
        if not _NAME.fullmatch(file):
            raise ConfigError("file", f"{file[:80]!r} is no name of a file", f"give a base name with {SUFFIX}")
        try:
            fd = os.open(Path(self._folder, file), os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            with os.fdopen(fd, "rb") as opened:
                if not stat.S_ISREG(os.fstat(fd).st_mode):
                    raise ConfigError(file, "it is not a file")
                data = opened.read(limits.DESCRIPTION_MAX + 1)
        except OSError as error:
            remedy = "only files that are there, and no links, are shown to pages"
            raise ConfigError(file, f"it cannot be read: {error.strerror}", remedy) from None
        _bounded(file, data)
        try:
            return data.decode()
        except UnicodeDecodeError as error:
            raise ConfigError(file, f"it is not UTF-8 at byte {error.start}") from None

    def _problems(self, file: str, before: str, text: str) -> Problems:
        data = text.encode(errors="replace")
        _bounded(file, data)
        with tempfile.TemporaryDirectory(prefix="rmpa-check-") as folder:
            path = Path(folder, file)  # the name of the file is that of the resource
            path.write_bytes(data)
            problems = self._check(path)
        return problems or _changes_of_starts(file, before, text)


def checked(path: Path) -> Problems:
    """What ``rmpa resource check`` says of a file, without looking at the graph.

    Raises:
        RmpaError: It does not end in time, or in another way than it should.
    """
    status, output = _run("resource", "check", "--offline", "--json", str(path))
    try:
        found = msgspec.json.decode(output, type=_Checked).found
    except msgspec.DecodeError:
        found = []
    if status not in (0, 2) or (status == 2 and not found):
        raise RmpaError(f"rmpa resource check ended with {status}, and nothing is saved", code="failed")
    return [
        {"line": one.line, "problem": f"{one.where}: {one.problem}", "remedy": one.remedy}
        for one in (found if status else ())
    ]


def _run(*words: str) -> tuple[int, bytes]:
    command = own_command(*words)
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_TIMEOUT, check=False)  # noqa: S603 - this program
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RmpaError(f"rmpa {words[0]} {words[1]} does not end: {error}", code="failed") from None
    return done.returncode, done.stdout


def _read_help() -> dict[str, str]:
    """What each key of a file means; empty where ``rmpa resource schema`` does not say it."""
    try:
        status, output = _run("resource", "schema")
        return help_of(msgspec.json.decode(output)) if status == 0 else {}
    except (RmpaError, msgspec.DecodeError, LookupError, AttributeError):
        return {}


def help_of(schema: Mapping[str, Any]) -> dict[str, str]:
    """What a JSON Schema of such files says of each key, by ``TABLE.KEY``."""
    found: dict[str, str] = {}
    for name, table in schema["properties"].items():
        found[name] = str(table.get("description", ""))
        inner = table.get("additionalProperties")
        keys = (inner if isinstance(inner, dict) else table).get("properties", {})
        found |= {f"{name}.{key}": str(one.get("description", "")) for key, one in keys.items()}
    return found


def _changes_of_starts(file: str, before: str, text: str) -> Problems:
    """Where a text says of the start of programs anything else than the one before."""
    try:
        old, new = (_starts(tomllib.loads(each)) for each in (before, text))
    except (ValueError, RecursionError, AttributeError, TypeError) as error:
        raise ConfigError(file, f"it cannot be compared with the new text: {error}", "mend it there") from None
    changed = sorted(key for key in old.keys() | new.keys() if old.get(key) != new.get(key))
    return [{"line": _line(text, key), "problem": f"[{key}]: {STARTS}", "remedy": ""} for key in changed]


def _starts(table: dict[str, Any]) -> dict[str, object]:
    """What says how programs are started, by table (``node.driver``)."""
    parameters = table.get("parameter", {}).items()
    parts = [(f"node.{key}", one, _OF_NODE) for key, one in table.get("node", {}).items()]
    parts += [(f"parameter.{key}", one, _OF_ARGUMENT) for key, one in parameters if "arg" in one]
    found: dict[str, object] = {}
    for name, one, free in parts:
        # As text with the types, since 1, 1.0 and true are equal.
        found[name] = repr(sorted((key, value) for key, value in one.items() if key not in free))
        if "arg" in one:
            found[name] = f"{found[name]} {type(one.get('default'))}"
    return found


def _line(text: str, table: str) -> int:
    """The line of a table's heading; 1 where it is written in another way, or is missing."""
    wanted = f"[{table}]"
    lines = enumerate(text.splitlines(), 1)
    return next((number for number, line in lines if line.partition("#")[0].replace(" ", "").strip() == wanted), 1)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _bounded(file: str, data: bytes) -> None:
    if len(data) > limits.DESCRIPTION_MAX:
        text = f"it has more than {limits.DESCRIPTION_MAX} bytes"
        raise ConfigError(file, text, "change it in its folder", code="limit-reached")
