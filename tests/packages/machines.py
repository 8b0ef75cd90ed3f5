"""Machines of several Debian releases: chroots of ``packaging/test/chroot``, each in the network of a lab's host.

::

    with Lab() as lab, Machine(lab.host("robot", 0), "bullseye") as robot:
        robot.run("apt-get", "install", "-y", robot.put(package), online=True)
        robot.start("rmpa", "up").wait_for("ROS_MASTER_URI")

What is written there is kept in memory and gone at its end. It has a process table, a host name and users of its own:
``root`` and ``robot``.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Self

from lab.bed import namespaces
from lab.bed.namespaces import Host
from lab.bed.processes import DEADLINE, BedError, Process, eventually, run
from lab.bed.ros import words

CLONE: Final = Path(__file__).parents[2]
# Where the talker and the listener of the tests are on a machine.
NODES: Final = "/srv/nodes"
_ENTER: Final = CLONE / "scripts/enter-chroot"
_SOURCES: Final = [CLONE / "lab/nodes", CLONE / "tests/interop/nodes"]
_PROGRAMS: Final = ("talker", "listener")
# Seconds until a chroot is built: minutes on a fast line, and arm64's is emulated.
_BUILT: Final = 900.0
_BOOT: Final = """
mount -t sysfs sysfs /sys 2>/dev/null || true
echo "$1" >/etc/hostname
hostname "$1" 2>/dev/null && echo "127.0.1.1 $1" >>/etc/hosts
useradd --create-home --shell /bin/bash robot
[ ! -d /etc/sudoers.d ] || echo "robot ALL=(ALL) NOPASSWD: ALL" >/etc/sudoers.d/robot
echo booted
[ "$2" = systemd ] || while :; do sleep 1000; done
mount -t cgroup2 cgroup2 /sys/fs/cgroup
mkdir /dev/pts
mount -t devpts -o newinstance,ptmxmode=0666,mode=620 devpts /dev/pts
ln -s pts/ptmx /dev/ptmx
exec env -i container=lxc PATH="$PATH" /lib/systemd/systemd --unit=multi-user.target >/dev/null 2>&1
"""
_IN_A_CGROUP: Final = 'mkdir "$0" && echo $$ >"$0/cgroup.procs" && exec unshare --cgroup "$@"'


@functools.cache
def why_not() -> str:
    """Why there can be no such machines here, or an empty string."""
    if reason := namespaces.why_not():
        return reason
    return "" if shutil.which("apt-get") else "chroots of Debian need apt and debootstrap"


@functools.cache
def why_no_systemd() -> str:
    """Why no machine can be booted by systemd here, or an empty string."""
    return why_not() or ("" if os.access(_cgroups() or "/-", os.W_OK) else "no control groups (cgroup2) can be made")


def _cgroups() -> str:
    """Where the hierarchy of control groups is mounted; empty where there is none."""
    mounts = [line.split() for line in Path("/proc/mounts").read_text().splitlines()]
    return next((mount[1] for mount in mounts if mount[2] == "cgroup2"), "")


@functools.cache
def chroot(suite: str, arch: str, kind: str) -> Path:
    """The tree of a release, built if it is not there yet."""
    build: list[str | Path] = [CLONE / "packaging/test/chroot", suite, arch, kind]
    done = subprocess.run(build, stdout=subprocess.PIPE, text=True, timeout=_BUILT, check=False)
    if done.returncode:
        raise BedError(f"no Debian {suite} ({arch}, {kind}) could be built; its own words stand above")
    root = Path(done.stdout.strip())
    if kind != "bare":
        _put_nodes(root, compiled=kind == "robot")
    return root


def _put_nodes(root: Path, *, compiled: bool) -> None:
    """Put the tests' talker and listener there, those of C++ compiled; anew when they have changed."""
    sources = [path for folder in _SOURCES for path in sorted(folder.glob("*.[ch]pp")) + sorted(folder.glob("*.py"))]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    place = root / NODES.removeprefix("/")
    mark = place / "digest"
    if mark.exists() and mark.read_text() == digest:
        return
    place.mkdir(parents=True, exist_ok=True)
    for path in sources:
        shutil.copy(path, place)
    flags = f"-std=c++17 -O1 -I{NODES} $(pkg-config --cflags --libs roscpp)"
    for program in _PROGRAMS if compiled else ():
        command = f"g++ {NODES}/{program}.cpp -o {NODES}/{program} {flags}"
        run([_ENTER, root, "sh", "-c", command], timeout=300.0)
    mark.write_text(digest)


class Machine:
    """A Debian of one release on a host of a lab.

    Args:
        host: Its network.
        suite: Its release.
        arch: Its architecture.
        kind: What it has; see packaging/test/chroot.
        systemd: Whether it is booted by systemd (kind robot), which then has a control group of its own.
    """

    def __init__(
        self, host: Host, suite: str, arch: str = "amd64", kind: str = "robot", *, systemd: bool = False
    ) -> None:
        self.host, self.suite = host, suite
        self._cgroup = Path(_cgroups(), f"rmpa-test-{os.getpid()}-{host.name}") if systemd else None
        self._tree = chroot(suite, arch, kind)
        boot: list[str | Path] = [_ENTER, "--fresh", self._tree, "sh", "-c", _BOOT, "boot", host.name]
        boot.append("systemd" if systemd else "")
        grouped: list[str | Path] = ["sh", "-c", _IN_A_CGROUP, self._cgroup] if self._cgroup else []
        self._started = [Process([*grouped, *host.command(boot)], name=f"boot of {host.name}")]
        self._started[0].wait_for("^booted")
        mine = self._started[0].pid
        self._first = int(Path(f"/proc/{mine}/task/{mine}/children").read_text().split()[-1])
        if systemd:
            self.run("sh", "-c", "until systemctl is-system-running | grep -E 'running|degraded'; do sleep 0.1; done")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        while self._started:
            self._started.pop().end()
        if (group := self._cgroup) is not None:
            eventually(
                lambda: "populated 0" in (group / "cgroup.events").read_text(), what="the end of its processes"
            )
            for path in sorted((path for path in group.rglob("*") if path.is_dir()), reverse=True):
                path.rmdir()
            group.rmdir()

    @property
    def root(self) -> Path:
        """Its file system, as this process reaches it."""
        return Path(f"/proc/{self._first}/root")

    def put(self, source: Path, user: str = "root") -> str:
        """Copy a file into a user's home; return its name there, with ./ before it."""
        target = self.root / _home(user)[1:] / source.name
        shutil.copy(source, target)
        os.chmod(target, 0o644)  # noqa: PTH101
        return f"./{source.name}"

    def bind(self, folder: Path) -> Path:
        """Show a folder of the real machine to all users here, under the same name; return that."""
        self.run("mkdir", "-p", str(folder))
        self.run("chmod", "a+x", *(str(parent) for parent in folder.parents))
        place = f"{self._tree}{folder}"  # its own mounts, but still the names of the real machine
        run(["nsenter", "--target", str(self._first), "--mount", "mount", "--bind", folder, place])
        return folder

    def command(
        self, *argv: str, user: str = "root", env: Mapping[str, str] | None = None, online: bool = False
    ) -> list[str]:
        """The command line of ``argv`` in the home of a user, in an environment that has nothing of ours.

        Args:
            argv: The command.
            user: Its user.
            env: What the environment has beside HOME, PATH and LANG.
            online: Whether it is in this machine's own network, which reaches package registries, not in the lab's.
        """
        home = _home(user)
        path = f"{home}/.local/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
        basic = {"HOME": home, "PATH": path, "LANG": "C.UTF-8", "PYTHONUNBUFFERED": "1", **(env or {})}
        parts = ["--mount", "--pid", "--uts", "--root", "--wd", *([] if online else ["--net"])]
        if (Path(f"/proc/{self._first}/ns/user").readlink()) != Path("/proc/self/ns/user").readlink():
            parts.append("--user")
        become = [] if user == "root" else ["setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups"]
        clean = ["env", "-i", f"--chdir={home}", *(f"{name}={value}" for name, value in basic.items())]
        return ["nsenter", "--target", str(self._first), *parts, *clean, *become, *argv]

    def run(
        self,
        *argv: str,
        user: str = "root",
        env: Mapping[str, str] | None = None,
        online: bool = False,
        timeout: float = DEADLINE,
    ) -> str:
        """Run a command to its end; return its output; a failure raises. Arguments as of ``command``."""
        return run(self.command(*argv, user=user, env=env, online=online), timeout=timeout)

    def start(self, *argv: str, user: str = "root", env: Mapping[str, str] | None = None) -> Process:
        """Start a command, which ends with the machine. Arguments as of ``command``."""
        process = Process(self.command(*argv, user=user, env=env), name=f"{Path(argv[0]).name}@{self.host.name}")
        self._started.append(process)
        return process

    def node(self, client: str, program: str, **options: object) -> Process:
        """Start the ``talker`` or ``listener`` of the tests by its client library, ``rospy`` or ``roscpp``."""
        argv = ["/usr/bin/python3", f"{NODES}/{program}.py"] if client == "rospy" else [f"{NODES}/{program}"]
        return self.start(*argv, *words(options))


def _home(user: str) -> str:
    return "/root" if user == "root" else f"/home/{user}"
