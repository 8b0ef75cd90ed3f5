"""Debian's real ROS 1: a user's shell with a master, the stock tools, and nodes of a folder such as ``nodes/``.

::

    with Ros(host, tmp_path) as ros:                    # the master at 127.0.0.1:11311 of that host
        listener = ros.roscpp("listener", topic="/chatter", count=100)
        listener.wait_event("up")
        ros.rospy("talker", topic="/chatter", rate=100, count=100)
        report = listener.wait_event("done")
        assert "/chatter" in ros.tool("rostopic", "list")

Nodes take ``--word value`` pairs, given here as keyword arguments (``True`` becomes a bare flag); see ``nodes/``.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import http.client
import itertools
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import xmlrpc.client
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

from lab.bed.namespaces import MACHINE, Host
from lab.bed.processes import DEADLINE, BedError, Closing, Process, run

if TYPE_CHECKING:
    from collections.abc import Mapping

# The interpreter that Debian's rospy is installed for.
PYTHON: Final = "/usr/bin/python3"
NODES: Final = Path(__file__).parents[1] / "nodes"
# What roscpp nodes include as <rmpa_ros/rmpa_ros.h>.
CLIENT_HEADERS: Final = Path(__file__).parents[2] / "packaging/ros/rmpa_ros/include"
_SYSTEM_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
# Programs that end others, which are in sessions of their own.
_PARENTS: Final = ("roscore", "roslaunch", "launch")
_numbers = itertools.count(1)


@functools.cache
def why_not() -> str:
    """Why real ROS nodes cannot run here, or an empty string."""
    if not Path(PYTHON).exists():
        return f"ROS 1 is not installed (no {PYTHON})"
    found = subprocess.run([PYTHON, "-c", "import rospy"], capture_output=True, check=False, env=_clean_environment())
    if found.returncode:
        return "ROS 1 is not installed (scripts/install-ros installs Debian's)"
    if missing := [word for word in ("rosmaster", "rostopic", "g++", "pkg-config") if shutil.which(word) is None]:
        return f"ROS 1 is not installed in full: no {', '.join(missing)} (scripts/install-ros installs Debian's)"
    return ""


@functools.cache
def lacks(package: str) -> str:
    """Why tests that need a further Python package of ROS cannot run here, or an empty string."""
    found = subprocess.run(
        [PYTHON, "-c", f"import {package}"], capture_output=True, check=False, env=_clean_environment()
    )
    return f"no {package} for ROS here (scripts/install-ros installs Debian's)" if found.returncode else ""


def free_port(address: str = "127.0.0.1", kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port that is free at this moment (on the real machine; a namespace's ports are all free)."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((address, 0))
        port: int = probe.getsockname()[1]
        return port


def environment(home: Path, port: int) -> dict[str, str]:
    """What a ROS user's shell has: the master at loopback, everything written below ``home``, nothing of ours."""
    return {
        **_clean_environment(),
        "HOME": str(home),
        "ROS_MASTER_URI": f"http://127.0.0.1:{port}/",
        "ROS_IP": "127.0.0.1",
        "ROS_HOME": str(home),
        "ROS_LOG_DIR": str(home / "log"),
        "ROSCONSOLE_FORMAT": "[${severity}] [${node}] ${message}",
    }


class Ros(Closing):
    """A ROS user's shell on one host; what it started ends with it.

    Args:
        host: Where; default: the real machine, where a port should be given.
        home: Existing directory for logs and ROS's own files.
        port: The port of the master that its programs talk to; any program may run it.
    """

    # Where its nodes are, and what they share (``*.hpp``, modules) beside what those of ``NODES`` do.
    nodes: ClassVar[Path] = NODES

    def __init__(self, host: Host = MACHINE, home: Path | None = None, port: int = 11311) -> None:
        self.host = host
        self.port = port
        self.home = (home or Path(tempfile.gettempdir())) / f"ros-{host.name}-{next(_numbers)}"
        (self.home / "log").mkdir(parents=True)
        self.env = environment(self.home, port)
        self._started: list[Process] = []

    @property
    def uri(self) -> str:
        """The master's URI."""
        return self.env["ROS_MASTER_URI"]

    @property
    def processes(self) -> list[Process]:
        """What was started here."""
        return list(self._started)

    def close(self, *, orderly: bool = True) -> None:
        """End what was started here, all at once.

        Args:
            orderly: Nodes tell their master so. Otherwise they are killed: it ends as well, or does not listen.
        """
        for process in self._started:
            kill = not orderly and not process.name.startswith(_PARENTS)
            process.thaw()
            process.send(signal.SIGKILL if kill else signal.SIGTERM)
        while self._started:
            self._started.pop().end()

    def start(
        self, *argv: str | Path, name: str = "", env: Mapping[str, str] | None = None, commands: bool = False
    ) -> Process:
        """Start any program in this shell; arguments as of ``Process``."""
        where = f"{name or Path(argv[0]).name}@{self.host.name}"
        process = Process(self.host.command(argv), env={**self.env, **(env or {})}, name=where, commands=commands)
        self._started.append(process)
        return process

    def tool(self, *argv: str, timeout: float = DEADLINE) -> str:
        """Run a stock tool (``rostopic list``) to its end; return its output; a failure raises."""
        return run(self.host.command(argv), env=self.env, timeout=timeout)

    def master(self) -> Process:
        """Start the real rosmaster alone; return when it answers."""
        process = self.start("rosmaster", "--core", "-p", str(self.port))
        self._wait_master()
        return process

    def roscore(self) -> Process:
        """Start the real roscore (master, rosout, /run_id); return when it answers."""
        process = self.start("roscore", "-p", str(self.port))
        process.wait_for("started core service", 60.0)  # it sets /run_id before that
        self._wait_master()
        return process

    def rospy(
        self, program: str, *remaps: str, nodes: Path | None = None, commands: bool = False, **options: object
    ) -> Process:
        """Start ``nodes/PROGRAM.py``; ``remaps`` are ROS arguments such as ``__name:=x``."""
        env = {"PYTHONPATH": os.pathsep.join(str(folder) for folder in dict.fromkeys((self.nodes, NODES)))}
        argv: list[str | Path] = [PYTHON, (nodes or self.nodes) / f"{program}.py", *words(options), *remaps]
        return self.start(*argv, name=f"{program}.py", env=env, commands=commands)

    def roscpp(
        self, program: str, *remaps: str, nodes: Path | None = None, commands: bool = False, **options: object
    ) -> Process:
        """Compile ``nodes/PROGRAM.cpp`` if that was not done yet, and start it."""
        return self.start(
            compiled(program, nodes or self.nodes, self.nodes),
            *words(options),
            *remaps,
            name=program,
            commands=commands,
        )

    def node(self, kind: str, program: str, *remaps: str, **options: object) -> Process:
        """Start a node by its client library, ``"rospy"`` or ``"roscpp"``."""
        start = self.rospy if kind == "rospy" else self.roscpp
        return start(program, *remaps, **options)  # type: ignore[arg-type]  # options are of the node, not of start

    def graph_topics(self) -> set[str]:
        """The topics with a publisher or a subscriber, as the master says by its API: no process is started."""
        with MasterProxy(self.host, self.port) as master:
            reply: Any = master.getSystemState("/test")
        code, status, state = reply
        if code != 1:
            raise BedError(f"{self.uri}: getSystemState: {status}")
        publishers, subscribers, _services = state
        return {str(name) for name, _nodes in [*publishers, *subscribers]}

    def _wait_master(self) -> None:
        probe = (
            "import socket, sys, time\n"
            "for _ in range(600):\n"
            "    try: socket.create_connection(('127.0.0.1', int(sys.argv[1])), 1).close(); sys.exit(0)\n"
            "    except OSError: time.sleep(0.05)\n"
            "sys.exit('no master answers')\n"
        )
        self.tool(PYTHON, "-c", probe, str(self.port), timeout=35.0)


class _HostConnection(http.client.HTTPConnection):
    """A connection from within a host's network."""

    def __init__(self, host: Host, target: str) -> None:
        super().__init__(target, timeout=DEADLINE)
        self._from = host

    def connect(self) -> None:
        self.sock = self._from.open_socket()
        self.sock.settimeout(self.timeout)
        try:
            self.sock.connect((self.host, self.port))
        except OSError:
            self.close()
            raise


class _HostTransport(xmlrpc.client.Transport):
    def __init__(self, host: Host) -> None:
        super().__init__()
        self._host = host
        self._made: _HostConnection | None = None

    def make_connection(self, host: object) -> http.client.HTTPConnection:
        if self._made is None:
            self._made = _HostConnection(self._host, str(host))
            self._connection = str(host), self._made  # what ``close`` closes
        return self._made


class MasterProxy(xmlrpc.client.ServerProxy):
    """The API of the master on one host's loopback, called from this process.

    Args:
        host: The host.
        port: The master's port.
    """

    def __init__(self, host: Host, port: int) -> None:
        super().__init__(f"http://127.0.0.1:{port}/", transport=_HostTransport(host))


@functools.cache
def compiled(program: str, nodes: Path = NODES, headers: Path = NODES) -> Path:
    """The binary of ``PROGRAM.cpp`` in the folder ``nodes``; compiled once for each version of the sources.

    It is kept where the XDG Base Directory Specification has a user's caches: ``~/.cache/rmpa/nodes``.
    """
    source = nodes / f"{program}.cpp"
    text = source.read_text()
    folders = list(dict.fromkeys((headers, NODES)))
    if "<rmpa_ros/" in text:
        folders.append(CLIENT_HEADERS)
    flags = ["-std=c++17", "-O2", "-Wall", "-Wextra"]
    packages = ["actionlib", "roscpp"] if "<actionlib/" in text else ["roscpp"]
    libraries = subprocess.run(
        ["pkg-config", "--cflags", "--libs", *packages], capture_output=True, text=True, check=True
    ).stdout.split()
    digest = hashlib.sha256(" ".join([*flags, *libraries]).encode())
    for part in [source, *(header for folder in folders for header in sorted(folder.rglob("*.h*")))]:
        digest.update(part.read_bytes())
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rmpa" / "nodes"
    binary = cache / f"{program}-{digest.hexdigest()[:12]}"
    if not binary.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with (cache / f"{program}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # parts of the test run start at one time, and want the same programs
            if not binary.exists():
                unfinished = binary.with_suffix(f".{os.getpid()}")
                includes = [f"-I{folder}" for folder in folders]
                run(["g++", *flags, *includes, source, "-o", unfinished, *libraries], timeout=180.0)
                unfinished.replace(binary)
    return binary


def words(options: Mapping[str, object]) -> list[str]:
    """Options as nodes take them: ``--word value``, a bare ``--word`` for true, nothing for false and ``None``."""
    made: list[str] = []
    for key, value in options.items():
        if value is not False and value is not None:
            made += [f"--{key.replace('_', '-')}"] if value is True else [f"--{key.replace('_', '-')}", str(value)]
    return made


def _clean_environment() -> dict[str, str]:
    kept = {key: os.environ[key] for key in ("LANG", "LC_ALL", "TMPDIR", "TERM") if key in os.environ}
    return {**kept, "PATH": _SYSTEM_PATH, "PYTHONUNBUFFERED": "1", "PYTHONDONTWRITEBYTECODE": "1"}
