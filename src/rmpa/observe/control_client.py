"""The client of the control socket, the search for this machine's agents, and the lock of an agent's name."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import grp
import os
import socket
import stat
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Generic, Literal, Self, TypeVar
from urllib.parse import urlsplit

import msgspec

from rmpa.bridge.messages import with_text
from rmpa.config.module_name import NameSource, running_agent
from rmpa.core.errors import ConfigError, PeerRefused, RemoteProtocolError, RmpaError, StartError, UnreachableError
from rmpa.core.limits import KIB
from rmpa.observe import limits
from rmpa.observe.control import GATEWAY_ROLE, ROLE, ControlReply, ControlRequest
from rmpa.observe.snapshot import Snapshot

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from types import TracebackType

    from rmpa.observe.snapshot import AgentInfo


_SYSTEM: Final = Path("/run/rmpa")


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
    if os.geteuid() == 0 and os.access(_SYSTEM.parent, os.W_OK) and not _is_a_units():
        return _SYSTEM
    return Path(f"/tmp/rmpa-{os.geteuid()}")  # noqa: S108 - made with mode 0700, its owner checked


def _is_a_units() -> bool:
    """Whether the system's directory belongs to the user of a unit, which runs an agent then."""
    try:
        return _SYSTEM.stat().st_uid != 0
    except OSError:
        return False


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


def closed_to_us() -> str:
    """The group of the directory of a unit's agent, where this user may not read that; else empty."""
    try:
        info = _SYSTEM.stat()
        if os.access(_SYSTEM, os.R_OK | os.X_OK) or not info.st_mode & stat.S_IXGRP:
            return ""
        return grp.getgrgid(info.st_gid).gr_name
    except (OSError, KeyError):
        return ""


def _unusable(path: Path, problem: str) -> StartError:
    return StartError(
        str(path), problem, "set RMPA_RUNTIME_DIR to a directory of your own", code="directory-unusable"
    )


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
            raise _unusable(place, "is not a directory")
        if info.st_uid != os.geteuid():
            raise _unusable(place, f"belongs to user {info.st_uid}, not to us")
        if info.st_mode & stat.S_ISVTX:  # such as /tmp, which would be closed to all others
            raise _unusable(place, "is shared by all users")
        if group is not None:
            os.chown(place, -1, group)
            place.chmod(0o750)
        elif info.st_mode & 0o077:
            place.chmod(0o700)
    except OSError as error:
        raise _unusable(place, f"cannot be made: {error.strerror}") from None


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
                raise _unusable(self.path, f"cannot be opened: {error.strerror}") from None
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                pid = os.read(fd, 32).decode("ascii", "replace").strip()
                os.close(fd)
                whose = f" (pid {pid})" if pid else ""
                problem = f"an agent named {name!r} already runs on this machine{whose}"
                remedy = "stop it, or give this one a --name of its own"
                raise StartError("rmpa up", problem, remedy, code="name-in-use") from None
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


_T = TypeVar("_T")
START_ONE = "start one with `rmpa up`"


class _Result(msgspec.Struct, Generic[_T], frozen=True):
    """A ``ControlReply`` that is no refusal."""

    ok: Literal[True]
    value: _T
    follows: int = 0


class ControlClient:
    """One connection to an agent; a context manager; one call at a time.

    Args:
        path: Its socket.
        timeout: Seconds for each call.

    Raises:
        UnreachableError: No agent accepts the connection.
    """

    def __init__(self, path: Path, timeout: float = limits.CONTROL_CALL_TIMEOUT) -> None:
        self.path = path
        try:
            self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        except OSError as error:
            remedy = "close some programs, or raise the limit (ulimit -n)"
            raise UnreachableError("agent", f"{path}: {error.strerror}", remedy) from None
        self._sock.settimeout(timeout)
        try:
            self._sock.connect(str(path))
        except OSError:
            self._sock.close()
            raise UnreachableError("agent", str(path), START_ONE) from None
        self._file = self._sock.makefile("rb", 256 * KIB)

    @property
    def name(self) -> str:
        """The agent's name."""
        return self.path.stem

    @property
    def pid(self) -> int:
        """The process that listens at the socket."""
        # ``struct ucred`` begins with it.
        return int.from_bytes(self._sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)[:4], sys.byteorder)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._file.close()
        self._sock.close()

    def call(self, op: str, type: type[_T], **args: object) -> _T:  # noqa: A002 - as msgspec calls it
        """Send a request, and wait for the reply.

        Args:
            op: The name of the operation (``observe.operations``).
            type: The type of its value.
            args: Its arguments.

        Raises:
            PeerRefused: The agent refused, and said why.
            UnreachableError: It closed the connection, or did not reply in time.
            RemoteProtocolError: Its value has another type.
        """

        def exchange() -> bytes:
            self._sock.sendall(ControlRequest(op, args).serialize())
            return self._file.readline(limits.CONTROL_REPLY_MAX + 1)

        reply = self._read(op, self._received(exchange), type)
        if reply.follows:
            with_text(reply.value, self._received(lambda: self._file.read(reply.follows)))
        return reply.value

    def pass_on(self, op: str, type: type[_T], **args: object) -> _T:  # noqa: A002 - as msgspec calls it
        """As ``call``, of a question that this agent passes on to another one.

        Raises:
            RmpaError: That one refuses; the text is its own, and has its name.
        """
        try:
            return self.call(op, type, **args)
        except PeerRefused as error:
            text = f"{error.reason}; {error.remedy}" if error.remedy else error.reason
            raise RmpaError(text, code=error.code) from None

    async def ask(self, op: str, type: type[_T], **args: object) -> _T:  # noqa: A002 - as msgspec calls it
        """As ``call``, in a thread; if it is cancelled, the connection ends."""
        try:
            return await asyncio.to_thread(lambda: self.call(op, type, **args))
        except asyncio.CancelledError:
            with contextlib.suppress(OSError):  # it has ended already
                self._sock.shutdown(socket.SHUT_RDWR)
            raise

    def snapshot(self, **args: object) -> Snapshot:
        """Everything that the agent shows; ``args`` are those of the operation. Raises as ``call``."""
        return self.call("snapshot", Snapshot, **args)

    def agent(self) -> AgentInfo:
        """What the agent tells of itself, without its peers, topics and services; raises as ``call``."""
        return self.snapshot(topics=(), peers=False).agent

    def _read(self, op: str, line: bytes, type: type[_T]) -> _Result[_T]:  # noqa: A002 - as msgspec calls it
        agent = f"agent {self.name}"
        if len(line) > limits.CONTROL_REPLY_MAX:
            raise RemoteProtocolError(f"{agent} sends more than {limits.CONTROL_REPLY_MAX} bytes")
        if not line.endswith(b"\n"):
            raise UnreachableError("agent", f"{self.path}: it closed the connection", "its log says why")
        try:
            reply: _Result[_T] = msgspec.json.decode(line, type=_Result[type])  # type: ignore[valid-type]
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
            refused = ControlReply.parse(line)
            if not refused.ok:
                raise PeerRefused(agent, refused.error, refused.remedy, code=refused.code or "refused") from None
            raise RemoteProtocolError(f"{agent} answers {op} in another way: {error}; is it older?") from None
        return reply

    def _received(self, receive: Callable[[], bytes]) -> bytes:
        try:
            return receive()
        except TimeoutError:
            raise UnreachableError("agent", f"{self.path} in time", "is it stopped? see its log") from None
        except OSError as error:
            raise UnreachableError("agent", f"{self.path} ({error.strerror})", START_ONE) from None


@dataclass(frozen=True, slots=True)
class FoundAgent:
    """An agent that runs on this machine, and the id of its process."""

    name: str
    path: Path
    pid: int = 0


def find_agents(environ: Mapping[str, str]) -> list[FoundAgent]:
    """The agents of this machine that accept a connection, by name; sockets of killed agents are left out."""
    found = []
    for place in runtime_dirs(environ):
        for path in sorted(place.glob("*.sock")):
            with contextlib.suppress(UnreachableError), ControlClient(path, limits.CONTROL_LOOK_TIMEOUT) as client:
                found.append(FoundAgent(path.stem, path, client.pid))
    return sorted(found, key=lambda agent: agent.name)


def choose_agent(environ: Mapping[str, str], name: str | None = None) -> FoundAgent:
    """The agent of that name or process id; else of RMPA_AGENT, else as ``config.module_name.running_agent`` chooses.

    Raises:
        UnreachableError: No agent runs, or none of that name.
        RmpaError: Several agents run, and none is selected; the text lists them.
    """
    agents = find_agents(environ)
    wanted = name or environ.get("RMPA_AGENT")
    listed = ", ".join(agent.name for agent in agents)
    if not agents and (owner := closed_to_us()):
        remedy = f"use sudo; or once: sudo usermod -aG {owner} $USER, and log in again"
        raise UnreachableError("agent", f"{_SYSTEM}, which users of the group {owner} may read", remedy)
    if not wanted and not agents:
        places = ", ".join(map(str, runtime_dirs(environ) or [runtime_dir(environ)]))
        raise UnreachableError("agent", places, START_ONE)
    if not wanted:
        names: Mapping[NameSource, str] = {}
        if len(agents) > 1:
            from rmpa.config.read import load_settings  # noqa: PLC0415 - most commands need no settings

            with contextlib.suppress(ConfigError):  # a broken rmpa.toml is no reason not to ask
                names = load_settings({}, environ, host_name=socket.gethostname()).names
        wanted = running_agent(names, *running_agents(agents, environ))
    for agent in agents:
        if wanted in (agent.name, str(agent.pid)):
            return agent
    path = runtime_dir(environ) / f"{wanted}.sock"
    remedy = f"running here: {listed}" if agents else f"start it with `rmpa up --name {wanted}`"
    raise UnreachableError(f"agent {wanted!r}", str(path), remedy)


def running_agents(
    agents: Sequence[FoundAgent], environ: Mapping[str, str]
) -> tuple[Sequence[str], Sequence[str], str]:
    """The agents that run, those that are gateways, and that of ROS_MASTER_URI, for ``config.module_name``.

    Several are asked which of them they are.
    """
    gateways: tuple[str, ...] = ()
    of_master = ""
    if len(agents) > 1:
        gateways = tuple(agent.name for agent in agents if _is_gateway(agent))
        of_master = _of_master(agents, environ.get("ROS_MASTER_URI", ""))
    return tuple(agent.name for agent in agents), gateways, of_master


def _of_master(agents: Sequence[FoundAgent], uri: str) -> str:
    """The agent whose core a URI names; empty: none."""
    for agent in agents if uri else ():
        with contextlib.suppress(RmpaError), ControlClient(agent.path) as client:
            if same_core(client.agent().core_uri, uri):
                return agent.name
    return ""


def _is_gateway(agent: FoundAgent) -> bool:
    """Whether it is the agent of ``rmpa gateway``; others refuse the question."""
    with contextlib.suppress(RmpaError), ControlClient(agent.path, timeout=limits.CONTROL_LOOK_TIMEOUT) as client:
        return client.call(ROLE, str) == GATEWAY_ROLE
    return False


def same_core(one: str, other: str) -> bool:
    """Whether two URIs name the same ROS core: equal ports, and equal hosts or two names of this machine."""
    try:
        first, second = urlsplit(one), urlsplit(other)
        hosts = {_local(u.hostname or "") for u in (first, second)}
        return first.port is not None and first.port == second.port and len(hosts) == 1
    except ValueError:
        return False


def _local(host: str) -> str:
    return "localhost" if host.startswith("127.") or host == socket.gethostname().lower() else host
