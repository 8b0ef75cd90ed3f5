"""Programs that outlive their starter: their logs, their figures, and the files that programs keep.

Such a program has a session of its own and writes its output into a file, so it goes on when its starter is killed.
The next starter finds it by a ``ProgramMark``, which the kernel gives to no second process.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import functools
import os
import re
import shutil
import signal
import subprocess
import time
from typing import TYPE_CHECKING, Final, NamedTuple, Self

import msgspec

from rmpa.runtime import limits

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

# Below the folder of a module's state: the logs of programs, and what resources tell of their runs (``ResourceRun``).
LOGS: Final = "log"
RUNS: Final = "run"
# Colours, and the title that roslaunch gives its terminal.
_COLOURS: Final = re.compile(rb"\x1b\[[0-9;]*m|\x1b\][^\x07\n]*\x07")
_TICKS: Final = os.sysconf("SC_CLK_TCK")
_PAGE: Final = os.sysconf("SC_PAGE_SIZE")
# Seconds between two looks whether the processes of a program have ended.
_LOOK: Final = 0.05
# Seconds that they have after SIGTERM, and after SIGKILL.
_TERMINATED: Final = 3.0
_KILLED: Final = 5.0
# Of prctl(2).
_CAP_AMBIENT, _CLEAR_ALL = 47, 4
# The states of proc_pid_stat(5) of a process that has ended.
_ENDED: Final = ("Z", "X")
# Files of one name that are set aside.
_KEPT: Final = 9


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file, so that a crash at any moment leaves the old one or the new one; readable by its owner alone.

    Raises:
        OSError: It cannot be written.
    """
    new = path.with_name(f"{path.name}.new")
    with open(new, "wb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)


def set_aside(path: Path, what: str) -> Path:
    """Rename a file to NAME.WHAT, or to the first free one of NAME.WHAT-2 to -9; only the last is ever replaced.

    The first one may be the only copy of parameters set by hand.

    Args:
        path: The file.
        what: The ending.

    Returns:
        The new path.

    Raises:
        OSError: It cannot be renamed.
    """
    names = [f"{path.name}.{what}", *(f"{path.name}.{what}-{number}" for number in range(2, _KEPT + 1))]
    free = [aside for name in names if not (aside := path.with_name(name)).exists()]
    return path.replace(free[0] if free else path.with_name(names[-1]))


class ProcessFigures(NamedTuple):
    """What the kernel says of a process.

    Attributes:
        began: When it began, in clock ticks since the boot.
        parent: The process id of its parent.
        group: Its process group.
        cpu: Seconds of processor time that it has used.
        rss: Bytes of memory that it holds.
        threads: Its threads.
    """

    began: int
    parent: int
    group: int
    cpu: float
    rss: int
    threads: int

    @property
    def since(self) -> float:
        """When it began, in Unix seconds."""
        return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + self.began / _TICKS


def figures(pid: int) -> ProcessFigures | None:
    """The figures of a process; ``None``: there is none of this id, or it has ended."""
    try:
        fields = _read(f"/proc/{pid}/stat").rpartition(b")")[2].decode().split()
    except OSError:
        return None
    if fields[0] in _ENDED:
        return None
    cpu = (int(fields[11]) + int(fields[12])) / _TICKS
    parent, group, threads, began, pages = (int(fields[place]) for place in (1, 2, 17, 19, 21))
    return ProcessFigures(began, parent, group, cpu, pages * _PAGE, threads)


def _read(path: str) -> bytes:
    """A file of the kernel, which blocks nothing."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        return os.read(descriptor, 4096)
    finally:
        os.close(descriptor)


@functools.cache
def _boot() -> str:
    return _read("/proc/sys/kernel/random/boot_id").decode().strip()


class ProgramMark(NamedTuple):
    """A process that cannot be taken for another one with the same id, after a restart of the machine either."""

    pid: int
    began: int
    boot: str

    @classmethod
    def of(cls, pid: int) -> Self | None:
        """The mark of a process that runs; ``None``: it does not."""
        found = figures(pid)
        return None if found is None else cls(pid, found.began, _boot())

    @property
    def runs(self) -> bool:
        """Whether it still runs."""
        return ProgramMark.of(self.pid) == self


class StartRule(NamedTuple):
    """When the module's agent starts a resource without being asked: the table ``[start]`` of its file.

    Attributes:
        boot: Whether it does at all.
        delay: Seconds after the conditions below hold.
        topics: Topics that must be published.
        after: Resources of the module that must be active.
    """

    boot: bool = False
    delay: float = 0.0
    topics: tuple[str, ...] = ()
    after: tuple[str, ...] = ()


class NodeRun(msgspec.Struct, frozen=True, kw_only=True):
    """A node of a resource, as it is now.

    Attributes:
        key: Its name in the declaration.
        node: Its name in the graph.
        state: ``stopped``, ``starting``, ``running``, ``waiting`` (it is expected again), ``failed``.
        pid: Its process; 0: not known.
        mark: The program that the resource has started for it, which may be roslaunch; ``None``: none.
        restarts: How often it was started again.
        since: Since when it runs, in Unix seconds; 0: it does not.
        why: What happened; empty: nothing to tell.
    """

    key: str
    node: str
    state: str
    pid: int = 0
    mark: ProgramMark | None = None
    restarts: int = 0
    since: float = 0.0
    why: str = ""


class RunFile(msgspec.Struct, frozen=True):
    """What a program has in a file for those that come after it."""

    @classmethod
    def load(cls, path: Path) -> Self | None:
        """Read a file; ``None``: there is none, or it is of another release."""
        try:
            return msgspec.json.decode(path.read_bytes(), type=cls)
        except (OSError, msgspec.DecodeError):
            return None


class ResourceRun(RunFile, frozen=True, kw_only=True):
    """What a resource tells of itself in a file, to the next run of it and to the agent.

    Attributes:
        process: The process of ``rmpa run``.
        state: Its state, as of its life cycle.
        nodes: The nodes that it names.
    """

    process: ProgramMark
    state: str
    nodes: tuple[NodeRun, ...] = ()

    def save(self, path: Path) -> None:
        """Replace a file.

        Raises:
            OSError: It cannot be written.
        """
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        replace_file(path, msgspec.json.encode(self))


class CpuShares:
    """The processor time of processes as a share of one core, each since it was last asked for.

    At first it is the share since the process began.
    """

    def __init__(self) -> None:
        self._last: dict[int, tuple[int, float, float]] = {}

    def known(self, pid: int) -> bool:
        """Whether a share since an earlier question can be told."""
        return pid in self._last

    def of(self, pid: int, found: ProcessFigures) -> float:
        """The share of a process with these figures."""
        now = time.clock_gettime(time.CLOCK_BOOTTIME)
        began, cpu, at = self._last.get(pid, (-1, 0.0, 0.0))
        if began != found.began:
            cpu, at = 0.0, found.began / _TICKS
        self._last[pid] = found.began, found.cpu, now
        return max(found.cpu - cpu, 0.0) / max(now - at, 1 / _TICKS)

    def keep(self, pids: set[int]) -> None:
        """Forget all other processes."""
        self._last = {pid: last for pid, last in self._last.items() if pid in pids}


def start_program(
    command: Sequence[str], *, log: Path | None, cwd: Path | None = None, env: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Start a program in a session of its own.

    Args:
        command: Its command line.
        log: The file that its output is appended to; ``None``: it is that of this process.
        cwd: Its working directory; ``None``: that of this process.
        env: Its environment; ``None``: that of this process.

    Raises:
        OSError: It cannot be started, or the log cannot be written.
    """
    with contextlib.ExitStack() as opened:
        output = None
        if log is not None:
            log.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            output = opened.enter_context(open(log, "ab", opener=lambda name, flags: os.open(name, flags, 0o600)))
        return subprocess.Popen(  # noqa: S603 - what the user has written
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, cwd=cwd, env=env, start_new_session=True
        )


def keep_capabilities() -> None:
    """Keep this process's ambient capabilities, such as its unit's CAP_NET_ADMIN, from all programs that it starts.

    They have what a user's node has without the agent. Each thread has a set of its own (capabilities(7)), so this is
    called before others are started.
    """
    ctypes.CDLL(None).prctl(_CAP_AMBIENT, _CLEAR_ALL, 0, 0, 0)  # an older kernel has none


async def ended(pid: int) -> None:
    """Wait until a process has ended, without a thread; a child remains to be waited for."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    loop = asyncio.get_running_loop()
    over = asyncio.Event()
    try:
        loop.add_reader(descriptor, over.set)
        await over.wait()
    finally:
        loop.remove_reader(descriptor)
        os.close(descriptor)


def how_ended(code: int | None) -> str:
    """How a program ended, as a text; ``code`` is that of ``Popen``, ``None``: it is not known."""
    if code is None:
        return "has ended"
    if code >= 0:
        return f"has ended with code {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:  # most real-time signals have no name
        return f"was ended by signal {-code}"


async def end_program(mark: ProgramMark, after: float) -> None:
    """End a program with all processes that it has started: by SIGINT, then SIGTERM, then SIGKILL.

    The first two go to its process group, as those of a terminal do, and the last to each process: roslaunch gives
    each of its nodes a session of its own, and ends them by itself when it has the time.

    Args:
        mark: Its process.
        after: Seconds that it has after SIGINT.
    """
    loop = asyncio.get_running_loop()
    family: set[ProgramMark] = set()
    for number, wait in ((signal.SIGINT, after), (signal.SIGTERM, _TERMINATED), (signal.SIGKILL, _KILLED)):
        family |= await asyncio.to_thread(_family, mark)
        until = loop.time() + wait
        if any(each.runs for each in family):
            _signal(mark, family, number)
        while any(each.runs for each in family):
            if loop.time() >= until:
                break
            await asyncio.sleep(_LOOK)
        else:
            return


def _signal(mark: ProgramMark, family: set[ProgramMark], number: signal.Signals) -> None:
    with contextlib.suppress(OSError):
        os.killpg(mark.pid, number)  # its group has this number as long as one of its processes runs
    for each in family if number is signal.SIGKILL else ():
        with contextlib.suppress(OSError):
            if each.runs:
                os.kill(each.pid, number)


def _family(mark: ProgramMark) -> set[ProgramMark]:
    """A program's process, its descendants, and the other processes of its group; those that run."""
    all_of = dict(_processes())
    wanted = {mark.pid} if mark.runs else set()
    grown = True
    while grown:
        more = {pid for pid, one in all_of.items() if one.parent in wanted or one.group == mark.pid} - wanted
        wanted |= more
        grown = bool(more)
    return {found for pid in wanted if (found := ProgramMark.of(pid)) is not None}


def _processes() -> Iterator[tuple[int, ProcessFigures]]:
    for name in os.listdir("/proc"):  # noqa: PTH208 - hundreds of names
        if name.isdecimal() and (found := figures(int(name))) is not None:
            yield int(name), found


def rotate_log(path: Path) -> None:
    """Move what a large log has to ``NAME.1``, which has the place of the one before; the file stays the same.

    The program appends to it, and knows of nothing. What it writes between the two steps is lost.
    """
    with contextlib.suppress(OSError):
        if path.stat().st_size >= limits.PROGRAM_LOG_MAX:
            shutil.copyfile(path, _former(path))
            os.truncate(path, 0)


def read_log(path: Path, after: int | None, lines: int) -> tuple[list[str], int]:
    """Lines of a log, without their colours, and where the next ones begin.

    Args:
        path: The file; one that is missing is empty.
        after: Where they begin, as an earlier answer said; ``None``: the last ones are wanted.
        lines: The most; of more the last ones are read.
    """
    try:
        size = path.stat().st_size
        text, end = _tail(path, after if after is not None and after <= size else 0)
        if after is None:
            text = _tail(_former(path), 0)[0] + text
        elif after > size:  # it was rotated: NAME.1 has the rest of what it was
            text = _tail(_former(path), after)[0] + text
    except OSError:
        return [], 0
    if after is not None and (rest := len(text) - text.rfind(b"\n") - 1) and rest < limits.PROGRAM_LOG_LINE:
        text, end = text[:-rest], max(end - rest, 0)  # a line that is being written comes with the next answer
    plain = _COLOURS.sub(b"", text[-limits.PROGRAM_LOG_READ :])
    found = plain.decode("utf-8", "replace").splitlines()[-lines:]
    return [line[: limits.PROGRAM_LOG_LINE] for line in found], end


def _former(path: Path) -> Path:
    return path.with_name(f"{path.name}.1")


def _tail(path: Path, begin: int) -> tuple[bytes, int]:
    """What a file has from a place on, but no more than its last ``PROGRAM_LOG_READ`` bytes; and where it ends."""
    try:
        with path.open("rb") as file:
            file.seek(max(begin, os.fstat(file.fileno()).st_size - limits.PROGRAM_LOG_READ))
            return file.read(limits.PROGRAM_LOG_READ), file.tell()
    except FileNotFoundError:
        return b"", 0
