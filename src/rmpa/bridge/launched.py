"""The resources that an agent can start: their files, the process ``rmpa run`` of each, and what is told of them.

The files are those of one folder, which others cannot write.
"""

from __future__ import annotations

import os
import re
import stat
import tomllib
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from rmpa.bridge import limits
from rmpa.config.toml_file import other_writer
from rmpa.config.values import BadValue, read_duration
from rmpa.core.errors import RmpaError
from rmpa.core.facts import ModuleAnswer
from rmpa.core.timers import Backoff
from rmpa.runtime.interpreter import own_command
from rmpa.runtime.kept_program import KeptProgram
from rmpa.runtime.programs import (
    LOGS,
    RUNS,
    ResourceRun,
    StartRule,
    figures,
    read_log,
    rotate_log,
    start_program,
)
from rmpa.runtime.systemd import SERVICE_VARIABLES

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from rmpa.bridge.bridge import Bridge
    from rmpa.runtime.programs import CpuShares, ProgramMark

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


class LaunchedProcess(msgspec.Struct, frozen=True, kw_only=True):
    """A node of a resource; the attributes are those of ``NodeRun``.

    Attributes:
        cpu: Processor time as a share of one core, since it was last asked for.
        rss: Bytes of memory that it holds.
        own: Whether the resource has started it.
    """

    node: str
    pid: int | None = None
    cpu: float = 0.0
    rss: int = 0
    threads: int = 0
    restarts: int = 0
    since: float = 0.0
    state: str = ""
    own: bool = False
    why: str = ""


class LaunchedResource(msgspec.Struct, frozen=True, kw_only=True):
    """A resource that can be started.

    Attributes:
        name: Its name: that of its file without the ending.
        file: The base name of its file.
        state: ``stopped``, ``waiting`` (for what its start depends on), ``starting``, ``failed``, ``refused``, or
            while it runs ``stopping`` or that of its life cycle: ``active``, ``inactive``.
        pid: The process of ``rmpa run``.
        since: Since when that runs, in Unix seconds; 0: it does not.
        restarts: How often the agent has started it again after a failure.
        boot: Whether the agent starts it by itself.
        why: What it waits for, how it ended, or why it is refused.
        processes: Its nodes.
    """

    name: str
    file: str
    state: str
    pid: int | None = None
    since: float = 0.0
    restarts: int = 0
    boot: bool = False
    why: str = ""
    processes: tuple[LaunchedProcess, ...] = ()


class ResourceLog(msgspec.Struct, frozen=True, kw_only=True):
    """Lines of one log of a resource.

    Attributes:
        source: The declared name of the node that has written it; empty: the resource itself.
        lines: The lines.
        next: Where the next ones begin.
    """

    source: str
    lines: tuple[str, ...] = ()
    next: int = 0


class ModuleResources(ModuleAnswer, frozen=True, kw_only=True):
    """What one module answers.

    Attributes:
        resources: Those that were asked for.
        logs: Those of the resource that was asked for.
    """

    resources: tuple[LaunchedResource, ...] = ()
    logs: tuple[ResourceLog, ...] = ()


class ResourceProgram(KeptProgram):
    """A resource that the agent starts, and starts again when it fails.

    Args:
        name: Its name.
        path: Its file.
        state: The folder of the module's state, which is named as the module.
        bridge: The core that its nodes have.

    Attributes:
        state: As of ``KeptProgram``, or ``waiting``; what it tells itself goes first.
    """

    may_end = True

    def __init__(self, name: str, path: Path, state: Path, bridge: Bridge) -> None:
        backoff = Backoff(limits.LAUNCH_RESTART_FIRST, limits.LAUNCH_RESTART_MAX, bridge.rng)
        note = state / RUNS / f".{name}.json"
        super().__init__(f"resource {name}", "resource-stopped", note, backoff, limits.LAUNCH_END)
        self.name = name
        self.path = path
        self._directory = state
        self._core = bridge.core

    @property
    def made_of(self) -> tuple[str, ...]:
        """As of ``KeptProgram``: the base name of its file."""
        return (self.path.name,)

    def launch(self) -> subprocess.Popen[bytes]:
        """As of ``KeptProgram``."""
        command = own_command("run", str(self.path), "--name", self._directory.name, "--master", self._core.uri)
        command += ["--state", str(self._directory.parent)]
        environ = {name: value for name, value in os.environ.items() if name not in SERVICE_VARIABLES}
        return start_program(command, log=self._log, cwd=self.path.parent, env=environ)

    def left(self) -> list[ProgramMark]:
        """As of ``KeptProgram``: one that was killed has left its nodes."""
        runs = self.its(load_runs(self._directory))
        return [node.mark for run in runs for node in run.nodes if node.mark is not None]

    @property
    def _log(self) -> Path:
        return self._directory / LOGS / f"{self.name}.log"

    def its(self, runs: Mapping[str, ResourceRun]) -> list[ResourceRun]:
        """What the resources of its process tell; a file of Python may have several."""
        return [run for run in runs.values() if run.process == self.mark]

    def told(self, file: LaunchFile, runs: Mapping[str, ResourceRun], shares: CpuShares) -> LaunchedResource:
        """What is told of it.

        Args:
            file: Its file.
            runs: What the resources of this module tell of themselves.
            shares: The processor time of nodes.
        """
        mark, its, state, why = self.mark, self.its(runs), self.state, self.why
        if (by_hand := runs.get(self.name)) is not None and by_hand.process != mark and by_hand.process.runs:
            its, mark, why = [by_hand], by_hand.process, "it was started by hand"
        about = figures(mark.pid) if mark is not None and mark.runs else None
        if about is not None:
            states = [run.state for run in its] or ["unconfigured"]
            state = next((each for each in states if each != "active"), "active")
            state = "starting" if state == "unconfigured" else state
            state = self.state if self.state == "stopping" and self.runs else state
        elif file.problem:
            state, why = "refused", file.problem
        return LaunchedResource(
            name=self.name,
            file=file.path.name,
            state=state,
            pid=mark.pid if mark is not None and about is not None else None,
            since=about.since if about is not None else 0.0,
            restarts=self.restarts,
            boot=file.rule.boot,
            why=why,
            processes=tuple(_processes(its, shares)),
        )

    def rotate(self) -> None:
        """Rotate its log if it is large."""
        rotate_log(self._log)

    def logs(self, after: object, lines: object) -> list[ResourceLog]:
        """Lines of its logs and of those of its nodes; reads the disk.

        Args:
            after: Where they begin, by source, as earlier answers said; else the last ones are wanted.
            lines: The most of each.
        """
        starts: dict[Any, Any] = after if isinstance(after, dict) else {}
        most = min(max(lines, 1), limits.LAUNCH_LOG_LINES) if isinstance(lines, int) else limits.LAUNCH_LOG_LINES
        sources = {"": f"{self.name}.log"}
        for resource, run in load_runs(self._directory).items():
            if resource == self.name or run.process == self.mark:
                sources |= {node.key: f"{resource}.{node.key}.log" for node in run.nodes}
        found = []
        for source, name in [*sources.items()][: limits.LAUNCH_LOGS_MAX]:
            begin = starts.get(source)
            begin = begin if isinstance(begin, int) and begin >= 0 else None
            text, end = read_log(self._directory / LOGS / name, begin, most)
            found.append(ResourceLog(source=source, lines=tuple(text), next=end))
        return found


def load_runs(directory: Path) -> dict[str, ResourceRun]:
    """What the resources of a module tell of themselves, by name; reads the disk.

    Args:
        directory: The folder of the module's state.
    """
    paths = sorted((directory / RUNS).glob("[!.]*.json"))[: limits.LAUNCH_FILES_MAX]
    return {path.stem: run for path in paths if (run := ResourceRun.load(path)) is not None}


def _processes(runs: Sequence[ResourceRun], shares: CpuShares) -> Iterator[LaunchedProcess]:
    for node in (node for run in runs for node in run.nodes):
        about = figures(node.pid) if node.pid else None
        state = node.state if about is not None or node.state != "running" else "stopped"
        told = LaunchedProcess(
            node=node.node, restarts=node.restarts, state=state, own=node.mark is not None, why=node.why
        )
        if about is not None:
            cpu, since = shares.of(node.pid, about), node.since
            told = msgspec.structs.replace(
                told, pid=node.pid, cpu=cpu, rss=about.rss, threads=about.threads, since=since
            )
        yield told
