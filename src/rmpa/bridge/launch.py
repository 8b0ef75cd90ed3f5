"""Starts, stops and restarts the resources of this module, and tells peers that may ask of them and of their logs.

Each is a process ``rmpa run FILE`` in a session of its own, of a file in the module's own folder. What crosses the
mesh is a resource's name: never a path, a command, an argument or a variable. A process survives an agent that is
killed, and the next one takes it over; an agent that ends in order ends it.
"""

from __future__ import annotations

import asyncio
import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.launched import (
    REFUSED,
    LaunchFile,
    ModuleResources,
    ResourceProgram,
    circles,
    is_name,
    list_files,
    load_runs,
)
from rmpa.bridge.policy import Needs
from rmpa.bridge.rpc import gate_for, meant, no_such_module
from rmpa.bridge.sessions import Part, PeerSession
from rmpa.config.module_name import module_dir, state_dir
from rmpa.config.peer_rules import Access
from rmpa.config.values import suggestion
from rmpa.core.errors import RmpaError
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.kept_program import ProgramNote
from rmpa.runtime.programs import RUNS, CpuShares, ResourceRun, StartRule
from rmpa.runtime.tasks import OwnedTasks, end_tasks, keep_task
from rmpa.trust.permissions import PermissionDecision, asker_name, refusal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.bridge import Bridge

_log = logging.getLogger(__name__)

# The request about resources: ``what``, and for all but ``list`` a ``name``; the response is ``ModuleResources``.
LAUNCH: Final = "launch"
LIST: Final = "list"
LOG: Final = "log"
# What can be asked for, with what the log says of it.
ACTS: Final = {LIST: "", "start": "starts", "stop": "stops", "restart": "restarts", LOG: ""}
# Seconds between two looks at what resources tell of themselves, while a start waits for it.
_LOOK: Final = 0.1
# Seconds between two looks whether the conditions of a start at boot hold.
_BOOT_LOOK: Final = 0.5


class Launcher(Part):
    """The part of the bridge that starts resources.

    Args:
        bridge: The core, the peers and the rules.

    Attributes:
        shares: The processor time of nodes.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._launched: dict[str, ResourceProgram] = {}
        # The resources that wait for the conditions of their start at boot.
        self._waiting: dict[str, StartRule] = {}
        self._work = OwnedTasks()
        self._main: asyncio.Task[None] | None = None
        self.shares = CpuShares()
        bridge.rpc.on_request(LAUNCH, self._asked, Needs((Access.LAUNCH,), "the resource; lists leave others out"))

    def start(self) -> None:
        """Take over what an agent before has started, and start what is to run from the boot on."""
        if self._bridge.context.settings.resources.folder:
            self._main = keep_task(self._run, "resources")

    async def close(self) -> None:
        """End all that runs."""
        await end_tasks(self._main)
        self._waiting.clear()
        await self._work.close()
        await asyncio.gather(*(one.stop() for one in self._launched.values()))

    @property
    def _name(self) -> str:
        return self._bridge.context.settings.name

    @property
    def _folder(self) -> Path:
        """The folder of this module's resources.

        Raises:
            RmpaError: The settings name none.
        """
        if not (folder := self._bridge.context.settings.resources.folder):
            text = f"{self._name} starts nothing: set folder of [resources] in its rmpa.toml"
            raise RmpaError(text, code=REFUSED)
        return Path(folder).expanduser()

    @property
    def _state(self) -> Path:
        """The folder of this module's state.

        Raises:
            RmpaError: There is none.
        """
        settings = self._bridge.context.settings
        directory = state_dir(os.environ, settings.state_dir or None)
        if directory is None:
            raise RmpaError("there is no state directory: set RMPA_STATE_DIR", code="no-state-directory")
        return module_dir(directory, settings.name)

    async def _files(self) -> dict[str, LaunchFile]:
        return await asyncio.to_thread(list_files, self._folder, os.environ)

    async def _run(self) -> None:
        await self._adopt()
        if self._bridge.context.settings.resources.start:
            self._work.start(self._boot(), "start resources at boot")
        while True:
            await asyncio.sleep(runtime_limits.PROGRAM_LOG_LOOK)
            for one in [*self._launched.values()]:
                if one.runs:
                    await asyncio.to_thread(one.rotate)

    async def _adopt(self) -> None:
        """Take over the processes that an agent before has started."""
        try:
            notes = await asyncio.to_thread(_load_notes, self._state)
        except RmpaError:
            return
        for name, note in notes.items():
            one = self._of(name, self._folder / note.made_of[0])
            if not note.mark.runs and one.mark is None:
                one.mark, one.restarts = note.mark, note.restarts  # its nodes may still run
            elif note.mark.runs and not one.runs:
                one.adopt(note)

    def _of(self, name: str, path: Path) -> ResourceProgram:
        if name not in self._launched:
            self._launched[name] = ResourceProgram(name, path, self._state, self._bridge)
        self._launched[name].path = path
        return self._launched[name]

    async def _boot(self) -> None:
        try:
            files = await self._files()
        except RmpaError as error:
            _log.warning("! no resource is started: %s [%s]", error, error.code)
            return
        rules = {name: one.rule for name, one in files.items() if one.rule.boot}
        lost = {name: f"waits for itself: {way}" for name, way in circles(rules).items()}
        for name, rule in rules.items():
            one = self._of(name, files[name].path)
            if missing := [each for each in rule.after if each not in files]:
                lost[name] = f"waits for {', '.join(missing)}, which is not in the folder"
            if name in lost:
                one.state, one.why = "failed", lost[name]
                _log.warning("! resource %s is not started: it %s [launch-refused]", name, lost[name])
            elif not one.runs:
                one.state = "waiting"
                self._waiting[name] = rule
        held: dict[str, float] = {}
        while self._waiting:
            await self._start_due(held)
            await asyncio.sleep(_BOOT_LOOK)

    async def _start_due(self, held: dict[str, float]) -> None:
        """Start the resources whose conditions have held for their delay.

        Args:
            held: Since when those of each hold, in monotonic seconds.
        """
        runs, now = await asyncio.to_thread(load_runs, self._state), asyncio.get_running_loop().time()
        for name, rule in [*self._waiting.items()]:
            one = self._launched[name]
            missing = [topic for topic in rule.topics if not self._bridge.core.publishers(topic)]
            missing += [other for other in rule.after if not self._is_active(other, runs)]
            if missing:
                held.pop(name, None)
                one.why = f"waits for {', '.join(missing)}"
            elif now < (due := held.setdefault(name, now) + rule.delay):
                one.why = f"is started in {due - now:.0f} s"
            elif self._waiting.pop(name, None) is not None:
                self._work.start(self._start_at_boot(one), f"start {name}")

    async def _start_at_boot(self, one: ResourceProgram) -> None:
        try:
            await self._start(one)
        except RmpaError as error:
            one.state, one.why = "failed", str(error)
            _log.warning("! resource %s is not started: %s [%s]", one.name, error, error.code)

    def _is_active(self, name: str, runs: Mapping[str, ResourceRun]) -> bool:
        one = self._launched.get(name)
        its = one.its(runs) if one is not None else []
        its = its or [run for key, run in runs.items() if key == name]
        return bool(its) and all(run.state == "active" and run.process.runs for run in its)

    async def _start(self, one: ResourceProgram) -> None:
        """Start a resource that does not run.

        Raises:
            RmpaError: It is not to be started, or cannot be.
        """
        self._waiting.pop(one.name, None)
        file = (await self._files()).get(one.name)
        if file is None or file.problem:
            raise RmpaError(file.problem if file is not None else f"{one.path.name} is gone", code=REFUSED)
        other = (await asyncio.to_thread(load_runs, self._state)).get(one.name)
        if other is not None and other.process.runs and other.process != one.mark:
            text = f"it runs already, and was started by hand (process {other.process.pid})"
            raise RmpaError(text, code=REFUSED)
        try:
            await one.start()
        except OSError as error:
            one.state, one.why = "failed", f"cannot be started: {error.strerror}"
            raise RmpaError(f"{one.name} {one.why}", code="resource-stopped") from None

    async def starters(self) -> dict[str, str]:
        """The resources that have started nodes of this module, by node."""
        try:
            runs = await asyncio.to_thread(load_runs, self._state)
        except RmpaError:
            return {}
        return {node.node: name for name, run in runs.items() for node in run.nodes if node.mark and node.mark.runs}

    async def _asked(self, asker: PeerSession | None, args: Mapping[str, Any]) -> ModuleResources:
        """Answer a peer, or a program of this machine; a problem is a part of the answer.

        Of a peer only a name crosses, and it is judged before anything is read.

        Raises:
            RmpaError: The peer may not.
        """
        if asker is not None:
            self._check(asker, args.get("what"), args.get("name"))
        try:
            return await self._do(asker, args)
        except RmpaError as error:
            if error.code == "not-permitted":
                raise
            return ModuleResources(module=self._name, problem=str(error), code=error.code)

    def _check(self, asker: PeerSession, what: object, name: object) -> None:
        gate, peer = gate_for(self._bridge, asker)
        if not gate.on and not self._bridge.context.settings.resources.open:
            rule = "the mesh is not secured, and open of [resources] is false"
            gate.refused(Access.LAUNCH, peer, "a resource", PermissionDecision(False, rule))
            raise RmpaError(f"{self._name} starts nothing for others: {rule}", code="not-permitted")
        if what == LIST:
            return
        if not is_name(name):
            raise RmpaError("the request names no resource: letters, digits and _", code="unknown-name")
        if why := gate.why_not(Access.LAUNCH, peer, f"/{name}"):
            raise RmpaError(why, code="not-permitted")
        if verb := ACTS.get(str(what)):
            _log.info("= %s %s resource %s", asker_name(peer), verb, name)

    async def answer(self, args: Mapping[str, Any]) -> list[ModuleResources]:
        """Answer a program of this machine: ``what`` of the resource ``name``, here or at a peer, a ``module``.

        Without a module a list is that of all modules, and everything else is about this one.
        """
        request = {key: args[key] for key in ("what", "name", "after", "lines") if args.get(key) is not None}
        sessions, module = [*self._bridge.sessions.linked()], args.get("module")
        if module is None and request.get("what") == LIST:
            others = (self._ask(one, request) for one in sessions)
            return [await self._asked(None, request), *await asyncio.gather(*others)]
        if module in (None, self._name):
            return [await self._asked(None, request)]
        if fitting := meant(sessions, module):
            return [await self._ask(fitting[0], request)]
        error = no_such_module(str(module), self._name, sessions)
        return [ModuleResources(module=str(module), problem=str(error), code=error.code)]

    async def _ask(self, session: PeerSession, request: dict[str, Any]) -> ModuleResources:
        quick = request.get("what") in (LIST, LOG)
        timeout = limits.ASK_TIMEOUT if quick else limits.LAUNCH_ASK_TIMEOUT
        return await self._bridge.rpc.ask(session, LAUNCH, request, ModuleResources, timeout)

    async def _do(self, asker: PeerSession | None, args: Mapping[str, Any]) -> ModuleResources:
        what, name, (gate, peer) = str(args.get("what")), args.get("name"), gate_for(self._bridge, asker)
        if what not in ACTS:
            raise RmpaError(f"{what[:64]!r} is no question; there are {', '.join(ACTS)}", code="invalid-value")
        files = await self._files()
        permitted = [one for one in files.values() if gate.judge(Access.LAUNCH, peer, f"/{one.name}").allowed]
        if what == LIST:
            if files and not permitted:
                raise RmpaError(refusal(Access.LAUNCH, peer, "any resource"), code="not-permitted")
            runs = await asyncio.to_thread(load_runs, self._state)
            told = tuple(self._of(file.name, file.path).told(file, runs, self.shares) for file in permitted)
            return ModuleResources(module=self._name, resources=told)
        if not is_name(name) or (str(name) not in files and str(name) not in self._launched):
            known = [file.name for file in permitted]
            near = suggestion(str(name), known, "`rmpa resource list` shows what can be started")
            raise RmpaError(f"{self._name} has no file of a resource {str(name)[:64]!r}; {near}", code="unknown-name")
        if what != LOG:
            return await self._act(what, str(name), files)
        one = self._launched.get(str(name)) or self._of(str(name), files[str(name)].path)
        logs = await asyncio.to_thread(one.logs, args.get("after"), args.get("lines"))
        return ModuleResources(module=self._name, logs=tuple(logs))

    async def _act(self, what: str, name: str, files: Mapping[str, LaunchFile]) -> ModuleResources:
        """Start, stop or restart a resource; return when that is done, or has failed, or takes long."""
        file = files.get(name) or LaunchFile(name, self._launched[name].path, "its file is gone")
        one = self._of(name, file.path)
        change = self._work.start(self._change(what, one), f"{what} {name}", raises=(RmpaError,))
        await asyncio.wait([change], timeout=limits.LAUNCH_WAIT)  # it goes on where the asking program gives up
        if change.done():
            change.result()
        told = one.told(file, await asyncio.to_thread(load_runs, self._state), self.shares)
        if what == "stop" or told.state != "failed":
            return ModuleResources(module=self._name, resources=(told,))
        logs = await asyncio.to_thread(one.logs, None, 1)
        problem = f"{name} {told.why}; its log ends: {' '.join(logs[0].lines)}"
        return ModuleResources(module=self._name, resources=(told,), problem=problem, code="resource-stopped")

    async def _change(self, what: str, one: ResourceProgram) -> None:
        if what != "start":
            self._waiting.pop(one.name, None)
            await one.stop()
        if what != "stop":
            await self._start(one)
            await self._settle(one)

    async def _settle(self, one: ResourceProgram) -> None:
        """Wait until a resource is active, has failed, or takes longer than the answer may."""
        loop = asyncio.get_running_loop()
        until = loop.time() + limits.LAUNCH_WAIT
        while loop.time() < until and one.state == "starting":
            if self._is_active(one.name, await asyncio.to_thread(load_runs, self._state)):
                return
            await asyncio.sleep(_LOOK)


def _load_notes(state: Path) -> dict[str, ProgramNote]:
    """The notes of the programs that an agent before has started, by the names of their resources; reads the disk."""
    notes = {path.name[1:-5]: ProgramNote.load(path) for path in (state / RUNS).glob(".*.json")}
    return {name: note for name, note in notes.items() if note is not None}
