"""The recordings of all modules as files: ``/recording/ID.mcap``, ``.bag``, and its story as ``.json`` and ``.html``.

A file is made when it is asked for, by ``rmpa record fetch``, ``rmpa record merge`` and ``rmpa story``, each a
process of its own: nothing of ``rmpa.record`` runs here. All that ask for one file wait for the same processes, which
end with the last of them. ``?progress`` tells how far it is, a JSON object a line; the last one has ``ready``, or
``error``.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import subprocess
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

import msgspec
from aiohttp import web

from rmpa.bridge.kept import check_id
from rmpa.config.peer_rules import Access
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, missing_extra
from rmpa.runtime.interpreter import own_command
from rmpa.runtime.tasks import OwnedTasks, end_tasks, start_task
from rmpa.web import limits
from rmpa.web.server.access import Problem, guard_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rmpa.web.hub.node_link import NodeRules

ROUTE: Final = "/recording/{name}"
_TYPES: Final = dict.fromkeys(("mcap", "bag", "html"), "application/octet-stream") | {"json": "application/json"}
_NO_TOKEN: Final = "recordings need a token: start rmpa web with --token-file FILE, or --control"  # noqa: S105 - a text
_CHUNK: Final = 1 << 18
_NICENESS: Final = 10  # the robot goes first


@dataclass(slots=True)
class _Making:
    """A file that is being made, for all that wait for it: their number, how far it is, and what becomes of it."""

    users: int = 0
    told: dict[str, Any] = field(default_factory=lambda: {"doing": "wait"})
    task: asyncio.Task[dict[str, Any]] | None = None


class RecordingFiles:
    """Makes and sends them.

    Args:
        rules: What clients may do.
        folder: Where files are made; ``None``: there is no state directory.
        agent: Returns the agent's name; empty for the only one.
        view: Whether clients have a token.
        command: Makes the command line of a command of rmpa.
    """

    def __init__(
        self,
        rules: NodeRules,
        folder: Path | None,
        agent: Callable[[], str],
        *,
        view: bool,
        command: Callable[..., list[str]] = own_command,
    ) -> None:
        self._rules = rules
        self._folder = folder
        self._agent = agent
        self._view = view
        self._command = command
        # One process at a time: each takes a core.
        self._turn = asyncio.Lock()
        self._makings: dict[str, _Making] = {}
        self._idle = OwnedTasks()

    async def clear(self, after: float = 0.0) -> None:
        """Remove all files, also those that a server left that was killed."""
        await asyncio.sleep(after)
        if self._folder is not None:
            gone = self._folder.with_suffix(".gone")
            await asyncio.to_thread(shutil.rmtree, gone, ignore_errors=True)
            with contextlib.suppress(OSError):  # there is none
                self._folder.rename(gone)  # at once: files may be asked for meanwhile
            await asyncio.to_thread(shutil.rmtree, gone, ignore_errors=True)

    async def end(self) -> None:
        """End the processes; requests that wait for them end, too."""
        await end_tasks(*(each.task for each in self._makings.values()))

    async def close(self) -> None:
        """Remove all files, when no request is left."""
        await self._idle.close()
        await self.clear()

    async def respond(self, request: web.Request) -> web.StreamResponse:
        """A response to a request for a file.

        Raises:
            Problem: There is none, or it cannot be made.
        """
        name = request.match_info["name"]
        recording, _, kind = name.rpartition(".")
        try:
            if not self._view:
                raise PeerRefused("the web server", _NO_TOKEN)
            self._rules.check(Access.RECORD, f"/{check_id(recording)}")
        except RmpaError as error:
            raise Problem(403 if isinstance(error, PeerRefused) else 404, str(error)) from None
        if kind not in _TYPES:
            raise Problem(404, f"there is no kind {kind[:20]!a} of files; these are: {', '.join(_TYPES)}")
        if name not in self._makings and len(self._makings) >= limits.RECORDINGS_WAITING:
            raise Problem(429, "files of other recordings are being made; ask again later")
        self._idle.cancel()
        making = self._makings.setdefault(name, _Making())
        making.task = making.task or start_task(self._make(making, recording, kind), f"make {name}")
        making.users += 1
        if (guard := guard_of(request)) is not None:
            guard.stream(lambda: None)  # it may take minutes
        response = web.StreamResponse(headers={"Content-Type": _TYPES[kind]})
        response.force_close()  # its guard expects no further request
        try:
            told = await self._follow(request, response, making, making.task)
            if told is not None and "error" in told:
                raise Problem(502, told["error"])
            if told is not None:
                await _send(request, response, self._path(recording, kind))
        except (OSError, TimeoutError):  # the client has gone, or takes nothing
            if request.transport is not None:
                request.transport.abort()
        finally:
            making.users -= 1
            if not making.users:
                del self._makings[name]
                await end_tasks(making.task)
                if not self._makings:
                    self._idle.cancel()
                    self._idle.start(self.clear(limits.RECORDINGS_KEPT), "remove files of recordings")
        return response

    async def _follow(
        self,
        request: web.Request,
        response: web.StreamResponse,
        making: _Making,
        task: asyncio.Task[dict[str, Any]],
    ) -> dict[str, Any] | None:
        """Wait for what becomes of a file; ``None``: the client was told, or has gone."""
        if tells := "progress" in request.query:
            response.headers["Content-Type"] = "application/x-ndjson"
            await response.prepare(request)
        shown: dict[str, Any] = {}
        while request.transport is not None and not request.transport.is_closing():
            if task.done():
                making.told = {"error": "rmpa web ends"} if task.cancelled() else task.result()
            if tells and making.told is not shown:
                shown = making.told
                await _write(response, msgspec.json.encode(shown) + b"\n")
            if task.done():
                return None if tells else making.told
            await asyncio.wait((task,), timeout=limits.RECORDING_LOOK)
        return None

    def _path(self, recording: str, kind: str) -> Path:
        if self._folder is None:
            raise ConfigError("rmpa web", "there is no state directory for files", "set RMPA_STATE_DIR")
        return self._folder / recording / f"{recording}.{kind}"

    async def _make(self, making: _Making, recording: str, kind: str) -> dict[str, Any]:
        """Make a file unless it is there; what becomes of it."""
        try:
            whole = self._path(recording, "mcap")
            async with self._turn, asyncio.timeout(limits.RECORDING_TIME):
                there = await asyncio.to_thread(_use, whole.parent)
                await self._steps(making, whole, {"html": "json"}.get(kind, kind), there)
        except TimeoutError:
            text = f"it is not made within {limits.RECORDING_TIME:g} s; in a terminal: rmpa record fetch {recording}"
            return {"error": text, "code": "limit-reached"}
        except RmpaError as error:
            return {"error": str(error), "code": error.code}
        except OSError as error:
            return {"error": f"files of recordings cannot be written: {error}", "code": "directory-unusable"}
        return {"ready": True}

    async def _steps(self, making: _Making, whole: Path, kind: str, there: set[str]) -> None:
        parts, made, wanted = whole.with_name("parts"), whole.with_name("made"), whole.with_suffix(f".{kind}")
        if whole.name not in there:
            if find_spec("mcap") is None or find_spec("jinja2") is None:
                text = f"this module has not the extra record; run {missing_extra('record')}"
                raise RmpaError(text, code="extra-missing")
            words = whole.stem, "-o", str(parts), *(("--agent", agent) if (agent := self._agent()) else ())
            await self._run(making, "fetch", parts, "record", "fetch", *words)  # it goes on where it ended
            await self._run(making, "merge", made, "record", "merge", str(parts), "-o", str(made / whole.name))
            (made / whole.name).replace(whole)
            await asyncio.to_thread(shutil.rmtree, parts)
        if wanted.name not in there and kind == "bag":
            await self._run(making, kind, made, "record", "merge", str(whole), "-o", str(made / wanted.name))
            (made / wanted.name).replace(wanted)
        elif wanted.name not in there and kind == "json":
            await self._run(making, "story", made, "story", str(whole), "-o", str(whole.with_suffix(".html")))
            whole.with_name("result").replace(wanted)

    async def _run(self, making: _Making, doing: str, grows: Path, *words: str) -> None:
        """Run a command to its end, its answer into a file; tell how many bytes a folder has."""
        result, size = grows.with_name("result"), 0
        with result.open("wb") as file:
            command = self._command(*words, "--json")
            child = await asyncio.create_subprocess_exec(*command, stdin=subprocess.DEVNULL, stdout=file)
        try:
            with contextlib.suppress(ProcessLookupError):
                os.setpriority(os.PRIO_PROCESS, child.pid, _NICENESS)
            while child.returncode is None:
                making.told = {"doing": doing, "size": size}
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(child.wait(), limits.RECORDING_LOOK)
                size = await asyncio.to_thread(_check_room, result.parents[1], grows)
        finally:
            if child.returncode is None:
                child.kill()
                await child.wait()
        if child.returncode:
            told: dict[str, Any] = {}
            with contextlib.suppress(msgspec.DecodeError):
                told = msgspec.json.decode(result.read_bytes(), type=dict[str, Any])
            if "damaged" not in told:  # a merge leaves out files that it cannot read
                text = f"rmpa {words[0]} ended with {child.returncode}; the log of rmpa web says why"
                raise RmpaError(told.get("error", text), code=told.get("code", "failed"))


def _use(folder: Path) -> set[str]:
    """Make a recording's folder, and remove those that were used longest ago; the names of what is in it."""
    shutil.rmtree(folder / "made", ignore_errors=True)
    (folder / "made").mkdir(parents=True, exist_ok=True)
    for old in sorted(folder.parent.iterdir(), key=lambda each: each.stat().st_mtime)[: -limits.RECORDINGS_CACHED]:
        shutil.rmtree(old, ignore_errors=True)
    return {each.name for each in folder.iterdir()}


def _check_room(root: Path, grows: Path) -> int:
    """Check the bounds of all files of recordings; return the bytes of those in one folder."""
    if shutil.disk_usage(root).free < limits.RECORDING_FREE:
        text = f"the disk of this module is almost full: {limits.RECORDING_FREE >> 20} MiB stay free; make room"
        raise RmpaError(text, code="directory-unusable")
    size = own = 0
    for path in root.rglob("*"):
        with contextlib.suppress(OSError):  # it is gone
            size += (each := path.stat().st_size)
            own += each * (grows in path.parents)
    if size > limits.RECORDING_BYTES:
        text = f"its files have more than {limits.RECORDING_BYTES >> 30} GiB; in a terminal: rmpa record fetch"
        raise RmpaError(text, code="limit-reached")
    return own


async def _send(request: web.Request, response: web.StreamResponse, path: Path) -> None:
    with path.open("rb") as file:
        response.content_length = os.fstat(file.fileno()).st_size
        response.headers["Content-Disposition"] = f'attachment; filename="{path.name}"'
        await response.prepare(request)
        while data := await asyncio.to_thread(file.read, _CHUNK):
            await _write(response, data)


async def _write(response: web.StreamResponse, data: bytes) -> None:
    async with asyncio.timeout(limits.WEB_RESPONSE_TIMEOUT):
        await response.write(data)
