"""The directory of the control sockets, and the lock that keeps agents' names apart."""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import StartError

if TYPE_CHECKING:
    from collections.abc import Mapping

_SYSTEM: Final = Path("/run/rmpa")
_REMEDY: Final = "set RMPA_RUNTIME_DIR to a directory of your own"


def runtime_dir(environ: Mapping[str, str], setting: str = "") -> Path:
    """The directory for a new agent of this user; it need not exist yet.

    Args:
        environ: Has RMPA_RUNTIME_DIR and XDG_RUNTIME_DIR, or not.
        setting: ``Settings.runtime_dir``; empty for the usual place.
    """
    if setting or environ.get("RMPA_RUNTIME_DIR"):
        return Path(setting or environ["RMPA_RUNTIME_DIR"])
    if environ.get("XDG_RUNTIME_DIR"):
        return Path(environ["XDG_RUNTIME_DIR"]) / "rmpa"
    if os.geteuid() == 0 and os.access(_SYSTEM.parent, os.W_OK):
        return _SYSTEM
    return Path(f"/tmp/rmpa-{os.geteuid()}")  # noqa: S108 - made with mode 0700, its owner checked


def runtime_dirs(environ: Mapping[str, str]) -> list[Path]:
    """The directories in which a client looks for agents: those that exist and that it may read.

    With RMPA_RUNTIME_DIR that one alone; else every usual one, since ``sudo`` and ``systemd`` drop variables.
    """
    places = [runtime_dir(environ)]
    if not environ.get("RMPA_RUNTIME_DIR"):
        places += [_SYSTEM, Path(f"/run/user/{os.geteuid()}/rmpa"), Path(f"/tmp/rmpa-{os.geteuid()}")]  # noqa: S108 - read, owner checked
    return [place for place in dict.fromkeys(places) if _usable(place)]


def _usable(place: Path) -> bool:
    """Whether this user may read it, and no untrusted user can have put a socket there.

    The owner of ``/run/rmpa`` does not matter: only root makes it, or systemd for a unit's user.
    """
    try:
        info = place.lstat()
    except OSError:
        return False
    trusted = place == _SYSTEM or info.st_uid in {0, os.geteuid()}
    return stat.S_ISDIR(info.st_mode) and trusted and os.access(place, os.R_OK | os.X_OK)


def make_runtime_dir(place: Path, group: int | None = None) -> None:
    """Make the directory, for this user alone, or for one group too.

    Args:
        place: The directory.
        group: The number of the group that may look into it.

    Raises:
        StartError: It cannot be made or given to the group, or another user owns it.
    """
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        info = place.lstat()
        if not stat.S_ISDIR(info.st_mode):
            raise StartError(str(place), "is not a directory", _REMEDY)
        if info.st_uid != os.geteuid():
            raise StartError(str(place), f"belongs to user {info.st_uid}, not to us", _REMEDY)
        if group is not None:
            os.chown(place, -1, group)
            place.chmod(0o750)
        elif info.st_mode & 0o077:
            place.chmod(0o700)
    except OSError as error:
        raise StartError(str(place), f"cannot be made: {error.strerror}", _REMEDY) from None


class NameLock:
    """Holds ``<name>.lock`` while the agent runs; the kernel releases the lock however the agent ends.

    Args:
        place: The runtime directory; made if needed.
        name: The agent's name.
        group: As for ``make_runtime_dir``.

    Raises:
        StartError: Another agent holds it (the text has its process id), or the directory cannot be used.
    """

    def __init__(self, place: Path, name: str, group: int | None = None) -> None:
        make_runtime_dir(place, group)
        self.path = place / f"{name}.lock"
        while True:
            try:
                fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
            except OSError as error:
                raise StartError(str(self.path), f"cannot be opened: {error.strerror}", _REMEDY) from None
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                pid = os.read(fd, 32).decode("ascii", "replace").strip()
                os.close(fd)
                whose = f" (pid {pid})" if pid else ""
                problem = f"an agent named {name!r} already runs on this machine{whose}"
                raise StartError("rmpa up", problem, "stop it, or give this one a --name of its own") from None
            if self._still_there(fd):
                break
            os.close(fd)  # the last holder removed the file after it was opened here
        self._fd = fd
        with contextlib.suppress(OSError):  # a full disk: the lock holds without the process id in the file
            os.ftruncate(fd, 0)
            os.write(fd, f"{os.getpid()}\n".encode())

    def _still_there(self, fd: int) -> bool:
        try:
            return self.path.stat().st_ino == os.fstat(fd).st_ino
        except FileNotFoundError:
            return False

    def release(self) -> None:
        """Remove the file and release the lock; may be called twice."""
        if self._fd >= 0:
            with contextlib.suppress(OSError):
                self.path.unlink()
            os.close(self._fd)
            self._fd = -1
