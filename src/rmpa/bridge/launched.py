"""One resource that the agent starts: its process ``rmpa run``, and what is told of it and of its nodes."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits
from rmpa.core.errors import RmpaError
from rmpa.core.timers import Backoff
from rmpa.runtime.interpreter import own_command
from rmpa.runtime.programs import (
    LOGS,
    RUNS,
    ProgramMark,
    ResourceRun,
    end_program,
    ended,
    figures,
    how_ended,
    read_log,
    rotate_log,
    start_program,
)
from rmpa.runtime.systemd import SERVICE_VARIABLES
from rmpa.runtime.tasks import end_tasks, start_task

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from rmpa.bridge.launch_files import LaunchFile
    from rmpa.runtime.programs import CpuShares

_log = logging.getLogger(__name__)
# The exit code of a command that cannot run as it is written: another start would end alike.
_USAGE: Final = 2


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


class ModuleResources(msgspec.Struct, frozen=True, kw_only=True):
    """What one module answers.

    Attributes:
        module: Its name.
        problem: Why it was not done; empty: it was.
        code: The problem's code.
        resources: Those that were asked for.
        logs: Those of the resource that was asked for.
    """

    module: str
    problem: str = ""
    code: str = ""
    resources: tuple[LaunchedResource, ...] = ()
    logs: tuple[ResourceLog, ...] = ()


class ResourceProgram:
    """A resource that the agent starts, and starts again when it fails.

    Args:
        name: Its name.
        path: Its file.
        state: The folder of the module's state, which is named as the module.
        rng: Uniform numbers in [0, 1), for the delays.
        note: Keeps which processes run, for the next agent.

    Attributes:
        mark: Its process, or the last one.
        state: ``stopped``, ``waiting``, ``starting``, ``stopping``, ``failed``; what it tells itself goes first.
        why: The reason, as a text.
    """

    def __init__(
        self, name: str, path: Path, state: Path, rng: Callable[[], float], note: Callable[[], Awaitable[None]]
    ) -> None:
        self.name = name
        self.path = path
        self.state = "stopped"
        self.why = ""
        self.restarts = 0
        self.mark: ProgramMark | None = None
        self._directory = state
        self._note = note
        self._child: subprocess.Popen[bytes] | None = None  # ``None`` too if an agent before has started it
        self._keeper: asyncio.Task[None] | None = None
        self._one = asyncio.Lock()
        self._backoff = Backoff(limits.LAUNCH_RESTART_FIRST, limits.LAUNCH_RESTART_MAX, rng)

    @property
    def runs(self) -> bool:
        """Whether its process runs."""
        return self.mark is not None and self.mark.runs

    def adopt(self, mark: ProgramMark, restarts: int, master: str) -> None:
        """Take over the process that an agent before has started."""
        self.mark, self.restarts = mark, restarts
        if self.runs and self._keeper is None:
            _log.info("= resource %s (process %d) goes on, of the agent before", self.name, mark.pid)
            self._keeper = start_task(self._keep(master), f"keep resource {self.name}")

    async def start(self, master: str) -> None:
        """Start it if it does not run; ``master`` is the URI of the core.

        Raises:
            RmpaError: It cannot be started.
        """
        async with self._one:
            if self.runs:
                return
            await end_tasks(self._keeper)
            self._backoff.reset()
            self.restarts = 0
            await self._spawn(master)
            self._keeper = start_task(self._keep(master), f"keep resource {self.name}")

    async def stop(self) -> None:
        """End it with its nodes, and wait until it has ended."""
        async with self._one:
            await end_tasks(self._keeper)
            self._keeper, self.state, self.why = None, "stopping", ""
            if self.mark is not None and self.runs:
                await end_program(self.mark, limits.LAUNCH_END)
            if self._child is not None:
                self._child.poll()  # it is reaped
            runs = await asyncio.to_thread(load_runs, self._directory)  # one that was killed has left its nodes
            left = [node.mark for run in self.its(runs) for node in run.nodes]
            await asyncio.gather(*(end_program(mark, limits.LAUNCH_END) for mark in left if mark is not None))
            self.state, self.why = "stopped", ""

    async def _spawn(self, master: str) -> None:
        command = own_command("run", str(self.path), "--name", self._directory.name, "--master", master)
        command += ["--state", str(self._directory.parent)]
        environ = {name: value for name, value in os.environ.items() if name not in SERVICE_VARIABLES}
        log, cwd = self._directory / LOGS / f"{self.name}.log", self.path.parent

        async def spawn() -> None:  # not to be cancelled between the start and its note
            self._child = await asyncio.to_thread(start_program, command, log=log, cwd=cwd, env=environ)
            self.mark = ProgramMark.of(self._child.pid)
            self.state, self.why = "starting", ""
            await self._note()

        try:
            await asyncio.shield(start_task(spawn(), f"start resource {self.name}", raises=(OSError,)))
        except OSError as error:
            self.state, self.why = "failed", f"cannot be started: {error.strerror}"
            raise RmpaError(f"{self.name} {self.why}", code="resource-stopped") from None

    async def _keep(self, master: str) -> None:
        """Start it again when it has failed."""
        while True:
            began = time.monotonic()
            if self.mark is not None:
                await ended(self.mark.pid)
            code = self._child.poll() if self._child is not None else None
            self.state, self.why = ("stopped" if code == 0 else "failed"), _how(code)
            if code in (0, _USAGE):
                _log.info("= resource %s %s", self.name, self.why)
                return
            if time.monotonic() - began >= limits.LAUNCH_STEADY:
                self._backoff.reset()
            delay = self._backoff.delay()
            text = "! resource %s %s; it is started again in %.1f s [resource-stopped]"
            _log.warning(text, self.name, self.why, delay)
            self.why += f"; it is started again in {delay:.0f} s"
            await asyncio.sleep(delay)
            self.restarts += 1
            try:
                await self._spawn(master)
            except RmpaError as error:
                _log.warning("! %s [%s]", error, error.code)

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
        rotate_log(self._directory / LOGS / f"{self.name}.log")

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
        told = LaunchedProcess(
            node=node.node,
            restarts=node.restarts,
            state=node.state if about is not None or node.state != "running" else "stopped",
            own=node.mark is not None,
            why=node.why,
        )
        if about is not None:
            cpu = shares.of(node.pid, about)
            told = msgspec.structs.replace(
                told, pid=node.pid, cpu=cpu, rss=about.rss, threads=about.threads, since=node.since
            )
        yield told


def _how(code: int | None) -> str:
    if code == 0:
        return "ended in order"
    if code == _USAGE:
        return "cannot run as it is written"
    return how_ended(code)
