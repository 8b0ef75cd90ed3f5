"""Keeps the state of a resource in a small file, which is replaced as a whole, and restores it at the start."""

from __future__ import annotations

import asyncio
import fcntl
import functools
import logging
import os
import time
from typing import TYPE_CHECKING

import msgspec

from rmpa.resource import limits
from rmpa.resource.decide.saved_state import SavedCoolDown, SavedState
from rmpa.resource.run.runtime import RuntimePart
from rmpa.runtime.process import in_thread

if TYPE_CHECKING:
    from pathlib import Path

    from rmpa.resource.declare.parameters import Parameter
    from rmpa.resource.run.adapter import Adapter
    from rmpa.resource.run.contexts import Contexts
    from rmpa.resource.run.runtime import Runtime

_log = logging.getLogger(__name__)


class Persistence(RuntimePart):
    """The part of a resource that keeps its state.

    No method blocks the event loop, and no failure of the disk stops the resource: it is logged once (``problem``),
    and writing is tried again.

    Args:
        runtime: The runtime of the resource.
        adapter: Provides the requirements, the cool-downs and the profiles to store.
        contexts: Provides the context chosen by hand.
        path: The file; created with its folders if it does not exist.
    """

    def __init__(self, runtime: Runtime, adapter: Adapter, contexts: Contexts, path: Path) -> None:
        self._runtime = runtime
        self._adapter = adapter
        self._contexts = contexts
        self._path = path
        self._lock: int | None = None
        self._started = False
        self._last = ""
        self._written: SavedState | None = None
        """The state that was written last, with times of the monotonic clock."""
        self._writing: asyncio.Task[None] | None = None
        self.problem = ""
        """Why nothing can be stored at present; empty if storing works."""

    async def restore(self) -> SavedState:
        """Read the file, restore the parameters and return the saved state; called before the parts start."""
        resource, name = self._runtime.resource, self._runtime.node.name
        found, lost = SavedState(), list[str]()
        try:
            async with asyncio.timeout(limits.STORE_TIMEOUT):
                found, lost = (await in_thread(self._read, f"read {self._path}")).checked(resource, time.time_ns())
        except OSError as error:
            self._set_problem(str(error) or "it does not answer")
        for text in lost:
            _log.warning("! %s: not remembered: %s", name, text)
        for key, value in found.parameters.items():
            if not resource.parameters[key].given:
                resource.parameters[key].value = value
        if found.parameters or found.chosen or found.requirements:
            chosen = f", profile {found.chosen} chosen by hand" if found.chosen else ""
            counts = len(found.parameters), len(found.requirements)
            _log.info("= %s: remembered: %d parameters, %d clients%s", name, *counts, chosen)
        self._last = found.last
        return found

    async def start(self) -> None:
        """Write the present state, and each change from now on."""
        self._started = True
        self.changed()

    async def close(self) -> None:
        """Write the last state; a disk that hangs is waited for 5 s at most."""
        if self._writing is not None:
            await asyncio.wait([self._writing], timeout=limits.STORE_TIMEOUT)
        if self._started:
            self._started = False
            await asyncio.wait([asyncio.create_task(self._write())], timeout=limits.STORE_TIMEOUT)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def parameter_changed(self, parameter: Parameter) -> None:  # noqa: ARG002
        """Write the parameter's value."""
        self.changed()

    def changed(self) -> None:
        """Write the state if it has changed; called with each window too, so a write that failed is tried again."""
        idle = self._writing is None or self._writing.done()
        if self._started and idle and self._state(0.0, 0) != self._written:
            self._writing = asyncio.create_task(self._write(), name=f"write {self._path}")

    # --- inside -------------------------------------------------------------------------------------------------

    def _state(self, now: float, now_ns: int) -> SavedState:
        """The present state.

        Args:
            now: Monotonic seconds.
            now_ns: The same moment by the clock of the result, in nanoseconds.
        """
        loop = self._adapter.loop
        self._last = loop.profile or self._last
        cooling = loop.cooling(asyncio.get_running_loop().time())
        return SavedState(
            parameters={n: p.value for n, p in self._runtime.resource.parameters.items() if p.value != p.default},
            chosen=loop.pinned,
            last=self._last,
            context=self._contexts.chosen,
            requirements=tuple(self._adapter.clients.save(loop.requirements, now, now_ns)),
            cool_downs={
                name: SavedCoolDown(
                    until_ns=now_ns + round((one.until - now) * 1e9), cool_down=one.cool_down, why=one.why
                )
                for name, one in cooling.items()
            },
        )

    async def _write(self) -> None:
        state = self._state(0.0, 0)
        content = msgspec.json.encode(self._state(asyncio.get_running_loop().time(), time.time_ns()))
        try:
            await in_thread(functools.partial(self._replace, content), f"write {self._path}")
        except OSError as error:
            self._set_problem(str(error))
        else:
            self._written = state
            self._set_problem("")

    def _read(self) -> SavedState:
        """The content of the file; a damaged one is set aside.

        Raises:
            OSError: It cannot be read, or another process uses it.
        """
        self._take_lock()
        try:
            return msgspec.json.decode(self._path.read_bytes(), type=SavedState)
        except FileNotFoundError:
            return SavedState()
        except (msgspec.DecodeError, RecursionError) as error:
            aside = self._path.with_name(f"{self._path.name}.damaged")
            self._path.replace(aside)
            _log.warning("! %s is damaged (%s); it is set aside as %s and begun anew", self._path, error, aside.name)
            return SavedState()

    def _replace(self, content: bytes) -> None:
        """Replace the file, so that a crash at any moment leaves the old one or the new one.

        Raises:
            OSError: It cannot be written, or another process uses it.
        """
        self._take_lock()
        new = self._path.with_name(f"{self._path.name}.new")
        with new.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        new.replace(self._path)

    def _take_lock(self) -> None:
        """Lock the file against a second process: another module of the same name may run the same resource here.

        Raises:
            OSError: Another process holds the lock, or the folder cannot be written.
        """
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if self._lock is not None:
            return
        lock = os.open(self._path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(lock)
            if isinstance(error, BlockingIOError):
                raise OSError("another process uses it; name this module otherwise, or set --state") from None
            raise
        self._lock = lock

    def _set_problem(self, problem: str) -> None:
        """Log a problem when it begins and when it is over."""
        if problem and not self.problem:
            _log.warning("! %s: nothing is kept: %s", self._path, problem)
        elif self.problem and not problem:
            _log.info("= %s: everything is kept again", self._path)
        self.problem = f"nothing is kept: {problem}" if problem else ""
