"""Which module a command is about, and where it keeps its state.

Which module a command is about: one decision for all commands.

::

    option > RMPA_AGENT > RMPA_NAME > rmpa.toml > the agent that runs > the name of the first start > the default

A name that is *said* (the first four) holds, whatever runs. Agents that run count for commands beside an agent alone:
``rmpa up`` starts one.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import re
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.core.identity import peer_name_problem

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

# The state directory below a home directory.
_IN_HOME: Final = Path(".local/state/rmpa")
# What a gateway's name has behind that of its module.
GATEWAY_SUFFIX = "_gateway"


class NameSource(Enum):
    """Why a name was chosen, the strongest reason first."""

    OPTION = "the option"
    # Commands that start an agent leave it out.
    AGENT_VARIABLE = "RMPA_AGENT"
    VARIABLE = "RMPA_NAME"
    FILE = "name in rmpa.toml"
    RUNNING = "the agent that runs here"
    KEPT = "the name of the first start"
    DEFAULT = "this host's name"

    @property
    def said(self) -> bool:
        """Whether the user has said it for this command; it then holds, whatever runs."""
        return self not in (NameSource.RUNNING, NameSource.KEPT, NameSource.DEFAULT)


class ModuleName(NamedTuple):
    """A name, and why it was chosen."""

    name: str
    source: NameSource

    def __str__(self) -> str:
        """``base (name in rmpa.toml)``."""
        return f"{self.name} ({self.source.value})"


def choose_name(
    names: Mapping[NameSource, str], running: Sequence[str] = (), gateways: Sequence[str] = (), of_master: str = ""
) -> ModuleName:
    """The module that a command is about.

    Args:
        names: The name as each source has it; empty: that one has none.
        running: The agents that run on this machine; commands that start one leave them out.
        gateways: Those among them that are gateways.
        of_master: The one among them whose core ROS_MASTER_URI names; empty: none.

    Raises:
        RmpaError: Several agents run, and nothing says which is meant.
    """
    for source in NameSource:
        if source is NameSource.RUNNING and running:
            return ModuleName(running_agent(names, running, gateways, of_master), source)
        if names.get(source):
            return ModuleName(names[source], source)
    return ModuleName("", NameSource.DEFAULT)


def running_agent(
    names: Mapping[NameSource, str], running: Sequence[str], gateways: Sequence[str], of_master: str
) -> str:
    """Which of the agents that run is meant: the only one, that of ROS_MASTER_URI, that of a name, the only module.

    Args as for ``choose_name``, with at least one agent; the names of variable, file and first start choose among
    them alone.

    Raises:
        RmpaError: It could be several.
    """
    if len(running) == 1:
        return running[0]
    said = (names.get(source) for source in (NameSource.VARIABLE, NameSource.FILE, NameSource.KEPT))
    for name in (of_master, *said):
        if name and name in running:
            return name
    modules = [name for name in running if name not in gateways]
    if len(modules) == 1:
        return modules[0]
    listed = ", ".join(running)
    raise RmpaError(
        f"several agents run on this machine: {listed}; name one with --agent NAME or RMPA_AGENT", code="several-fit"
    )


# The directory of files that survive a program's end, and the name of this machine's module, which is kept there.


def state_dir(environ: Mapping[str, str], setting: str | None = None) -> Path | None:
    """The directory of all files that survive a run; it need not exist yet.

    The first of: the setting, RMPA_STATE_DIR, STATE_DIRECTORY (systemd's, for a unit with ``StateDirectory=``),
    ``rmpa`` below XDG_STATE_HOME, ``~/.local/state/rmpa``.

    Returns:
        ``None`` if none of these is set and the user has no home directory.
    """
    if setting or environ.get("RMPA_STATE_DIR"):
        return Path(setting or environ["RMPA_STATE_DIR"])
    if environ.get("STATE_DIRECTORY"):
        return Path(environ["STATE_DIRECTORY"].partition(":")[0])
    if environ.get("XDG_STATE_HOME"):
        return Path(environ["XDG_STATE_HOME"]) / "rmpa"
    if environ.get("HOME"):
        return Path(environ["HOME"]) / _IN_HOME
    return None


def of_unit(environ: Mapping[str, str]) -> Mapping[str, str]:
    """For commands of root beside an agent: where that starts at boot and nothing is said, its directory is meant."""
    said = environ.get("RMPA_STATE_DIR") or environ.get("STATE_DIRECTORY")
    if said or os.geteuid() or not _AT_BOOT.is_symlink():
        return environ
    return {**environ, "RMPA_STATE_DIR": str(_SYSTEM)}


def module_dir(directory: Path, module: str) -> Path:
    """The folder of one module's files within the state directory."""
    return directory / (re.sub(r"[^\w.-]", "_", module).lstrip(".") or "_")


def core_file(environ: Mapping[str, str], port: int, module: str = "", setting: str = "") -> Path | None:
    """The file of a ROS core, named by module and port, so that two cores on one machine do not share a file.

    Args:
        environ: As for ``state_dir``.
        port: The core's port; with 0 (chosen by the system) there is no file, because the next run has another port.
        module: Empty for a core without an agent.
        setting: As for ``state_dir``.
    """
    directory = state_dir(environ, setting or None)
    if directory is None or not port:
        return None
    return (module_dir(directory, module) if module else directory) / f"core-{port}.state"


# In the state directory: the name of this machine's module. No folder of a module is named so: it has a dash.
NAME_FILE: Final = "module-name"
# In the state directory of the user's home: others in which modules have joined a secured mesh, one a line.
PLACES_FILE: Final = "state-directories"
_READ_MAX: Final = 64 * 1024
# The state directory of a systemd unit with ``StateDirectory=rmpa``.
_SYSTEM: Final = Path("/var/lib/rmpa")
# It is there if that unit starts at boot.
_AT_BOOT: Final = Path("/etc/systemd/system/multi-user.target.wants/rmpa.service")
_NOGROUP: Final = 65534


@contextlib.contextmanager
def as_owner(directory: Path) -> Iterator[Path]:
    """Change a state directory of another user as root with the rights of that user, wherever links lead.

    The whole process has them, and works in that directory, until the block ends: for programs of one
    thread. Nothing is to be imported in the block: the owner may not read the folder of the program.

    Yields:
        The directory's path in the block.
    """
    with contextlib.ExitStack() as back:
        place = os.open(directory, os.O_PATH | os.O_DIRECTORY)
        back.callback(os.close, place)
        owner = os.fstat(place)
        if os.geteuid() != 0 or owner.st_uid == 0:
            yield directory
            return
        before = os.open(".", os.O_PATH | os.O_DIRECTORY)
        back.callback(os.close, before)
        back.callback(os.fchdir, before)
        os.fchdir(place)  # there may be folders above that the owner cannot search, as those of an image
        back.callback(os.setgroups, os.getgroups())
        os.setgroups([])
        back.callback(os.setegid, os.getegid())
        os.setegid(owner.st_gid or _NOGROUP)
        back.callback(os.seteuid, 0)
        os.seteuid(owner.st_uid)
        yield Path()


def kept_name(directory: Path | None) -> str:
    """The name that is kept in a state directory; empty: none, or this user cannot read it.

    Raises:
        ConfigError: The file has something else.
    """
    if directory is None:
        return ""
    text = _read(directory / NAME_FILE).strip()
    if text and (problem := peer_name_problem(text)):
        raise ConfigError("the module's name", problem, "write it there, or remove the file", directory / NAME_FILE)
    return text


def keep_name(directory: Path, name: str, *, instead: bool = False) -> bool:
    """Keep a name as that of this machine's module; return whether it is kept there now.

    Args:
        directory: The state directory; made if needed.
        name: The name.
        instead: Whether it takes the place of another one; else the first one stays.

    Raises:
        StartError: It cannot be written.
    """
    path = directory / NAME_FILE
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        with as_owner(directory) as here:  # the agent runs as that user, and is to read it
            temporary = here / f".{NAME_FILE}.{os.getpid()}"
            temporary.unlink(missing_ok=True)
            temporary.write_bytes(f"{name}\n".encode())
            try:
                if instead:
                    temporary.replace(here / NAME_FILE)
                else:
                    os.link(temporary, here / NAME_FILE)  # fails where there is one: of two first starts one is first
            except FileExistsError:
                return kept_name(here) == name
            finally:
                temporary.unlink(missing_ok=True)
    except OSError as error:
        raise StartError(
            str(path), f"cannot be written: {error.strerror}", "say --name at each start", code="directory-unusable"
        ) from None
    return True


def usual_state_dirs(environ: Mapping[str, str]) -> list[Path]:
    """The state directories where nothing names one (no setting, RMPA_STATE_DIR or STATE_DIRECTORY).

    Under ``sudo`` that of the user who called it; that of XDG_STATE_HOME or HOME; and, last, that of this user's home
    directory in the password database, from which no variable leads away.
    """
    said = ("RMPA_STATE_DIR", "STATE_DIRECTORY")
    by_variable = state_dir({name: value for name, value in environ.items() if name not in said})
    caller = environ.get("SUDO_UID", "")
    places = [_place_of(int(caller))] if caller.isdecimal() else []
    places += [by_variable, _place_of(os.geteuid())]
    return list(dict.fromkeys(place for place in places if place is not None))


def _home_of(user: int) -> Path | None:
    try:
        return Path(pwd.getpwuid(user).pw_dir)
    except (KeyError, OverflowError):
        return None


def _place_of(user: int) -> Path | None:
    home = _home_of(user)
    return home / _IN_HOME if home is not None else None


def other_state_dirs(environ: Mapping[str, str], used: Path | None) -> list[Path]:
    """State directories besides the one in use in which modules of this user may have files: as far as it is known.

    Args:
        environ: As for ``state_dir``. It adds places; none takes one away.
        used: The one in use.
    """
    usual = usual_state_dirs(environ)
    listed = [line for place in usual for line in _read(place / PLACES_FILE).splitlines() if line]
    places = [*usual, *map(Path, listed), _SYSTEM]
    return [place for place in dict.fromkeys(places) if place != used]


def note_state_dir(used: Path) -> str:
    """Note a state directory with keys, so that a start by other variables or settings notices them.

    The note is in the home directory of the password database, where every start looks; root makes one for the owner
    of the directory too, with whose rights the agent may run.

    Returns:
        Why it could not be noted; empty: it is, or every start looks into that directory.
    """
    used = used.absolute()
    if used == _SYSTEM:
        return ""
    users = dict.fromkeys((os.geteuid(), used.stat().st_uid) if os.geteuid() == 0 else (os.geteuid(),))
    return next(filter(None, [_note(user, used) for user in users]), "")


def _note(user: int, used: Path) -> str:
    home = _home_of(user)
    if home is None:
        return f"user {user} has no home directory in the password database"
    if used == home / _IN_HOME:
        return ""
    try:
        if home.stat().st_uid != user != os.geteuid():
            return f"{home} does not belong to user {user}"
        with as_owner(home) as here:
            file = here / _IN_HOME / PLACES_FILE
            text, line = _read(file), f"{used}\n"
            if line in text.splitlines(keepends=True):
                return ""
            if len(text.encode()) + len(line.encode()) > _READ_MAX:
                return f"{home / _IN_HOME / PLACES_FILE} is full"
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with file.open("a", encoding="utf-8") as opened:
                opened.write(line)
    except OSError as error:
        return f"{home / _IN_HOME / PLACES_FILE}: {error.strerror}"
    return ""


def _read(path: Path) -> str:
    try:
        if not path.is_file():  # a pipe would be waited for
            return ""
        with path.open("rb") as file:
            return file.read(_READ_MAX).decode("utf-8", "replace")
    except OSError:
        return ""
