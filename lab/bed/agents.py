"""``rmpa up`` as a user or systemd starts it, on any host of a lab or on the real machine."""

from __future__ import annotations

import atexit
import contextlib
import itertools
import json
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lab.bed.processes import DEADLINE, BedError, Closing, CommandFailed, Deadline, Process, eventually
from lab.bed.ros import free_port
from rmpa.observe.control_client import ControlClient, choose_agent

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.bed.namespaces import Host
    from rmpa.observe.snapshot import Snapshot

RMPA: Final = Path(sys.executable).with_name("rmpa")
# In PYTHONPATH: the password database names the home directory of the program's host, as one of a machine of its own.
USER: Final = str(Path(__file__).with_name("user"))
_numbers = itertools.count(1)


class NotifySocket:
    """What systemd holds out to a service as NOTIFY_SOCKET (sd_notify(3)): datagrams of ``KEY=value`` lines."""

    def __init__(self) -> None:
        self._dir = tempfile.TemporaryDirectory(prefix="rmpa-notify-")  # short: such a path has at most 107 bytes
        self.path = Path(self._dir.name) / "notify"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))
        self.seen: list[str] = []

    def wait_for(self, line: str, process: Process, timeout: float = DEADLINE) -> float:
        """Wait until the service sent ``line``; return the monotonic time at which it was read."""
        deadline = time.monotonic() + timeout
        while line not in self.seen:
            rest = deadline - time.monotonic()
            if rest <= 0 or process.returncode is not None:
                state = f"ended with {process.returncode}" if process.returncode is not None else "said nothing"
                raise Deadline(f"{process.name} {state} before it notified {line}\n{process.output[-6000:]}")
            self._socket.settimeout(min(rest, 0.1))
            with contextlib.suppress(TimeoutError):
                self.seen += self._socket.recv(4096).decode().splitlines()
        return time.monotonic()

    def close(self) -> None:
        """Remove it."""
        self._socket.close()
        self._dir.cleanup()


@dataclass
class Agent(Closing):
    """One ``rmpa up`` and the commands against it.

    Args:
        host: Where it runs.
        home: Existing directory; its runtime directory and configuration go below it.
        name: Its peer name; default: the host's name with a number.
        core_port: The port of its ROS core; default: 11311 in a namespace, else a free one.
        multicast: ``GROUP:PORT``; default: in a namespace the built-in one, else one of this process's own, so that
            agents of parallel test runs on one machine do not meet.
        flags: Further arguments of ``rmpa up``.
        config: Text of its ``rmpa.toml``; empty for none.
        runtime_dir: Directory of control sockets; default: one for each ``home``, as of one user.
        log_level: As of ``--log-level``.
        prefix: Words before the command of ``rmpa up``, such as ``setpriv`` with its options.
    """

    host: Host
    home: Path
    name: str = ""
    core_port: int = 0
    multicast: str = ""
    flags: Sequence[str] = ()
    config: str = ""
    runtime_dir: Path | None = None
    log_level: str = "debug"
    prefix: Sequence[str] = ()
    process: Process = field(init=False)
    # Seconds from exec to READY=1.
    ready_after: float = field(init=False, default=0.0)
    _notify: NotifySocket | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.name = self.name or f"{self.host.name}{next(_numbers)}"
        self.core_port = self.core_port or (11311 if self.host.namespace else free_port())
        if not self.multicast and not self.host.namespace:
            self.multicast = f"239.255.82.77:{20000 + os.getpid() % 20000}"
        if self.runtime_dir is None:
            # Hosts of a lab share the file system but are different machines: each has a directory of its own.
            self.runtime_dir = _short_dir(self.home, self.host)

    @property
    def env(self) -> dict[str, str]:
        """The environment of the agent and of ``rmpa`` commands against it."""
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "RMPA_", "PYTHON"))}
        places = {
            "RMPA_RUNTIME_DIR": str(self.runtime_dir),
            "RMPA_STATE_DIR": str(self.home / "state" / self.host.name),
            "XDG_STATE_HOME": str(self.home / "state" / self.host.name),  # each host is a machine of its own
        }
        return {**kept, **places, "PYTHONUNBUFFERED": "1", "PYTHONPATH": USER}

    @property
    def command(self) -> list[str]:
        """The command of rmpa that it runs, with the options that this command alone has."""
        return ["up", "--core-port", str(self.core_port)]

    @property
    def argv(self) -> list[str]:
        """The command line on its host."""
        words = [str(RMPA), *self.command, "--name", self.name, "--log-level", self.log_level]
        if self.multicast:
            words += ["--multicast", self.multicast]
        if not self.host.namespace:
            words += ["--interface", "lo"]  # tests keep to this machine
        if self.config:
            path = self.home / f"{self.name}.toml"
            path.write_text(self.config, encoding="utf-8")
            words += ["--config", str(path)]
        return self.host.command([*self.prefix, *words, *self.flags])

    @property
    def pid(self) -> int:
        """Its process id."""
        return self.process.pid

    def start(self) -> None:
        """Execute it; see ``wait_ready``."""
        self._close_notify()
        self._notify = NotifySocket()
        env = {**self.env, "NOTIFY_SOCKET": str(self._notify.path)}
        self.process = Process(self.argv, env=env, name=f"rmpa up {self.name}", log=self.home / f"{self.name}.log")

    def wait_ready(self, timeout: float = DEADLINE) -> None:
        """Wait until it notifies READY=1."""
        if self._notify is None:
            raise BedError(f"{self.name}: start() comes first")
        self.ready_after = self._notify.wait_for("READY=1", self.process, timeout) - self.process.started

    def restart(self) -> None:
        """Start it again, after ``kill`` or ``terminate``, and wait until it is ready."""
        self.process.end()
        self.start()
        self.wait_ready()

    def kill(self) -> None:
        """``kill -9``."""
        self.process.kill()

    def terminate(self, timeout: float = DEADLINE) -> int:
        """SIGTERM; return the exit status."""
        return self.process.terminate(timeout)

    def freeze(self) -> None:
        """SIGSTOP."""
        self.process.send(signal.SIGSTOP)

    def thaw(self) -> None:
        """SIGCONT."""
        self.process.send(signal.SIGCONT)

    def close(self) -> None:
        """Make sure that it is gone."""
        if hasattr(self, "process"):
            self.process.end()
        self._close_notify()

    def rmpa(self, *words: str, timeout: float = DEADLINE) -> tuple[int, str]:
        """Run another ``rmpa`` command on its host; return exit status and output."""
        env = {**self.env, "RMPA_AGENT": self.name}  # several may share the runtime directory
        with Process(self.host.command([RMPA, *words]), env=env) as process:
            return process.wait(timeout), process.output

    def snapshot(self) -> Snapshot:
        """What it says of itself.

        Raises:
            UnreachableError: It does not answer.
        """
        with ControlClient(choose_agent(self.env, self.name).path) as client:
            return client.snapshot()

    def peers(self) -> dict[str, dict[str, object]]:
        """What ``rmpa peer list --json`` says, by peer name."""
        code, output = self.rmpa("peer", "list", "--json")
        if code:
            raise CommandFailed(f"rmpa peer list: {output}\n{self.process.output[-4000:]}")
        answer = json.loads(output)
        rows = answer["peers"] if isinstance(answer, dict) else answer
        return {str(row["name"]): row for row in rows}

    def linked(self) -> set[str]:
        """The names of the peers that it has a live link to, as it says by its control socket: no process is started.

        Raises:
            UnreachableError: It does not answer.
        """
        return {peer.name for peer in self.snapshot().peers if peer.state == "linked"}

    def wait_peer(self, name: str, timeout: float = DEADLINE) -> None:
        """Wait until it has a live link to the peer of this name."""
        eventually(lambda: name in self.linked(), timeout, what=f"{self.name} linked with {name}")

    def wait_no_peer(self, name: str, timeout: float = DEADLINE) -> None:
        """Wait until it has no live link to the peer of this name."""
        eventually(lambda: name not in self.linked(), timeout, what=f"{self.name} without {name}")

    def sockets(self) -> list[Path]:
        """The sockets that it left, or has, in its runtime directory."""
        return sorted(path for path in self.runtime_dir.rglob("*") if path.is_socket()) if self.runtime_dir else []

    def _close_notify(self) -> None:
        if self._notify:
            self._notify.close()
            self._notify = None


def last_link(snapshot: Snapshot | None, names: set[str], now: float) -> float | None:
    """When the last of an agent's links came up, or ``None`` if one is missing. ``now`` is when it said so."""
    if snapshot is None:
        return None
    ups = {info.name: info.link.up_ago for info in snapshot.peers if info.link is not None and info.name in names}
    return now - min(ups.values()) if ups.keys() == names else None


def _short_dir(home: Path, host: Host) -> Path:
    """The runtime directory of a host in one test; a Unix socket's path must be short."""
    ours = Path(tempfile.gettempdir()) / f"rmpa-test-{os.getpid()}"
    if not ours.exists():
        ours.mkdir(mode=0o700)
        atexit.register(shutil.rmtree, ours, ignore_errors=True)
    path = ours / f"{abs(hash(str(home))) % 10**8:08d}-{host.name}"
    path.mkdir(exist_ok=True, mode=0o700)
    return path
