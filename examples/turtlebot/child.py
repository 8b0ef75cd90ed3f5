"""One child process: in a group of its own, gone when we are gone, its words heard.

A child may have children of its own in other groups (``rmpa run`` has its agent).
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import signal
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
TAIL = 30
"""Lines that are kept of what a child says."""
_libc = ctypes.CDLL(None)


class Child:
    """A running process; made by ``Child.start``."""

    def __init__(self, name: str, process: asyncio.subprocess.Process) -> None:
        self.name = name
        self.process = process
        self.tail: deque[str] = deque(maxlen=TAIL)
        """The last lines that it wrote to its standard error."""
        self.ours = False
        """Whether we ended it; else its end is news."""
        self._listening: list[asyncio.Task[None]] = []

    @classmethod
    async def start(
        cls,
        name: str,
        argv: Sequence[str],
        env: Mapping[str, str],
        heard: Callable[[str], None],
        *,
        piped: bool,
        said: Callable[[str], None] | None = None,
    ) -> Child:
        """Start it; ``heard`` is called with each line of its standard error.

        Args:
            name: For messages.
            argv: What to execute.
            env: All of its variables.
            heard: Told its standard error, line by line.
            piped: Whether it reads from us, and writes to our standard output.
            said: Told its standard output, line by line, which is thrown away otherwise.
        """
        us = os.getpid()
        unheard = asyncio.subprocess.DEVNULL if said is None else asyncio.subprocess.PIPE
        process = await asyncio.create_subprocess_exec(
            *argv,
            env=env,
            stdin=asyncio.subprocess.PIPE if piped else asyncio.subprocess.DEVNULL,
            stdout=None if piped else unheard,
            stderr=asyncio.subprocess.PIPE,
            process_group=0,
            preexec_fn=lambda: _die_with(us),
        )
        child = cls(name, process)
        for stream, told in ((process.stderr, child._hear(heard)), (process.stdout, said)):
            if stream is not None and told is not None:
                child._listening.append(asyncio.create_task(_listen(stream, told), name=f"listen to {name}"))
        return child

    @property
    def pid(self) -> int:
        """Its process id, which is its group's too."""
        return self.process.pid

    @property
    def runs(self) -> bool:
        """Whether it has not ended."""
        return self.process.returncode is None

    def send(self, number: signal.Signals) -> None:
        """Send a signal to it and its children; whatever comes of that is our doing."""
        self.ours = True
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, number)

    def pids(self) -> list[int]:
        """Of its children, and its own."""
        found: list[int] = []
        with contextlib.suppress(OSError):
            for task in Path(f"/proc/{self.pid}/task").iterdir():
                found += map(int, (task / "children").read_text(encoding="ascii").split())
        return [*found, self.pid]

    async def kill(self) -> None:
        """``kill -9`` of it and its children; returns when none of them is there any more."""
        if not self.runs:
            return
        self.ours = True
        *children, _ = self.pids()
        # The children first: they must not hear that their parent is gone, and say goodbye.
        for pid in children:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.send(signal.SIGKILL)
        await self.ended()
        for pid in children:
            with contextlib.suppress(ChildProcessError):  # its parent has seen its end
                await asyncio.to_thread(os.waitpid, pid, 0)

    def tell(self, line: bytes) -> None:
        """Write to its standard input; a child that has ended does not hear it."""
        if self.runs and self.process.stdin is not None and not self.process.stdin.is_closing():
            self.process.stdin.write(line)

    async def ended(self, within: float | None = None) -> int | None:
        """Wait for its end, at most so many seconds; its exit status, or ``None`` while it runs."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self.process.wait(), within)
            await asyncio.gather(*self._listening)
        return self.process.returncode

    def _hear(self, heard: Callable[[str], None]) -> Callable[[str], None]:
        def keep(text: str) -> None:
            self.tail.append(text)
            heard(text)

        return keep


async def _listen(stream: asyncio.StreamReader, told: Callable[[str], None]) -> None:
    while True:
        try:
            line = await stream.readline()
        except ValueError:
            continue  # a line beyond asyncio's limit: dropped
        if not line:
            return
        told(line.decode(errors="replace").rstrip())


def adopt() -> None:
    """Have the kernel give us the children of children that die."""
    _libc.prctl(PR_SET_CHILD_SUBREAPER, 1)


def _die_with(parent: int) -> None:
    """Between fork and exec: have the kernel kill us when the parent dies, however it dies."""
    _libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
