"""The machine that ``rmpa service`` changes: its files, users and units; and the program that it starts."""

from __future__ import annotations

import grp
import os
import pwd
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.cli.units import GROUP, PACKAGED, UNITS
from rmpa.config.module_name import GATEWAY_SUFFIX, PLACES_FILE, module_dir
from rmpa.core.errors import ConfigError, RmpaError, StartError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

# The folder of the administrator's units; a package has its own in one of the others.
UNIT_FOLDER: Final = "/etc/systemd/system"
_PACKAGED_UNITS: Final = ("/usr/lib/systemd/system", "/lib/systemd/system")
# Where systemd runs (sd_booted(3)).
_BOOTED: Final = Path("/run/systemd/system")


class Machine:
    """The machine that is changed, or one below a folder; each change is printed, and with ``dry`` only printed.

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
            raise RmpaError(f"{command[0]}: {error.strerror}", code="service-unit") from None
        if done.returncode:
            problem = (done.stderr or done.stdout).strip() or f"exit code {done.returncode}"
            raise RmpaError(f"{' '.join(command)}: {problem}", code="service-unit")

    def systemctl(self, *words: str) -> None:
        """Run ``systemctl`` on the machine."""
        below = ["--root", self.root] if self.root else []
        self.run(f"run systemctl {' '.join(words)}", "systemctl", *below, *words)

    def write(self, place: str, text: str) -> bool:
        """Write a file unless it has this text already; return whether it has another one now."""
        path = self.path(place)
        if path.is_file() and path.read_text("utf-8", "replace") == text:
            self.note(f"{place} is as it should be")
            return False
        if self.change(f"write {place}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(f".{path.name}.new")  # what a link leads to stays as it is
            temporary.write_text(text, "utf-8")
            temporary.chmod(0o644)
            temporary.replace(path)
        if self.dry:
            self.note("".join(f"    {line}\n" for line in text.splitlines()).rstrip("\n"))
        return True

    def ids(self, user: str) -> tuple[int, int] | None:
        """The numbers of a user and of the units' group; ``None``: one of them is not there."""
        uid, gid = self.number("passwd", user), self.number("group", GROUP)
        return None if uid is None or gid is None else (uid, gid)

    def number(self, database: str, name: str) -> int | None:
        """The number of a user (``passwd``) or a group (``group``); ``None``: it is not there."""
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

    @property
    def packaged(self) -> bool:
        """Whether there are units that belong to a package."""
        return self.has_packaged(UNITS["up"])

    def has_packaged(self, unit: str) -> bool:
        """Whether a package has brought a unit."""
        return any(self.path(f"{folder}/{unit}").is_file() for folder in _PACKAGED_UNITS)

    def check_unmasked(self, unit: str) -> None:
        """Raise ``StartError`` if a unit is masked, so that it cannot be started."""
        path = self.path(f"{UNIT_FOLDER}/{unit}")
        if path.is_symlink() and str(path.readlink()) == os.devnull:
            below = f"--root {self.root} " if self.root else ""
            remedy = f"systemctl {below}unmask {unit.removesuffix('.service')}"
            raise StartError(f"{UNIT_FOLDER}/{unit}", "the unit is masked", remedy, code="service-unit")


def refused(verb: str, problem: str, remedy: str, code: str = "service-unit") -> StartError:
    """The error of ``rmpa service VERB``."""
    return StartError(f"rmpa service {verb}", problem, remedy, code=code)


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
        raise refused(verb, problem, "have `rmpa up` started by what starts programs here")
    if os.geteuid() and not root and not dry:
        words = [own_program(), *sys.argv[1:]] if sys.argv[1:2] == ["service"] else [own_program(), "service", verb]
        raise refused(verb, "only root may change the machine", f"sudo {' '.join(words)}", "root-needed")


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
    problem = f"there is no program rmpa in {prefix}/bin"
    raise StartError("rmpa", problem, "install it there, or use the bundle", code="service-unit")


def entries(state: Path) -> list[Path]:
    """What a state directory keeps of modules."""
    return sorted(path for path in state.glob("*") if path.name != PLACES_FILE)


def modules_in(state: Path, module: str, *, insecure: bool) -> tuple[dict[str, str], list[str]]:
    """The folders of a state directory: those of a module and its gateway, with what is said of them; and others.

    Args:
        state: The directory.
        module: The module.
        insecure: Whether it may be without keys although others have some.

    Raises:
        StartError: It may not.
    """
    wanted = {module_dir(state, each) for each in (module, module + GATEWAY_SUFFIX)}
    folders = [path for path in entries(state) if path.is_dir() and not path.is_symlink()]
    keys = {path: (path / "trust").is_dir() for path in folders}
    others = [path.name for path in folders if path not in wanted]
    secured = [path.name for path in folders if keys[path] and path not in wanted]
    if secured and not keys.get(module_dir(state, module)) and not insecure:
        problem = f"it has no keys in {state}, but {', '.join(secured)} has"
        remedy = f"install that one, --name {secured[0]}; or first: rmpa trust join --name {module} TOKEN"
        raise StartError(f"the module {module}", problem, remedy, code="keys-unusable")
    ours = [path for path in folders if path in wanted]
    return {path.name: f"{path.name}/{' with keys of a secured mesh' if keys[path] else ''}" for path in ours}, others


def copy_state(state: Path, place: Path, ids: tuple[int, int] | None, without: Collection[str] = ()) -> None:
    """Copy files and folders into a new folder, which no other user can reach before it takes its place.

    Args:
        state: The user's state directory. Links in it are not followed.
        place: That of the units: missing or empty.
        ids: User and group that it is to belong to; ``None``: it stays this user's.
        without: Folders in it that are left out.

    Raises:
        StartError: It cannot be copied; then nothing was.
    """
    place = place.resolve()  # of a link
    new = None
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        new = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
        _copy_files(state.resolve(), new, without)
        if ids is not None:
            for path in (*new.rglob("*"), new):
                os.chown(path, *ids)
        new.replace(place)
    except OSError as error:
        if new is not None:
            shutil.rmtree(new, ignore_errors=True)
        problem = f"{state} cannot be copied there: {error}"
        raise StartError(str(place), problem, "nothing was copied", code="directory-unusable") from None


def _copy_files(state: Path, new: Path, without: Collection[str]) -> None:
    def fail(error: OSError) -> None:
        raise error

    for folder, folders, names, place in os.fwalk(state, onerror=fail):
        to = new / Path(folder).relative_to(state)
        if Path(folder) == state:
            folders[:] = [name for name in folders if name not in without]
        for name in folders:
            if stat.S_ISDIR(os.stat(name, dir_fd=place, follow_symlinks=False).st_mode):
                (to / name).mkdir(mode=0o700)
        for name in names:
            if name == PLACES_FILE or not stat.S_ISREG(os.stat(name, dir_fd=place, follow_symlinks=False).st_mode):
                continue
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            with os.fdopen(os.open(name, flags, dir_fd=place), "rb") as source, (to / name).open("xb") as copy:
                os.fchmod(copy.fileno(), os.fstat(source.fileno()).st_mode & 0o777)
                shutil.copyfileobj(source, copy)


def remove_folder(place: Path, root: str) -> None:
    """Remove a folder, and the link that leads to it: below another system's folder the link alone.

    Raises:
        StartError: It cannot be removed.
    """
    try:
        if not (root and place.is_symlink()):
            shutil.rmtree(place.resolve())
        if place.is_symlink():
            place.unlink()
    except OSError as error:
        raise StartError(str(place), f"cannot be removed: {error}", code="directory-unusable") from None
