"""What runs RMPA at boot: units of systemd, their drop-ins, ``/etc/rmpa/rmpa.toml``; and the machine that gets them.

``rmpa service install`` writes these texts, and so does the build of the Debian package:

::

    from rmpa.cli.units import config_text, unit_texts

    for name, text in unit_texts("/usr/bin/rmpa").items(): ...  # rmpa.service, rmpa-web.service, rmpa-gateway.service
    config_text()                                               # /etc/rmpa/rmpa.toml

A key that is newer than the system's systemd is left out there, and said in the journal; none of the others needs it.
"""

from __future__ import annotations

import grp
import os
import pwd
import re
import shutil
import stat
import subprocess
import sys
import tempfile
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.config.module_name import PLACES_FILE
from rmpa.core.errors import ConfigError, RmpaError, StartError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

# The user and group of the units, and their directories.
USER: Final = "rmpa"
GROUP: Final = "rmpa"
RUNTIME: Final = "/run/rmpa"
STATE: Final = "/var/lib/rmpa"
CONFIG: Final = "/etc/rmpa/rmpa.toml"
# The program of the Debian package, which has man pages.
PACKAGED: Final = "/usr/bin/rmpa"
# By the command behind ``rmpa``: its unit.
UNITS: Final = {"up": "rmpa.service", "web": "rmpa-web.service", "gateway": "rmpa-gateway.service"}
# The drop-ins of the agent's unit, by the option of ``rmpa service install``; below the folder of units.
DROP_INS: Final = {"realtime": "rmpa.service.d/realtime.conf", "resources": "rmpa.service.d/resources.conf"}

# The folder of the administrator's units; a package has its own in one of the others.
UNIT_FOLDER: Final = "/etc/systemd/system"
_PACKAGED_UNITS: Final = ("/usr/lib/systemd/system", "/lib/systemd/system")
# What `systemctl show` is asked for.
_PROPERTIES: Final = (
    *("LoadState", "ActiveState", "SubState", "UnitFileState", "Result", "MainPID", "NRestarts"),
    *("StateChangeTimestampMonotonic", "FragmentPath"),
)
# Lines of a unit's log that are shown.
_LOG_LINES: Final = 5
# Where systemd runs (sd_booted(3)).
_BOOTED: Final = Path("/run/systemd/system")
_DESCRIPTIONS: Final = {
    "up": "RMPA agent: this module's ROS core and its place in the mesh",
    "web": "RMPA web server: metrics, REST and pages of this machine's module",
    "gateway": "RMPA gateway: joins this network's modules with other sites and with ROS 2",
}
_UNIT: Final = """\
[Unit]
Description={description}
{documentation}# Interfaces that come later are followed: there is no need for network-online.target.
After=network.target{after}
# It is started again however often it fails, except for settings that it cannot run with.
StartLimitIntervalSec=0

[Service]
Type=notify
ExecStart={program} {command} --config {config}
# It waits for the answer, and fails with what the settings lack.
{reload}
Restart=always
RestartSec=0.5
RestartPreventExitStatus=2
# An event loop that hangs for so long is ended, and started again.
WatchdogSec=10
TimeoutStopSec=15
KillMode=mixed
User={user}
Group={group}
# The control sockets. They are found without a setting; members of the group may use them.
RuntimeDirectory=rmpa
RuntimeDirectoryMode=0750
RuntimeDirectoryPreserve=yes
# What is kept over a restart: registrations, the module's name, keys of a secured mesh.
StateDirectory=rmpa
StateDirectoryMode=0700
Environment=RMPA_RUNTIME_DIR={runtime} RMPA_STATE_DIR={state} RMPA_CONTROL_GROUP={group}
# Variables of yours, such as ROS_PACKAGE_PATH.
EnvironmentFile=-/etc/default/rmpa
SyslogIdentifier={identifier}
# Sockets, mostly: one for each connection of a node.
LimitNOFILE=65536
{capabilities}
# Nothing of the system but the network.
UMask=0077
NoNewPrivileges=yes
ProtectSystem=strict
ProtectHome=read-only
PrivateTmp=yes
PrivateDevices=yes
PrivateMounts=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectProc=invisible
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
LockPersonality=yes
MemoryDenyWriteExecute=yes
RemoveIPC=yes
SystemCallArchitectures=native
SystemCallErrorNumber=EPERM
# A list of what is denied: older versions of systemd do not know the groups that a list of what is allowed needs.
SystemCallFilter=~@clock @cpu-emulation @debug @module @mount @obsolete @raw-io @reboot @swap

[Install]
WantedBy=multi-user.target
"""
# The agent's alone.
_NET_ADMIN: Final = """\
# To end connections whose host has vanished (docs/guides/direct-transport.md#cap_net_admin).
AmbientCapabilities=CAP_NET_ADMIN
CapabilityBoundingSet=CAP_NET_ADMIN"""
_DROP_INS: Final = {
    "realtime": """\
# rmpa up --realtime (docs/guides/running.md#real-time).
[Service]
Environment=RMPA_REALTIME=true
LimitRTPRIO=50
LimitMEMLOCK=infinity
RestrictRealtime=no
""",
    "resources": """\
# Nodes that the agent starts ([resources] in rmpa.toml) may use devices, CAN and compilers at run time, and go on
# when the agent is killed. Which devices is said by groups: sudo usermod -aG video,dialout USER of the unit.
[Service]
PrivateDevices=no
MemoryDenyWriteExecute=no
RestrictAddressFamilies=
KillMode=process
""",
}
_SETTING: Final = re.compile(r"^(?=[a-z_]+ = )", re.MULTILINE)
_HEADING: Final = """\
# rmpa.toml: the settings of this machine's module. To change one, remove the "# " in front of it. Where two lines
# have one key, the first is the default and the second an example. After a change: sudo systemctl reload rmpa
# docs/ is /usr/share/doc/rmpa/docs with the Debian package, else a folder of the repository.
"""


def unit_texts(program: str = PACKAGED, user: str = USER) -> dict[str, str]:
    """The units, by their file's name.

    Args:
        program: The absolute path of ``rmpa``.
        user: The user whose rights they have; its group is ``GROUP`` in any case.
    """
    quoted = program.replace("%", "%%").replace(" ", "\\x20")
    return {
        unit: _UNIT.format(
            description=_DESCRIPTIONS[command],
            documentation="Documentation=man:rmpa(1)\n" if program == PACKAGED else "",
            after="" if command == "up" else f" {UNITS['up']}",
            program=quoted,
            command=command,
            config=CONFIG,
            reload="\n".join(f"ExecReload={words}" for words in _reload(command, quoted)),
            user=user,
            group=GROUP,
            runtime=RUNTIME,
            state=STATE,
            identifier=unit.removesuffix(".service"),
            capabilities=_NET_ADMIN if command == "up" else "CapabilityBoundingSet=",
        )
        for command, unit in UNITS.items()
    }


def _reload(command: str, program: str) -> tuple[str, ...]:
    """The commands that have the process of a unit read its settings again; the web server has no control socket."""
    if command == "web":
        return f"{program} web --config {CONFIG} --check", "/bin/kill -HUP $MAINPID"
    return (f"{program} reload --agent $MAINPID",)


def drop_in_text(option: str, header: str = "") -> str:
    """The drop-in of an option of ``DROP_INS``."""
    return header + _DROP_INS[option]


def config_text() -> str:
    """A first ``rmpa.toml``: every setting with its default, each in a comment, so that later defaults hold."""
    _, _, rest = (files("rmpa.config") / "rmpa.toml").read_text("utf-8").partition("\n")
    return _HEADING + _SETTING.sub("# ", rest)


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
        # Tells of something that is so already, too.
        self.tell = tell

    def check(self, verb: str) -> None:
        """Check that ``rmpa service VERB`` can change it.

        Raises:
            StartError: There is no systemd, or this user is not root.
        """
        if self.root:
            if not Path(self.root).is_dir():
                raise ConfigError("--root", f"{self.root} is no folder")
        elif not _BOOTED.is_dir() or shutil.which("systemctl") is None:
            problem = "this machine was not started by systemd (a container?)"
            raise refused(verb, problem, "have `rmpa up` started by what starts programs here")
        if os.geteuid() and not self.root and not self.dry:
            given = sys.argv[1:] if sys.argv[1:2] == ["service"] else ["service", verb]
            remedy = f"sudo {' '.join((own_program(), *given))}"
            raise refused(verb, "only root may change the machine", remedy, "root-needed")

    def path(self, place: str) -> Path:
        """Where a file of the machine is."""
        return Path(f"{self.root}{place}")

    def change(self, text: str) -> bool:
        """Tell of a change; return whether it is to be made."""
        self.changes.append(text)
        self.tell(f"{'would ' if self.dry else ''}{text}")
        return not self.dry

    def run(self, text: str, program: str, *words: str) -> None:
        """Change something by a program, which is told of the folder.

        Raises:
            RmpaError: It is not there, or it fails; in its own words.
        """
        if not self.change(text):
            return
        below = ["--root" if program == "systemctl" else "--prefix", self.root] if self.root else []
        command = [program, *below, *words]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own words
        except OSError as error:
            raise RmpaError(f"{program}: {error.strerror}", code="service-unit") from None
        if done.returncode:
            problem = (done.stderr or done.stdout).strip() or f"exit code {done.returncode}"
            raise RmpaError(f"{' '.join(command)}: {problem}", code="service-unit")

    def systemctl(self, *words: str) -> None:
        """Run ``systemctl`` on the machine."""
        self.run(f"run systemctl {' '.join(words)}", "systemctl", *words)

    def shown(self, unit: str) -> dict[str, str]:
        """What ``systemctl show`` says of a unit; empty where it says nothing."""
        lines = _said("systemctl", "show", unit, f"--property={','.join(_PROPERTIES)}")
        return dict(line.partition("=")[::2] for line in lines)

    def log(self, unit: str) -> list[str]:
        """The last lines of a unit's log; empty for a user who may not read it."""
        options = ("--quiet", "--no-pager", "--output=cat", f"--lines={_LOG_LINES}", f"--unit={unit}")
        return _said("journalctl", *options)

    def write(self, place: str, text: str) -> bool:
        """Write a file unless it has this text already; return whether it has another one now."""
        path = self.path(place)
        if path.is_file() and path.read_text("utf-8", "replace") == text:
            self.tell(f"{place} is as it should be")
            return False
        if self.change(f"write {place}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(f".{path.name}.new")  # what a link leads to stays as it is
            temporary.write_text(text, "utf-8")
            temporary.chmod(0o644)
            temporary.replace(path)
        if self.dry:
            self.tell("".join(f"    {line}\n" for line in text.splitlines()).rstrip("\n"))
        return True

    def remove_folder(self, place: Path) -> None:
        """Remove a folder, and the link that leads to it: below another system's folder the link alone.

        Raises:
            StartError: It cannot be removed.
        """
        try:
            if not (self.root and place.is_symlink()):
                shutil.rmtree(place.resolve())
            if place.is_symlink():
                place.unlink()
        except OSError as error:
            raise StartError(str(place), f"cannot be removed: {error}", code="directory-unusable") from None

    def ids(self, user: str) -> tuple[int, int] | None:
        """The numbers of a user and of the units' group; ``None``: one of them is not there."""
        uid, gid = self.number("user", user), self.number("group", GROUP)
        return None if uid is None or gid is None else (uid, gid)

    def number(self, kind: str, name: str) -> int | None:
        """The number of a ``user`` or a ``group``; ``None``: it is not there."""
        try:
            if not self.root:
                return pwd.getpwnam(name).pw_uid if kind == "user" else grp.getgrnam(name).gr_gid
            database = self.path("/etc/passwd" if kind == "user" else "/etc/group")
            entries = [line.split(":") for line in database.read_text("utf-8").splitlines()]
        except (KeyError, OSError):
            return None
        return next((int(entry[2]) for entry in entries if entry[0] == name and len(entry) > 2), None)

    def unit(self, name: str) -> Path:
        """Where the administrator's file of a unit or a drop-in is."""
        return self.path(f"{UNIT_FOLDER}/{name}")

    def has_packaged(self, unit: str = UNITS["up"]) -> bool:
        """Whether a package has brought a unit."""
        return any(self.path(f"{folder}/{unit}").is_file() for folder in _PACKAGED_UNITS)

    def check_unmasked(self, unit: str) -> None:
        """Raise ``StartError`` if a unit is masked, so that it cannot be started."""
        path = self.unit(unit)
        if path.is_symlink() and str(path.readlink()) == os.devnull:
            below = f"--root {self.root} " if self.root else ""
            remedy = f"systemctl {below}unmask {unit.removesuffix('.service')}"
            raise StartError(f"{UNIT_FOLDER}/{unit}", "the unit is masked", remedy, code="service-unit")


def refused(verb: str, problem: str, remedy: str, code: str = "service-unit") -> StartError:
    """The error of ``rmpa service VERB``."""
    return StartError(f"rmpa service {verb}", problem, remedy, code=code)


def _said(*command: str) -> list[str]:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own words
    except OSError:
        return []
    return done.stdout.splitlines()


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
