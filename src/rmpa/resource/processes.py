"""The nodes that a resource names: attached to where they run, else started, watched, restarted and ended.

A node is up when it is registered at the core and answers ``getPid``. One that answers before the resource has
started it is the user's: it is watched, and never ended. What the resource has started is noted in a file, so that
the next run takes it over after a crash of this one.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import random
import shlex
import subprocess
import time
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.core.timers import Backoff
from rmpa.resource import limits
from rmpa.resource.declare import ManagedNode, RestartPolicy
from rmpa.resource.runtime import LifecycleState, Runtime, RuntimePart
from rmpa.ros.environment import host_of, is_loopback
from rmpa.ros.executables import find_executable, find_program
from rmpa.ros.http.rpc import call_api, is_own_name
from rmpa.ros.node.listeners import local_addresses
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime import programs
from rmpa.runtime.programs import NodeRun, ProgramMark, ResourceRun, how_ended
from rmpa.runtime.tasks import end_tasks, start_task

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from pathlib import Path

    from rmpa.resource.quality import Value

_log = logging.getLogger(__name__)
# Seconds between two looks whether a starting node is up, and whether a node is back that is not started here.
_LOOK: Final = 0.05
_BACK: Final = 1.0
# Seconds that a node has to answer getPid.
_ANSWER: Final = 2.0
# Lines of a log that an error has at its end, and the most characters of them.
_LOG_SHOWN: Final = 8
_LOG_TEXT: Final = 400
# Begins of lines of a log that say nothing: the command line, and what roslaunch has to say at its end.
_EMPTY: Final = ("--- ", "shutting down processing", "... shutting down", "done", "all processes on machine")


class NodeFailed(PeerRefused):
    """A node of a resource is not up, and does not come up."""

    def __str__(self) -> str:
        """``node /camera has ended with code 1 …; what to do``."""
        return f"{self.peer} {self.reason}" + (f"; {self.remedy}" if self.remedy else "")


class NodeState(StrEnum):
    """What a resource knows of one of its nodes."""

    # It is not wanted now.
    STOPPED = "stopped"
    STARTING = "starting"
    RUNNING = "running"
    # It has ended, and is started again in a moment, or is expected if it is not started here.
    WAITING = "waiting"
    # It could not be started, or has ended and is not started again.
    FAILED = "failed"


class Processes(RuntimePart):
    """The part that sees to it that the nodes run which the present profile needs.

    Args:
        runtime: The runtime of the resource.
        directory: The folder of the resource's state; ``None``: nothing is noted, and nodes have the output of
            this process.
    """

    def __init__(self, runtime: Runtime, directory: Path | None) -> None:
        super().__init__(runtime)
        resource = runtime.resource
        self._record = directory / programs.RUNS / f"{resource.name}.json" if directory is not None else None
        logs = directory / programs.LOGS if directory is not None else None
        self._nodes: dict[str, _Supervised] = {}
        for key, declared in resource.nodes.items():
            log = logs / f"{resource.name}.{key}.log" if logs is not None else None
            self._nodes[key] = _Supervised(self, runtime, declared, log)
        named = {key for profile in resource.profiles.values() for key in profile.nodes}
        self._always = self._nodes.keys() - named
        # The nodes that have to run now; none before the first profile.
        self._wanted: set[str] = set()
        # Called when a wanted node has ended (true), and when it runs again (false), with a text for people.
        self.on_change: Callable[[ManagedNode, str, bool], None] = lambda _node, _text, _ended: None
        self._writes = asyncio.Lock()
        self._noted: ResourceRun | None = None
        self._complained = False
        self._rotated = 0.0

    async def start(self) -> None:
        """Take over what an earlier run of the resource has started."""
        former = await asyncio.to_thread(ResourceRun.load, self._record) if self._record is not None else None
        for one in former.nodes if former is not None else ():
            if one.mark is None or not one.mark.runs:
                continue
            if (node := self._nodes.get(one.key)) is not None and node.declared.started:
                _log.info("= %s: node %s (process %d) goes on", self._runtime.node.name, one.node, one.pid)
                node.adopt(one)
            else:
                await programs.end_program(one.mark, limits.NODE_END_TIMEOUT)
        await self.note()

    async def close(self) -> None:
        """End what was started here."""
        await asyncio.gather(*(node.down() for node in self._nodes.values()))
        await self.note(LifecycleState.FINALIZED)
        await super().close()

    async def require(self, keys: Collection[str]) -> None:
        """Wait until exactly these nodes are up, of those that profiles name, and all that always run.

        Others that were started here are ended before.

        Raises:
            PeerRefused: One cannot be started, or is not there; the text says which, and has the end of its log.
        """
        self._wanted = {*self._always, *keys}
        await asyncio.gather(*(node.down() for key, node in self._nodes.items() if key not in self._wanted))
        wanted = [node.up() for key, node in self._nodes.items() if key in self._wanted]
        for outcome in await asyncio.gather(*wanted, return_exceptions=True):
            if isinstance(outcome, BaseException):
                raise outcome

    async def restart(self, key: str, *, args: Mapping[str, str] = {}) -> None:
        """End a node and start it again, and wait until it is up; without effect for one that has not to run now.

        Args:
            key: Its declared name.
            args: Arguments of its launch file, which it keeps from now on.

        Raises:
            PeerRefused: It was not started here, or does not come up.
        """
        node = self._nodes[key]
        node.arguments.update(args)
        if key not in self._wanted:
            return
        if not node.own and node.run.state == NodeState.RUNNING:
            problem = f"runs, and was not started by {self._runtime.resource.name}"
            raise NodeFailed(f"node {node.declared.name}", problem, "end it: the resource then starts it itself")
        await node.down()
        await node.up()

    def pid(self, key: str) -> int | None:
        """The process of a node; ``None``: it does not run."""
        run = self._nodes[key].run
        return run.pid or None if run.state == NodeState.RUNNING else None

    def problems(self) -> tuple[list[str], list[str]]:
        """The wanted nodes that do not run."""
        wanted = (node.run for key, node in self._nodes.items() if key in self._wanted)
        lost = (NodeState.WAITING, NodeState.FAILED)
        return [], [f"node {run.node} {run.why}" for run in wanted if run.state in lost]

    def blocked(self) -> dict[str, str]:
        """The profiles whose nodes have failed again and again, with the reason."""
        failed = {key: f"node {node.run.node} {node.run.why}" for key, node in self._nodes.items() if node.gave_up}
        profiles = self._runtime.resource.profiles.values()
        return {one.name: failed[key] for one in profiles for key in one.nodes if key in failed}

    def window_ended(self, measured: Mapping[str, Value]) -> None:  # noqa: ARG002 - the time is what counts
        """Note what has changed, and rotate the logs."""
        self.note_soon()
        if self._nodes and time.monotonic() - self._rotated >= runtime_limits.PROGRAM_LOG_LOOK:
            self._rotated = time.monotonic()
            for log in [node.log for node in self._nodes.values() if node.own and node.log is not None]:
                self._work.start(asyncio.to_thread(programs.rotate_log, log), "rotate a log")

    def note_soon(self) -> None:
        """Note the present state in the file of the resource's run."""
        if self._record is not None and self._run() != self._noted:
            self._work.start(self.note(), "note the nodes")

    async def note(self, state: LifecycleState | None = None) -> None:
        """Write the file of the resource's run, if it has changed."""
        if self._record is None:
            return
        async with self._writes:
            run = self._run(state)
            if run == self._noted:
                return
            try:
                await asyncio.to_thread(run.save, self._record)
                self._noted, self._complained = run, False
            except OSError as error:
                text = "! %s: its nodes cannot be noted: %s; after a crash they are not found [directory-unusable]"
                _log.log(logging.DEBUG if self._complained else logging.WARNING, text, self._runtime.node.name, error)
                self._complained = True

    def _run(self, state: LifecycleState | None = None) -> ResourceRun:
        mark = ProgramMark.of(os.getpid())
        assert mark is not None  # noqa: S101 - this process runs
        nodes = tuple(node.run for node in self._nodes.values())
        return ResourceRun(process=mark, state=state or self._runtime.state, nodes=nodes)


class _Supervised:
    """One node of a resource.

    Args:
        owner: Is told of changes.
        runtime: The runtime of the resource.
        declared: The node's declaration.
        log: Its log; ``None``: its output is that of this process.
    """

    def __init__(self, owner: Processes, runtime: Runtime, declared: ManagedNode, log: Path | None) -> None:
        self.declared = declared
        self.log = log
        # Arguments of the launch file beside the declared ones.
        self.arguments: dict[str, str] = {}
        # What is known of it, as the file of the run has it; ``mark`` is of the program that was started for
        # it, by this run or an earlier one.
        self.run = NodeRun(key=declared.key, node=declared.name, state=NodeState.STOPPED)
        self._uri = ""
        self._owner = owner
        self._runtime = runtime
        self._process: subprocess.Popen[bytes] | None = None  # ``None`` for one of an earlier run
        self._keeper: asyncio.Task[None] | None = None
        self._one = asyncio.Lock()
        self._backoff = Backoff(limits.NODE_RESTART_FIRST, limits.NODE_RESTART_MAX, random.random)
        # Consecutive failures, and when it was given up, in monotonic seconds.
        self._failures = 0
        self._given_up = -limits.NODE_BLOCKED

    @property
    def own(self) -> bool:
        """Whether it was started by the resource."""
        return self.run.mark is not None

    @property
    def gave_up(self) -> bool:
        """Whether it has failed so often that no profile shall need it for a while."""
        failed = self.run.state == NodeState.FAILED and self._failures >= limits.NODE_FAILURES_MAX
        return failed and time.monotonic() - self._given_up < limits.NODE_BLOCKED

    def adopt(self, former: NodeRun) -> None:
        """Take over what an earlier run has started."""
        self._note(mark=former.mark, restarts=former.restarts)

    async def up(self) -> None:
        """Wait until it is up; it is started if it does not run.

        Raises:
            PeerRefused: It does not come up.
        """
        async with self._one:
            if self.run.state == NodeState.RUNNING and self._keeper is not None:
                return
            await end_tasks(self._keeper)
            self._keeper = None
            await self._begin()
            self._keeper = start_task(self._keep(), f"keep {self.declared.name}")

    async def down(self) -> None:
        """End it if it was started here, and watch it no more."""
        async with self._one:
            await end_tasks(self._keeper)
            self._keeper = None
            await self._end()
            self._set(NodeState.STOPPED)

    def _set(self, state: NodeState, why: str = "", pid: int = 0) -> None:
        about = programs.figures(pid) if pid else None
        since = about.since if about is not None else time.time() if pid else 0.0
        self._note(state=state, why=why, pid=pid, since=since)

    def _note(self, **facts: object) -> None:
        self.run = msgspec.structs.replace(self.run, **facts)
        self._owner.note_soon()

    async def _begin(self) -> None:
        """Attach to it or start it.

        Raises:
            PeerRefused: It does not come up.
        """
        name = self.declared.name
        self._set(NodeState.STARTING)
        try:
            pid = await self._find()
            if self.run.mark is not None and not self.run.mark.runs:
                self._note(mark=None)
            if pid is None and self.own:
                pid = await self._wait()  # of an earlier run, or of an attempt that was given up
            elif pid is None and self.declared.started:
                pid = await self._start()
            elif pid is None:
                remedy = "start it, or say in the file how it is started: run, launch or command"
                raise self._refused("does not run", remedy)
        except PeerRefused as error:
            self._failures += 1
            self._given_up = time.monotonic()
            self._set(NodeState.FAILED, error.reason)
            raise
        self._set(NodeState.RUNNING, pid=pid)
        how = "was started" if self.own else "runs already, and is left alone at the end"
        _log.info("= %s: node %s (process %d) %s", self._runtime.node.name, name, pid, how)

    async def _start(self) -> int:
        """Start it, and return its process once it is up."""
        node, declared = self._runtime.node, self.declared
        try:
            command, environ = await asyncio.to_thread(self._prepare)
            for key, value in declared.params.items():
                await call_api(node.master_uri, "setParam", node.name, f"{declared.name}/{key}", value)
            await asyncio.shield(
                start_task(self._spawn(command, environ), f"start {declared.name}", raises=(OSError,))
            )
        except (OSError, ValueError, RmpaError) as error:  # ValueError: of the words of ``run`` and ``launch``
            raise self._refused(f"cannot be started: {error}") from None
        return await self._wait()

    def _prepare(self) -> tuple[list[str], dict[str, str]]:
        """Its command line, which its log tells, and its environment; uses the disk."""
        environ = {"PYTHONUNBUFFERED": "1", **os.environ, "ROS_MASTER_URI": self._runtime.node.master_uri}
        if self.log is not None and not os.access(os.path.expanduser("~"), os.W_OK):  # noqa: PTH111 - there may be none
            environ.setdefault("ROS_HOME", str(self.log.parents[1] / "ros"))  # as of a service; roslaunch logs there
        environ |= self.declared.env
        command = command_of(self.declared, self.arguments, environ)
        if self.log is not None:
            self.log.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with self.log.open("a", encoding="utf-8") as file:
                file.write(f"--- {time.strftime('%F %T')} {shlex.join(command)}\n")
        return command, environ

    async def _spawn(self, command: list[str], environ: Mapping[str, str]) -> None:
        """Start the process, and note it; not to be cancelled in between."""
        self._process = await asyncio.to_thread(
            programs.start_program, command, log=self.log, cwd=self._runtime.resource.folder, env=environ
        )
        self._note(mark=ProgramMark.of(self._process.pid))
        await self._owner.note()

    async def _wait(self) -> int:
        """Wait until it is up, and return its process."""
        loop = asyncio.get_running_loop()
        until = loop.time() + limits.NODE_START_TIMEOUT
        while (pid := await self._find()) is None:
            if self.run.mark is None or not self.run.mark.runs:
                why = f"{how_ended(self._code())} before it was registered by this name"
                raise self._refused(why + await self._log_end())
            if loop.time() > until:
                why = f"was started, and is not registered by this name after {limits.NODE_START_TIMEOUT:g} s"
                end = await self._log_end()
                await self._end()
                raise self._refused(why + end)
            await asyncio.sleep(_LOOK)
        return pid

    async def _find(self) -> int | None:
        """Its process, if it is registered and answers."""
        node = self._runtime.node
        try:
            reply = await call_api(node.master_uri, "lookupNode", node.name, self.declared.name)
            if reply.code != 1:
                return None
            self._uri = str(reply.value)
            answer = await call_api(self._uri, "getPid", node.name, timeout=_ANSWER)
        except RmpaError:
            return None
        return answer.value if answer.code == 1 and isinstance(answer.value, int) else None

    async def _keep(self) -> None:
        """Watch it, and start it again by its policy."""
        while True:
            began = time.monotonic()
            code = await self._gone()
            if time.monotonic() - began >= limits.NODE_STEADY:
                self._backoff.reset()
                self._failures = 0
            self._failures += 1
            own, final = self.own, self._final(code)
            delay = self._backoff.delay() if own else _BACK
            text = how_ended(code)
            if final:
                text += f", and is not started again ({final})"
                self._given_up = time.monotonic()
            self._set(NodeState.FAILED if final else NodeState.WAITING, text + await self._log_end())
            _log.warning("! %s: node %s %s [node-gone]", self._runtime.node.name, self.declared.name, self.run.why)
            self._owner.on_change(self.declared, f"node {self.declared.name} {self.run.why}", True)
            await self._end()  # roslaunch, whose node has ended; what is left of its group
            if final or not await self._again_up(delay):
                return
            self._note(restarts=self.run.restarts + own)
            self._owner.on_change(self.declared, f"node {self.declared.name} runs again", False)

    async def _again_up(self, delay: float) -> bool:
        """Wait until it runs again; false: it is given up."""
        while True:
            await asyncio.sleep(delay)
            own, why = self.declared.started, self.run.why
            with contextlib.suppress(PeerRefused):
                await self._begin()
                return True
            if own and self._failures >= limits.NODE_FAILURES_MAX:
                return False
            if not own:
                self._set(NodeState.WAITING, why)
            delay = self._backoff.delay() if own else _BACK

    def _final(self, code: int | None) -> str:
        """Why it is not started again; empty: it is, or is expected where it was not started here."""
        policy = self.declared.restart
        if not self.own:
            return ""
        if self._failures >= limits.NODE_FAILURES_MAX:
            return f"{self._failures} times in a row"
        if policy is RestartPolicy.ALWAYS or (policy is RestartPolicy.ON_FAILURE and code != 0):
            return ""
        return f'restart = "{policy}"' + (", and it ended in order" if code == 0 else "")

    async def _gone(self) -> int | None:
        """Wait until its process has ended; return the exit code, if it is known."""
        pids = {pid for pid in (self.run.pid, self.run.mark.pid if self.run.mark is not None else 0) if pid}
        host = host_of(self._uri)
        if not (self.own or is_loopback(host) or host in local_addresses() or is_own_name(host)):
            while await self._find() is not None or await self._find() is not None:  # noqa: ASYNC110 - another machine
                await asyncio.sleep(_BACK)
            return None
        waits = [start_task(programs.ended(pid), f"end of process {pid}") for pid in pids]
        try:
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
            await asyncio.wait(waits, timeout=_BACK)  # a script that has run the node ends behind it, with its code
        finally:
            await end_tasks(*waits)
        return self._code()

    def _code(self) -> int | None:
        return self._process.poll() if self._process is not None else None

    async def _end(self) -> None:
        """End what was started for it."""
        if self.run.mark is not None:
            await programs.end_program(self.run.mark, self.declared.stop_after)
            self._note(mark=None)
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):  # it is reaped
                await asyncio.to_thread(self._process.wait, limits.NODE_END_TIMEOUT)
            self._process = None

    def _refused(self, why: str, remedy: str = "") -> NodeFailed:
        return NodeFailed(f"node {self.declared.name}", why, remedy, code="resource-trouble")

    async def _log_end(self) -> str:
        """The end of its log, for texts."""
        if self.log is None or not self.own:
            return ""
        lines, _ = await asyncio.to_thread(programs.read_log, self.log, None, _LOG_SHOWN)
        told = " / ".join(line for line in lines if line.strip() and not line.startswith(_EMPTY))
        return f"; its log ends: {told[-_LOG_TEXT:]}" if told else ""


def command_of(node: ManagedNode, arguments: Mapping[str, str], environ: Mapping[str, str]) -> list[str]:
    """The command line that starts a node; a ``command`` stays as it is written, but for remappings.

    Args:
        node: Its declaration.
        arguments: Arguments of its launch file, beside the declared ones.
        environ: Has ROS's variables, by which packages are found.

    Raises:
        PeerRefused: The executable is not found.
    """
    remap = [f"{ours}:={theirs}" for ours, theirs in node.remap.items()]
    if node.launch:
        given = dict(word.split(":=", 1) for word in node.args if ":=" in word) | dict(arguments)
        words = [word for word in node.args if ":=" not in word]
        words += [f"{name}:={value}" for name, value in given.items()]
        return [*find_program("roslaunch", environ), "--screen", *shlex.split(node.launch), *words]
    if node.command:
        return [*node.command, *node.args, *remap]
    package, executable, *more = shlex.split(node.run)
    namespace, _, base = node.name.rpartition("/")
    own = [f"__name:={base}", f"__ns:={namespace or '/'}"]
    return [*find_executable(package, executable, environ), *more, *node.args, *remap, *own]
