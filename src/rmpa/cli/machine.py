"""The machine that ``rmpa service`` changes: its files, users and units; and the program that it starts."""

from __future__ import annotations

import grp
import os
import pwd
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.cli.units import GROUP, PACKAGED, UNITS
from rmpa.core.errors import ConfigError, RmpaError, StartError

if TYPE_CHECKING:
    from collections.abc import Callable

# The folder of the administrator's units; a package has its own in one of the others.
UNIT_FOLDER: Final = "/etc/systemd/system"
_PACKAGED_UNITS: Final = ("/usr/lib/systemd/system", "/lib/systemd/system")
# Where systemd runs (sd_booted(3)).
_BOOTED: Final = Path("/run/systemd/system")


class Machine:
    """The machine that is changed, or one below a folder; each change is told, and with ``dry`` only told.

    Args:
        root: The folder; empty for this machine.
        dry: Whether nothing is changed.
        tell: Called with each line.
    """

    def __init__(self, root: str, *, dry: bool, tell: Callable[[str], None] = lambda _: None) -> None:
        self.root = root
        self.dry = dry
        self.changes: list[str] = []
        self._tell = tell

    def path(self, place: str) -> Path:
        """Where a file of the machine is."""
        return Path(f"{self.root}{place}")

    def change(self, text: str) -> bool:
        """Tell of a change; return whether it is to be made."""
        self.changes.append(text)
        self._tell(f"{'would ' if self.dry else ''}{text}")
        return not self.dry

    def note(self, text: str) -> None:
        """Tell of something that is so already."""
        self._tell(text)

    def run(self, text: str, *command: str) -> None:
        """Change something by a program.

        Raises:
            RmpaError: It is not there, or it fails; in its own words.
        """
        if not self.change(text):
            return
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own words
        except OSError as error:
            raise RmpaError(f"{command[0]}: {error.strerror}") from None
        if done.returncode:
            problem = (done.stderr or done.stdout).strip() or f"exit code {done.returncode}"
            raise RmpaError(f"{' '.join(command)}: {problem}")

    def systemctl(self, *words: str) -> None:
        """Run ``systemctl`` on the machine."""
        self.run(
            f"run systemctl {' '.join(words)}", "systemctl", *(["--root", self.root] if self.root else []), *words
        )

    def write(self, place: str, text: str) -> bool:
        """Write a file unless it has this text already; return whether it has another one now."""
        path = self.path(place)
        if path.is_file() and path.read_text("utf-8", "replace") == text:
            self.note(f"{place} is as it should be")
            return False
        if self.change(f"write {place}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
            path.chmod(0o644)
        if self.dry:
            self.note("".join(f"    {line}\n" for line in text.splitlines()).rstrip("\n"))
        return True

    def ids(self, user: str) -> tuple[int, int] | None:
        """The numbers of a user and of the units' group; ``None``: one of them is not there."""
        uid, gid = self._number("passwd", user), self._number("group", GROUP)
        return None if uid is None or gid is None else (uid, gid)

    def _number(self, database: str, name: str) -> int | None:
        if not self.root:
            try:
                return pwd.getpwnam(name).pw_uid if database == "passwd" else grp.getgrnam(name).gr_gid
            except KeyError:
                return None
        try:
            entries = [line.split(":") for line in self.path(f"/etc/{database}").read_text("utf-8").splitlines()]
        except OSError:
            return None
        return next((int(entry[2]) for entry in entries if entry[0] == name and len(entry) > 2), None)

    def has_group(self) -> bool:
        """Whether the units' group is there."""
        return self._number("group", GROUP) is not None

    @property
    def packaged(self) -> bool:
        """Whether there are units that belong to a package."""
        return any(self.path(f"{folder}/{UNITS['up']}").is_file() for folder in _PACKAGED_UNITS)

    def parts(self) -> list[str]:
        """The units that are installed."""
        folders = (UNIT_FOLDER, *_PACKAGED_UNITS)
        return [name for name in UNITS.values() if any(self.path(f"{at}/{name}").is_file() for at in folders)]


def check_machine(root: str, verb: str, *, dry: bool) -> None:
    """Check that this machine can be changed.

    Raises:
        StartError: There is no systemd, or this user is not root.
    """
    if root:
        if not Path(root).is_dir():
            raise ConfigError("--root", f"{root} is no folder")
    elif not _BOOTED.is_dir() or shutil.which("systemctl") is None:
        problem = "this machine was not started by systemd (a container?)"
        raise StartError(f"rmpa service {verb}", problem, "have `rmpa up` started by what starts programs here")
    if os.geteuid() and not root and not dry:
        words = [own_program(), *sys.argv[1:]] if sys.argv[1:2] == ["service"] else [own_program(), "service", verb]
        raise StartError(f"rmpa service {verb}", "only root may change the machine", f"sudo {' '.join(words)}")


def own_program() -> str:
    """The absolute path of the program ``rmpa`` that runs: a script of pip, that of a bundle, or the package's.

    Raises:
        StartError: It has none.
    """
    called, prefix = Path(sys.argv[0]), Path(sys.prefix)
    for path in (called, prefix.parent / "rmpa", prefix / "bin" / "rmpa"):
        if path.name == "rmpa" and path.is_file() and os.access(path, os.X_OK):
            packaged = Path(PACKAGED)
            return PACKAGED if packaged.exists() and packaged.samefile(path) else str(path.absolute())
    raise StartError("rmpa", f"there is no program rmpa in {prefix}/bin", "install it there, or use the bundle")
