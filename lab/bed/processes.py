"""Child processes of experiments, measurements and tests: their lines, their signals, and their certain end.

A program of ``nodes/`` writes what its caller wants to know as lines of ``@ {"event": …}``; everything else is log.
Start processes from the main thread: the kernel then kills them when this process dies in any way.
"""

from __future__ import annotations

import abc
import asyncio
import atexit
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self, TypeVar

from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

# Seconds that a caller waits for a line at the most: generous, because machines are shared.
DEADLINE: Final = 40.0
# Seconds from SIGTERM to SIGKILL when a process is only to be gone.
_END_AFTER: Final = 4.0

Event = dict[str, object]
T = TypeVar("T")
# What starts a process; tests may put something quicker in its place.
spawn: Callable[..., subprocess.Popen[str]] = subprocess.Popen


class Closing(abc.ABC):
    """Is closed at the end of its ``with``."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abc.abstractmethod
    def close(self) -> None:
        """End it, with all that it has started."""


class BedError(RmpaError):
    """What takes part in an experiment did not do what it should; the text says what, with its last lines."""


class Deadline(BedError):  # noqa: N818 - reads as what happened
    """A process did not say or do in time what was waited for."""


class CommandFailed(BedError):  # noqa: N818 - likewise
    """A command that was run to its end did not end well."""


class Process:
    """One child in a process group of its own, its output (both streams) read line by line.

    Args:
        argv: The command.
        env: Its whole environment.
        commands: Whether ``tell`` can write to its standard input, which is empty otherwise.
        name: How failures call it; default: the command's last path component.
        log: A file that gets every line as well.
        pass_fds: File descriptors that it inherits.
    """

    def __init__(
        self,
        argv: Sequence[str | Path],
        *,
        env: Mapping[str, str] | None = None,
        name: str = "",
        commands: bool = False,
        log: Path | None = None,
        pass_fds: Sequence[int] = (),
    ) -> None:
        self.argv = [str(part) for part in argv]
        self.name = name or Path(self.argv[0]).name
        self.lines: list[str] = []
        self._events: list[Event] = []
        self._news = threading.Condition()
        self._ended = False
        self._log = log.open("w", encoding="utf-8") if log else None
        self.started = time.monotonic()
        self._child = spawn(
            [*tied_to_us(), *self.argv],
            env=dict(os.environ if env is None else env),
            stdin=subprocess.PIPE if commands else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            process_group=0,
            pass_fds=tuple(pass_fds),
            text=True,
            errors="backslashreplace",
        )
        _alive.add(self)
        self._reader = threading.Thread(target=self._read, name=f"read {self.name}", daemon=True)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    # --- what it says -------------------------------------------------------------------------------------------

    @property
    def output(self) -> str:
        """All lines so far."""
        with self._news:
            return "\n".join(self.lines)

    def events(self, kind: str, *, since: int = 0) -> list[Event]:
        """The events of one kind so far, from a mark on."""
        with self._news:
            return [event for event in self._events[since:] if event["event"] == kind]

    def mark(self) -> int:
        """The number of lines so far, as ``since`` of a later wait."""
        with self._news:
            return len(self.lines)

    def wait_for(self, pattern: str, timeout: float = DEADLINE, *, since: int = 0) -> re.Match[str]:
        """Wait for a line that ``pattern`` (a regular expression) is found in."""
        wanted = re.compile(pattern)
        seen = since

        def found() -> re.Match[str] | None:
            nonlocal seen
            while seen < len(self.lines):
                match = wanted.search(self.lines[seen])
                seen += 1
                if match:
                    return match
            return None

        return self._wait(found, timeout, f"a line with {pattern!r}")

    def wait_event(
        self, kind: str, timeout: float = DEADLINE, *, where: Callable[[Event], bool] = lambda _: True, since: int = 0
    ) -> Event:
        """Wait for an event of one kind for which ``where`` holds; ``since`` counts the events of all kinds."""
        seen = since

        def found() -> Event | None:
            nonlocal seen
            while seen < len(self._events):
                event = self._events[seen]
                seen += 1
                if event["event"] == kind and where(event):
                    return event
            return None

        return self._wait(found, timeout, f"an event {kind!r}")

    def mark_events(self) -> int:
        """The number of events so far, as ``since`` of a later wait."""
        with self._news:
            return len(self._events)

    async def expect(self, pattern: str, timeout: float = DEADLINE, *, since: int = 0) -> re.Match[str]:
        """Do as ``wait_for`` does, without blocking the event loop."""
        return await asyncio.to_thread(self.wait_for, pattern, timeout, since=since)

    async def expect_event(
        self, kind: str, timeout: float = DEADLINE, *, where: Callable[[Event], bool] = lambda _: True, since: int = 0
    ) -> Event:
        """Do as ``wait_event`` does, without blocking the event loop."""
        return await asyncio.to_thread(self.wait_event, kind, timeout, where=where, since=since)

    def tell(self, line: str) -> None:
        """Write one line to its standard input."""
        if self._child.stdin is None:
            raise BedError(f"{self.name} was started without commands: it hears nothing")
        self._child.stdin.write(line + "\n")
        self._child.stdin.flush()

    # --- its life -----------------------------------------------------------------------------------------------

    @property
    def pid(self) -> int:
        """Its process id; ``ip netns exec`` and ``setpriv`` become the command, so it is the command's."""
        return self._child.pid

    @property
    def returncode(self) -> int | None:
        """Its exit status, minus the signal's number, or ``None`` while it runs."""
        return self._child.poll()

    def wait(self, timeout: float = DEADLINE) -> int:
        """Wait for its end; return its exit status with all output read."""
        try:
            code = self._child.wait(timeout)
        except subprocess.TimeoutExpired:
            raise Deadline(f"{self.name} still runs after {timeout} s\n{self._tail()}") from None
        self._reader.join(1.0)
        return code

    async def ended(self, timeout: float = DEADLINE) -> int:
        """Do as ``wait`` does, without blocking the event loop."""
        return await asyncio.to_thread(self.wait, timeout)

    def send(self, number: signal.Signals) -> None:
        """Send a signal to its whole process group; nothing happens if that is gone."""
        if self._child.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._child.pid, number)

    def kill(self) -> None:
        """``kill -9``, and wait until it is gone."""
        self.send(signal.SIGKILL)
        self.wait()

    def terminate(self, timeout: float = DEADLINE) -> int:
        """SIGTERM; wait for the end, return the exit status."""
        self.send(signal.SIGTERM)
        return self.wait(timeout)

    def interrupt(self, timeout: float = DEADLINE) -> int:
        """SIGINT, as Ctrl-C does; wait for the end, return the exit status."""
        self.send(signal.SIGINT)
        return self.wait(timeout)

    def freeze(self) -> None:
        """SIGSTOP: it hangs, its sockets stay open."""
        self.send(signal.SIGSTOP)

    def thaw(self) -> None:
        """SIGCONT."""
        self.send(signal.SIGCONT)

    def end(self) -> None:
        """Make sure that it and its children are gone; never raises."""
        self.thaw()
        self.send(signal.SIGTERM)
        try:
            self._child.wait(_END_AFTER)
        except subprocess.TimeoutExpired:
            self.send(signal.SIGKILL)
            self._child.wait()
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._child.pid, signal.SIGKILL)  # children that outlived it, still in its group
        self._reader.join(2.0)
        if self._child.stdin:
            with contextlib.suppress(BrokenPipeError):
                self._child.stdin.close()
        if self._log:
            self._log.close()
            self._log = None
        _alive.discard(self)

    # --- inside -------------------------------------------------------------------------------------------------

    def _read(self) -> None:
        assert self._child.stdout is not None
        for raw in self._child.stdout:
            line = raw.rstrip("\n")
            event = _event_of(line)
            with self._news:
                self.lines.append(line)
                if event:
                    self._events.append(event)
                if self._log:
                    self._log.write(raw)
                self._news.notify_all()
        self._child.stdout.close()  # here: a child of its own may keep it open for longer than anything waits
        with self._news:
            self._ended = True
            self._news.notify_all()

    def _wait(self, found: Callable[[], T | None], timeout: float, what: str) -> T:
        deadline = time.monotonic() + timeout
        with self._news:
            while True:
                if (result := found()) is not None:
                    return result
                rest = deadline - time.monotonic()
                if self._ended or rest <= 0:
                    state = self._how_it_ended() if self._ended else f"{timeout} s are over"
                    raise Deadline(f"waited for {what} of {self.name}; {state}\n{self._tail()}")
                self._news.wait(rest)

    def _how_it_ended(self) -> str:
        """Its output has ended, and its end follows at once: unless it only closed its output."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return f"it ended with status {self._child.wait(1.0)}"
        return "it closed its output"

    def _tail(self) -> str:
        return "\n".join(f"    {self.name}| {line}" for line in self.lines[-40:])


def run(argv: Sequence[str | Path], *, env: Mapping[str, str] | None = None, timeout: float = DEADLINE) -> str:
    """Run a command to its end and return its output; a bad end raises.

    Raises:
        CommandFailed: It ended with another status than 0.
        Deadline: It did not end in time.
    """
    with Process(argv, env=env) as process:
        code = process.wait(timeout)
        if code:
            raise CommandFailed(f"{' '.join(process.argv)} ended with status {code}\n{process.output}")
        return process.output


def eventually(
    probe: Callable[[], T], timeout: float = DEADLINE, *, what: str = "a condition", every: float = 0.05
) -> T:
    """Call ``probe`` until it returns something true, and return that.

    A probe may start a process. The pause is ``every`` seconds, and at least as long as the probe took, which leaves
    the processor to what is waited for.
    """
    deadline = time.monotonic() + timeout
    while True:
        began = time.monotonic()
        if result := probe():
            return result
        now = time.monotonic()
        if now > deadline:
            raise Deadline(f"waited {timeout} s for {what}; the last answer was {result!r}")
        time.sleep(max(every, min(now - began, deadline - now)))


_alive: set[Process] = set()


def _event_of(line: str) -> Event | None:
    if not line.startswith("@ "):
        return None
    with contextlib.suppress(ValueError):
        event = json.loads(line[2:])
        if isinstance(event, dict) and "event" in event:
            return event
    return None


def tied_to_us() -> list[str]:
    """A prefix that lets the kernel kill the child when we die; only sound for children of the main thread."""
    setpriv = shutil.which("setpriv")
    if setpriv and threading.current_thread() is threading.main_thread():
        return [setpriv, "--pdeathsig", "KILL", "--"]
    return []


@atexit.register
def _end_all() -> None:
    for process in list(_alive):
        process.end()
