"""The demo's directory: it holds all its sockets and files, is found by a second terminal, and is gone at the end."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import socket
import tempfile
from pathlib import Path

PREFIX = f"rmpa-demo-{os.geteuid()}-"
PATH_MAX = 60
"""Characters of the place for the directory: a socket's path has at most 107."""


class Home:
    """A new directory, for this user alone; what killed demos left behind is removed first."""

    def __init__(self) -> None:
        for stale in _all():
            if _pid_of(stale) is None:
                shutil.rmtree(stale, ignore_errors=True)
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=_place()))
        self._lock = os.open(self.path / "demo.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        os.write(self._lock, str(os.getpid()).encode())
        self.agents.mkdir(mode=0o700)
        # An empty one: the demo is the same whatever the user has in ~/.config/rmpa or /etc/rmpa.
        self.settings.touch()

    @property
    def agents(self) -> Path:
        """The agents' runtime directory."""
        return self.path / "agents"

    @property
    def variables(self) -> dict[str, str]:
        """The environment's part that keeps agents and resources to this directory."""
        state = str(self.path / "state")
        return {"RMPA_RUNTIME_DIR": str(self.agents), "RMPA_STATE_DIR": state, "XDG_STATE_HOME": state}

    @property
    def settings(self) -> Path:
        """The agents' ``rmpa.toml``."""
        return self.path / "rmpa.toml"

    @property
    def token(self) -> Path:
        """The web page's token."""
        return self.path / "web-token"

    @property
    def socket(self) -> Path:
        """Where the supervisor takes commands."""
        return self.path / "demo.sock"

    def remove(self) -> None:
        """Remove it with all that is in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


def running() -> dict[int, Path]:
    """The demos of this user that run, by the supervisor's process id: each one's command socket."""
    found = {_pid_of(path): path / "demo.sock" for path in _all()}
    return {pid: path for pid, path in found.items() if pid is not None}


def ask(path: Path, request: bytes) -> bytes:
    """Send a line to a supervisor and return its answer, ``b""`` if it hung up.

    Raises:
        OSError: It cannot be reached.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.settimeout(10.0)
        sock.connect(str(path))
        sock.sendall(request + b"\n")
        with sock.makefile("rb") as answer:
            return answer.readline()


def _place() -> Path:
    place = Path(tempfile.gettempdir())
    return place if len(str(place)) <= PATH_MAX else Path("/tmp")


def _all() -> list[Path]:
    return [path for path in _place().glob(f"{PREFIX}*") if path.is_dir() and path.stat().st_uid == os.geteuid()]


def _pid_of(path: Path) -> int | None:
    """The process id of the demo that holds this directory; ``None`` if it has ended."""
    with contextlib.suppress(OSError, ValueError), (path / "demo.lock").open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return int(file.read(32))
    return None
