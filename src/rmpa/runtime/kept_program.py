"""A program that the agent keeps running: it is started again when it ends, and taken over from an agent before.

An agent that ends in order ends its programs. One that is killed leaves them, with their clients, to the next one: a
file notes the process of each. One that is killed within the milliseconds between start and note leaves a program of
which no agent knows.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, Final

import msgspec

from rmpa.runtime.programs import ProgramMark, RunFile, end_program, ended, how_ended, replace_file
from rmpa.runtime.tasks import end_tasks, keep_task, start_task

if TYPE_CHECKING:
    import subprocess
    from pathlib import Path

    from rmpa.core.timers import Backoff

_log = logging.getLogger(__name__)
# The exit code of a command that cannot run as it is written: another start would end alike.
_USAGE: Final = 2
# After a run of this length the next delay is the first one again.
_STEADY: Final = 60.0


class ProgramNote(RunFile, frozen=True):
    """What the file of a program has for the next agent.

    Attributes:
        mark: Its process.
        made_of: What it was started with; with other words it is another program.
        restarts: How often it was started again.
    """

    mark: ProgramMark
    made_of: tuple[str, ...]
    restarts: int = 0


class KeptProgram(ABC):
    """A program, started again with a growing delay whenever it ends; for subclasses.

    Args:
        what: What the log calls it.
        code: Of the warning that it has ended, by ``core.codes``.
        note: The file of its ``ProgramNote``.
        backoff: The delays until it is started again.
        end: Seconds that it has to end before it is killed.

    Attributes:
        may_end: Whether one that ends by itself with code 0 is done.
        unusable: What is said of one that cannot run as it is written.
        mark: Its process, or the last one.
        restarts: How often it was started again after a failure.
        state: ``stopped``, ``starting``, ``stopping`` or ``failed``.
        why: How it has ended, as a text.
    """

    may_end: ClassVar[bool] = False
    unusable: ClassVar[str] = "cannot run as it is written"

    def __init__(self, what: str, code: str, note: Path, backoff: Backoff, end: float) -> None:
        self.mark: ProgramMark | None = None
        self.restarts = 0
        self.state = "stopped"
        self.why = ""
        self._what = what
        self._code = code
        self._note = note
        self._backoff = backoff
        self._end = end
        self._child: subprocess.Popen[bytes] | None = None  # ``None`` too if an agent before has started it
        self._keeper: asyncio.Task[None] | None = None
        self._starting: asyncio.Task[None] | None = None
        self._one = asyncio.Lock()

    @property
    @abstractmethod
    def made_of(self) -> tuple[str, ...]:
        """As of ``ProgramNote``."""

    @abstractmethod
    def launch(self) -> subprocess.Popen[bytes]:
        """Start the process; it may block.

        Raises:
            OSError: It cannot be started.
        """

    @property
    def runs(self) -> bool:
        """Whether its process runs."""
        return self.mark is not None and self.mark.runs

    def adopt(self, note: ProgramNote) -> None:
        """Take over the process that an agent before has started."""
        self.mark, self.restarts = note.mark, note.restarts
        _log.info("= %s (process %d) goes on, of the agent before", self._what, note.mark.pid)
        self.keep()

    def keep(self) -> None:
        """Look after it until ``stop``; one that was never started is started."""
        self._keeper = keep_task(self._keep, self._what)

    async def start(self) -> None:
        """Start it if it does not run.

        Raises:
            OSError: It cannot be started.
        """
        async with self._one:
            if not self.runs:
                await end_tasks(self._keeper)
                self._backoff.reset()
                self.restarts = 0
                await self._spawn()
                self.keep()

    async def stop(self) -> None:
        """End it with all that it has started, also one that an agent before has left, and wait for the end."""
        async with self._one:
            await end_tasks(self._keeper)
            self._keeper, self.state, self.why = None, "stopping", ""
            if self._starting is not None:
                await asyncio.wait([self._starting])
            if self.mark is None and (note := await asyncio.to_thread(ProgramNote.load, self._note)) is not None:
                self.mark = note.mark
            if self.mark is not None and self.runs:
                await end_program(self.mark, self._end)
            if self._child is not None:
                self._child.poll()  # it is reaped
            left = await asyncio.to_thread(self.left)
            await asyncio.gather(*(end_program(mark, self._end) for mark in left))
            with contextlib.suppress(OSError):
                await asyncio.to_thread(self._note.unlink)
            self.state = "stopped"

    def left(self) -> list[ProgramMark]:
        """The programs that its process has left, which has ended; it may block."""
        return []

    async def _spawn(self) -> None:
        """Start the process; it is noted even if this task is cancelled meanwhile.

        Raises:
            OSError: It cannot be started.
        """

        def spawn() -> None:
            self._child = self.launch()
            pid = self._child.pid
            self.mark = ProgramMark.of(pid) or ProgramMark(pid, 0, "")
            self.state, self.why = "starting", ""
            note = ProgramNote(self.mark, self.made_of, self.restarts)
            try:
                self._note.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                replace_file(self._note, msgspec.json.encode(note))
            except OSError as error:
                text = "! %s cannot be noted for the next agent: %s [directory-unusable]"
                _log.warning(text, self._what, error)

        self._starting = start_task(asyncio.to_thread(spawn), f"start {self._what}", raises=(OSError,))
        await asyncio.shield(self._starting)

    async def _keep(self) -> None:
        due = self.mark is None
        said: dict[int | None, str] = {0: "ended in order", _USAGE: self.unusable}
        while True:
            began = time.monotonic()
            code: int | None = None
            try:
                if due:
                    await self._spawn()
                if self.mark is not None:
                    await ended(self.mark.pid)
                due, code = True, self._child.poll() if self._child is not None else None
                self.state = "stopped" if code == 0 else "failed"
                self.why = said.get(code, how_ended(code))
            except OSError as error:
                due = not self.runs
                self.state, self.why = "failed", f"cannot be started: {error.strerror}"
            if code == 0 and self.may_end:
                _log.info("= %s %s", self._what, self.why)
                return
            if code == _USAGE:
                _log.warning("! %s %s; it is not started again [%s]", self._what, self.why, self._code)
                return
            if time.monotonic() - began >= _STEADY:
                self._backoff.reset()
            delay = self._backoff.delay()
            text = "! %s %s; it is started again in %.1f s [%s]"
            _log.warning(text, self._what, self.why, delay, self._code)
            self.why += f"; it is started again in {delay:.0f} s"
            await asyncio.sleep(delay)
            self.restarts += due
