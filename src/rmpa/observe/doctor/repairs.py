"""What ``rmpa doctor --fix`` may do: each repair as commands, with what undoes it.

It does what a user would do without a thought, and what stops nothing: it starts a unit that is to run, or enables
one that runs; adds the user to the group of the control sockets; gives a directory of ours back to the user; removes
what a dead agent has left. Firewalls, clocks, kernel settings, nodes, programs that have a port, and variables of the
shell are the user's: of these the remedy of the check is shown.
"""

from __future__ import annotations

import grp
import os
import pwd
import shlex
import socket
import stat
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.config.module_name import state_dir
from rmpa.observe import limits
from rmpa.observe.control_client import closed_to_us, runtime_dir, runtime_dirs
from rmpa.observe.doctor.machine import UNIT, read_unit
from rmpa.observe.peer_info import OK, WARN, Check

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.observe.doctor.machine import DoctorInput

_LOCKS: Final = Path("/proc/locks")
_ANEW: Final = "nothing: the next agent of that name makes them again"


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
    """

    check: str
    where: str
    text: str
    command: tuple[str, ...]
    undo: str
    root: bool = False

    @property
    def words(self) -> tuple[str, ...]:
        """The command for this user."""
        return (*(("sudo",) if self.root and os.geteuid() else ()), *self.command)

    def __str__(self) -> str:
        """The command, as it is typed."""
        return shlex.join(self.words)


def find_repairs(given: DoctorInput) -> list[Repair]:
    """All that can be put right now."""
    return [*of_unit(read_unit(), agent_runs=bool(given.agents)), *of_group(*_access()), *of_directories(given)]


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


def of_directories(given: DoctorInput) -> Iterator[Repair]:
    """Give this user's directories back to it, and remove what dead agents have left in them."""
    environ, settings = given.environ, given.settings
    home = Path(environ["HOME"]) if environ.get("HOME") else None
    own = runtime_dir(environ, settings.runtime_dir)
    state = state_dir(environ, settings.state_dir or None)
    yield from of_mode(own, 0o027, "g-w,o-rwx")
    if state is not None:
        yield from of_owner(state, home)
        yield from of_mode(state, 0o022, "go-w")
    for place in dict.fromkeys((own, *runtime_dirs(environ))):
        yield from of_leavings(place)


def of_owner(directory: Path, home: Path | None) -> Iterator[Repair]:
    """A directory in this user's home that belongs to another one, as after a ``sudo rmpa up``; or the one above."""
    there = next(place for place in (directory, *directory.absolute().parents) if place.exists())
    owner, user = there.stat().st_uid, os.geteuid()
    if owner != user and user and home is not None and there.absolute().is_relative_to(home):
        change = ("chown", *(("-R",) if there == directory else ()))
        text, undo = (
            "belongs to another user, so this user's agent can keep nothing there",
            (*change, str(owner), str(there)),
        )
        command = (*change, f"{user}:", str(there))
        yield Repair("directory", str(there), text, command, f"sudo {shlex.join(undo)}", root=True)


def of_mode(directory: Path, forbidden: int, mode: str) -> Iterator[Repair]:
    """A directory of this user that it cannot use, or that is open to others."""
    try:
        info = directory.lstat()
    except OSError:
        return
    bits = stat.S_IMODE(info.st_mode)
    if info.st_uid == os.geteuid() and stat.S_ISDIR(info.st_mode) and (bits & forbidden or bits & 0o700 != 0o700):
        text, undo = f"has the mode {bits:04o}", shlex.join(("chmod", f"{bits:04o}", str(directory)))
        yield Repair("directory", str(directory), text, ("chmod", f"u+rwx,{mode}", str(directory)), undo)


def of_leavings(place: Path) -> Iterator[Repair]:
    """Sockets and locks of agents that were killed. They are removed under the lock, which a live agent holds."""
    try:
        names = sorted({path.stem for pattern in ("*.sock", "*.lock") for path in place.glob(pattern)})
        locks = _LOCKS.read_text("ascii", "replace")
    except OSError:
        return
    for name in names:
        sock, lock = place / f"{name}.sock", place / f"{name}.lock"
        there = [str(path) for path in (sock, lock) if path.exists()]
        if not (_is_held(lock, locks) or _is_alive(sock)):
            command = ("flock", "--nonblock", str(lock), "rm", "-f", str(sock), str(lock))
            text = f"the agent {name} was killed, and has left {' and '.join(map(os.path.basename, there))}"
            yield Repair("directory", str(place), text, command, _ANEW, root=not os.access(place, os.W_OK))


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
    for repair in found:
        yield Check("directory", WARN, repair.text, f"rmpa doctor --fix, or: {repair}", where=repair.where)
    if member:
        text = f"{user} is in the group {group}, and this session began before that"
        yield Check("directory", WARN, text, "log in again", where="/run/rmpa")
    elif not found:
        yield Check("directory", OK, "this user may use its directories, and no dead agent has left anything")
