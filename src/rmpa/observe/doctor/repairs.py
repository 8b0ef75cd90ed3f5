"""What ``rmpa doctor --fix`` may do: each repair as commands, with what undoes it.

It does what a user would do without a thought, and what stops nothing: it starts a unit that is to run, or enables
one that runs; adds the user to the group of the control sockets; gives a directory of ours back to the user; removes
what a dead agent has left. Of directories and files it changes only those that this user owns, and shares with no
other user; what is doubtful is a ``Check``: its remedy is shown, and the user decides. Firewalls, clocks, kernel
settings, nodes, programs that have a port, and variables of the shell are the user's too.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import pwd
import shlex
import socket
import stat
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.config.module_name import state_dir
from rmpa.core.identity import peer_name_problem
from rmpa.observe import limits
from rmpa.observe.check import OK, WARN, Check
from rmpa.observe.control_client import closed_to_us, runtime_dir, runtime_dirs
from rmpa.observe.doctor.machine import DoctorInput, read_unit
from rmpa.runtime.systemd import UNIT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping


_LOCKS: Final = Path("/proc/locks")
_ANEW: Final = "nothing: the next agent of that name makes them again"
# Killed agents of one directory that are named.
_SHOWN: Final = 5


@dataclass(frozen=True, slots=True)
class Repair:
    """Something that can be put right.

    Args:
        check: The check that names it.
        where: Its subject there.
        text: What is wrong.
        command: What puts it right, as the arguments of a program.
        undo: What undoes that, ready to read.
        root: Whether it takes the rights of root.
        do: Does the same as the command, in this process: it follows no link that was put there since.
    """

    check: str
    where: str
    text: str
    command: tuple[str, ...]
    undo: str
    root: bool = False
    do: Callable[[], None] | None = field(default=None, compare=False)

    @property
    def words(self) -> tuple[str, ...]:
        """The command for this user."""
        return (*(("sudo",) if self.root and os.geteuid() else ()), *self.command)

    def __str__(self) -> str:
        """The command, as it is typed."""
        return shlex.join(self.words)


def find_repairs(given: DoctorInput) -> list[Repair]:
    """All that can be put right now."""
    of_places = [each for each in of_directories(given) if isinstance(each, Repair)]
    return [*of_unit(read_unit(), agent_runs=bool(given.agents)), *of_group(*_access()), *of_places]


def _access() -> tuple[str, str, bool]:
    """The group of the control sockets that this user may not use; the user, and whether the group has it."""
    group, user = closed_to_us(), str(os.geteuid())
    with suppress(KeyError):
        user = pwd.getpwuid(os.geteuid()).pw_name
    return group, user, bool(group) and user in grp.getgrnam(group).gr_mem


def of_unit(unit: Mapping[str, str], *, agent_runs: bool) -> Iterator[Repair]:
    """Start the unit that starts at boot, enable the one that runs; one that does neither was switched off.

    Args:
        unit: What ``systemctl show`` says of it.
        agent_runs: Whether an agent runs, whose ports the unit's would need.
    """
    if unit.get("LoadState") != "loaded":
        return
    active, enabled = unit.get("ActiveState", ""), unit.get("UnitFileState") == "enabled"
    if active == "active" and unit.get("UnitFileState") == "disabled":
        text, command = f"{UNIT} runs, but does not start at boot", ("systemctl", "enable", UNIT)
        yield Repair("boot", "", text, command, f"sudo systemctl disable {UNIT}", root=True)
    elif active in ("inactive", "failed") and enabled and not agent_runs:
        text, command = f"{UNIT} is {active}, but is enabled", ("systemctl", "start", UNIT)
        yield Repair("boot", "", text, command, f"sudo systemctl stop {UNIT}", root=True)


def of_group(group: str, user: str, member: bool) -> Iterator[Repair]:
    """Let the user use the control socket of the unit's agent.

    Args:
        group: The group that may, where this session may not; else empty.
        user: The user.
        member: Whether the group has the user; then only a new session is missing.
    """
    if group and not member:
        text = (
            f"users of the group {group} may ask the agent at boot, and {user} may not (after the next log-in it may)"
        )
        command, undo = ("usermod", "-aG", group, user), f"sudo gpasswd -d {user} {group}"
        yield Repair("directory", "/run/rmpa", text, command, undo, root=True)


def of_directories(given: DoctorInput) -> Iterator[Repair | Check]:
    """Give this user's directories back to it, and remove what dead agents have left in them."""
    environ, settings = given.environ, given.settings
    own = runtime_dir(environ, settings.runtime_dir)
    state = state_dir(environ, settings.state_dir or None)
    yield from of_mode(own, 0o027, "g-w,o-rwx")
    if state is not None:
        if environ.get("HOME"):
            yield from of_owner(state, Path(environ["HOME"]))
        yield from of_mode(state, 0o022, "go-w")
    if settings.resources.folder:  # what lies there is run
        yield from of_mode(Path(settings.resources.folder).expanduser(), 0o022, "go-w")
    for place in dict.fromkeys((own, *runtime_dirs(environ))):
        yield from of_leavings(place)


@contextmanager
def _opened(directory: Path) -> Iterator[int]:
    """A directory that this user owns and that is shared with no other user.

    Raises:
        OSError: It is another user's, sticky, a link, not there, or cannot be read.
    """
    opened = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        info = os.fstat(opened)
        if info.st_uid != os.geteuid():
            raise PermissionError(errno.EPERM, f"belongs to user {info.st_uid}")
        if info.st_mode & stat.S_ISVTX:
            raise PermissionError(errno.EPERM, "is shared with other users (sticky)")
        yield opened
    finally:
        os.close(opened)


def of_owner(directory: Path, home: Path) -> Iterator[Repair | Check]:
    """The state directory in this user's home that belongs to root, as after a ``sudo rmpa up``; or the one above."""
    user = os.geteuid()
    try:
        directory, home = directory.resolve(), home.resolve()
        there = next(place for place in (directory, *directory.parents) if place.exists())
        above = [place.stat().st_uid for place in there.parents if place.is_relative_to(home)]  # the last: home
        if there.stat().st_uid != 0 or not above or above[-1] != user or {*above} - {0, user} or not user:
            return
    except (OSError, RuntimeError):  # a loop of links
        return
    ours = there == directory and directory.name == "rmpa"
    change = ("chown", "-h", *(("-R",) if ours else ()))
    text, command = "belongs to root, so this user's agent can keep nothing there", (*change, f"{user}:", str(there))
    undo = f"sudo {shlex.join((*change, '0', str(there)))}"
    if ours:
        yield Repair("directory", str(there), text, command, undo, root=True)
    else:
        yield Check("directory", WARN, text, f"sudo {shlex.join(command)}", where=str(there))


def of_mode(directory: Path, forbidden: int, mode: str) -> Iterator[Repair | Check]:
    """A directory of this user that it cannot use, or that is open to others."""
    try:
        info = directory.lstat()
    except OSError:
        return
    bits = stat.S_IMODE(info.st_mode)
    is_wrong = bits & forbidden or bits & 0o700 != 0o700
    if info.st_uid != os.geteuid() or not stat.S_ISDIR(info.st_mode) or not is_wrong:
        return
    text, command = f"has the mode {bits:04o}", ("chmod", f"u+rwx,{mode}", str(directory))
    if bits & stat.S_ISVTX:
        advice = "set RMPA_RUNTIME_DIR or RMPA_STATE_DIR to a directory of your own"
        yield Check("directory", WARN, f"{text}: other users share it", advice, where=str(directory))
    elif directory.name in ("rmpa", f"rmpa-{os.geteuid()}") and bits & stat.S_IRUSR:
        undo = shlex.join(("chmod", f"{bits:04o}", str(directory)))
        do = partial(_set_mode, directory, bits & ~forbidden | 0o700)
        yield Repair("directory", str(directory), text, command, undo, do=do)
    else:  # it may be the home directory
        yield Check("directory", WARN, text, f"if nothing else uses it: {shlex.join(command)}", where=str(directory))


def _set_mode(directory: Path, bits: int) -> None:
    with _opened(directory) as place:
        os.fchmod(place, bits)


def of_leavings(place: Path) -> Iterator[Repair]:
    """Sockets and locks of agents that were killed. They are removed under the lock, which a live agent holds."""
    try:
        with _opened(place) as opened:
            names = [name[:-5] for name in sorted(os.listdir(opened)) if name.endswith(".lock")]  # noqa: PTH208
            names = [name for name in names if not peer_name_problem(name) and _are_ours(opened, name)]
        locks = _LOCKS.read_text("ascii", "replace")
    except OSError:
        return
    dead = [n for n in names if not (_is_held(place / f"{n}.lock", locks) or _is_alive(place / f"{n}.sock"))]
    if not dead:
        return
    sock, lock = f"{place}/{dead[0]}.sock", f"{place}/{dead[0]}.lock"
    command: tuple[str, ...] = ("flock", "--nonblock", lock, "rm", "-f", sock, lock)
    text = f"the agent {dead[0]} was killed, and has left {dead[0]}.sock and {dead[0]}.lock"
    if len(dead) > 1:
        each = "do flock --nonblock $name.lock rm -f $name.sock $name.lock; done"
        command = ("sh", "-c", f"cd {shlex.quote(str(place))} && for name in {' '.join(dead)}; {each}")
        shown = ", ".join(dead[:_SHOWN]) + (", …" if len(dead) > _SHOWN else "")
        text = f"{len(dead)} agents were killed, and have left their sockets and locks: {shown}"
    yield Repair("directory", str(place), text, command, _ANEW, do=partial(_remove, place, dead))


def _are_ours(place: int, name: str) -> bool:
    """Whether both files of an agent are there, and are this user's; one alone harms nothing, and may not be ours."""
    try:
        sock, lock = (os.stat(f"{name}.{end}", dir_fd=place, follow_symlinks=False) for end in ("sock", "lock"))
    except OSError:
        return False
    kinds = stat.S_ISSOCK(sock.st_mode) and stat.S_ISREG(lock.st_mode)
    return kinds and sock.st_uid == lock.st_uid == os.geteuid()


def _remove(directory: Path, names: Iterable[str]) -> None:
    with _opened(directory) as place:
        for name in names:
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            lock = os.open(f"{name}.lock", flags, dir_fd=place)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                there = os.stat(f"{name}.lock", dir_fd=place, follow_symlinks=False)
                if not (os.path.samestat(os.fstat(lock), there) and _are_ours(place, name)):
                    raise OSError(errno.ESTALE, "it has changed meanwhile")
                os.unlink(f"{name}.sock", dir_fd=place)
                os.unlink(f"{name}.lock", dir_fd=place)
            finally:
                os.close(lock)


def _is_held(lock: Path, locks: str) -> bool:
    try:
        return f":{lock.stat().st_ino} " in locks
    except OSError:
        return False


def _is_alive(path: Path) -> bool:
    """Whether a program has a socket. One that does not answer, or that this user may not ask, counts as alive."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.settimeout(limits.CONTROL_LOOK_TIMEOUT)
        try:
            sock.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:
            return True
    return True


def directories(given: DoctorInput) -> Iterator[Check]:
    """The check of the directories: what can be put right there."""
    group, user, member = _access()
    found = [*of_group(group, user, member), *of_directories(given)]
    for each in found:
        if isinstance(each, Check):
            yield each
        else:
            yield Check("directory", WARN, each.text, f"rmpa doctor --fix, or: {each}", where=each.where)
    if member:
        text = f"{user} is in the group {group}, and this session began before that"
        yield Check("directory", WARN, text, "log in again", where="/run/rmpa")
    elif not found:
        yield Check("directory", OK, "this user may use its directories, and no dead agent has left anything")
