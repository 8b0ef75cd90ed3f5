"""The protocol of the control socket, its client, and the search for this machine's agents.

One JSON object a line each way.

::

    {"op": "ping", "args": {"peer": "base", "count": 1}}
    {"ok": true, "value": {"times": [0.0004], "remote": "10.0.0.2:40001"}}
    {"ok": false, "error": "no peer named 'bse'", "remedy": "did you mean base?", "code": "unknown-name"}

A long ``text`` in the arguments or the value is not part of the JSON, whose reading would delay data: ``follows`` has
the number of its bytes, and they follow the line.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import grp
import os
import socket
import stat
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, Literal, Self, TypeVar
from urllib.parse import urlsplit

import msgspec

from rmpa.bridge.messages import with_text, without_text
from rmpa.config.module_name import NameSource, running_agent
from rmpa.core.errors import (
    ConfigError,
    LimitExceeded,
    LocalProtocolError,
    PeerRefused,
    RemoteProtocolError,
    RmpaError,
    UnreachableError,
)
from rmpa.core.limits import KIB
from rmpa.observe import limits
from rmpa.observe.snapshot import AgentInfo, Snapshot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from types import TracebackType

    from rmpa.core.timers import Yielder


class ReloadReply(msgspec.Struct, kw_only=True, frozen=True):
    """The settings as read again, against those that the agent runs with.

    Attributes:
        file: The file that was read, or empty if there is none.
        changed: The keys whose new values hold from now on (or would, for a check): ``bridge.deny``, ``[[peer]]``.
        restart: Those that hold after a restart only, each with both values: ``mesh.port (40001 instead of 0)``.
        notes: Doubtful settings, each ready to read.
        problem: Why the settings cannot be used, with the file's line, and nothing has changed; empty if they can.
        code: The problem's code (``core.codes``).
    """

    file: str = ""
    changed: tuple[str, ...] = ()
    restart: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    problem: str = ""
    code: str = ""


# Elements of a list in one piece: some 50 microseconds where they are topics.
_BATCH: Final = 16


def json_pieces(value: object) -> Iterator[bytes]:
    """The output of ``msgspec.json.encode`` in pieces: long lists, also those in fields of structs, are cut.

    Args:
        value: Must not change meanwhile.

    Raises:
        TypeError, ValueError, RecursionError: JSON cannot hold it.
    """
    if isinstance(value, list | tuple) and len(value) > _BATCH:
        yield from _list(value)
    elif isinstance(value, msgspec.Struct) and not type(value).__struct_config__.tag:
        yield from _struct(value)
    else:
        yield msgspec.json.encode(value)


def _list(values: Sequence[object]) -> Iterator[bytes]:
    for begin in range(0, len(values), _BATCH):
        yield b"[" if begin == 0 else b","
        yield msgspec.json.encode(values[begin : begin + _BATCH])[1:-1]
    yield b"]"


def _struct(value: msgspec.Struct) -> Iterator[bytes]:
    separator = b"{"
    for name, start, default in _members(type(value)):
        content = getattr(value, name)
        if default is not msgspec.NODEFAULT and content == default:
            continue
        yield separator + start
        yield from json_pieces(content)
        separator = b","
    yield b"{}" if separator == b"{" else b"}"


@functools.cache  # to read the annotations of a type takes as long as to write a small struct
def _members(kind: type[msgspec.Struct]) -> tuple[tuple[str, bytes, object], ...]:
    """Of each field its name, its JSON up to the value, and the value that is left out, ``NODEFAULT`` for none."""
    omit = kind.__struct_config__.omit_defaults
    return tuple(
        (each.name, msgspec.json.encode(each.encode_name) + b":", _default(each) if omit else msgspec.NODEFAULT)
        for each in msgspec.structs.fields(kind)
    )


def _default(field: msgspec.structs.FieldInfo) -> object:
    return field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()


# The operation that only an agent with another role than a module's serves; its value names that.
ROLE: Final = "role"
# The role of the agent in ``rmpa gateway``.
GATEWAY_ROLE: Final = "gateway"
# The operation of a gateway that says what it joins; its ``problem`` is why it joins nothing.
GATEWAY_REPORT: Final = "gateway"


class _Line(msgspec.Struct, frozen=True, omit_defaults=True):
    """A line of the protocol."""

    _NAME: ClassVar[str]
    _MOST: ClassVar[int]

    @classmethod
    def parse(cls, line: bytes) -> Self:
        """Parse one line, with or without its end.

        Raises:
            RemoteProtocolError: It is none.
        """
        if len(line) > cls._MOST:
            raise LimitExceeded(f"a {cls._NAME}", len(line), cls._MOST)
        try:
            return msgspec.json.decode(line, type=cls)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
            raise RemoteProtocolError(f"not a {cls._NAME}: {error}") from None


class ControlRequest(_Line, frozen=True, omit_defaults=True):
    """A client's request.

    Attributes:
        op: The name of an operation (``observe.operations``).
        args: Its arguments, by name.
        follows: Bytes of the argument ``text`` that follow the line.
    """

    _NAME = "control request"
    _MOST = limits.CONTROL_REQUEST_MAX
    op: str
    args: dict[str, object] = {}
    follows: int = 0

    def serialize(self) -> bytes:
        """One line."""
        args, text = without_text(self.args)
        return msgspec.json.encode(msgspec.structs.replace(self, args=args, follows=len(text))) + b"\n" + text

    def __str__(self) -> str:
        """The op and the names of its arguments, safe to log."""
        shown = f"{self.op}({', '.join(self.args)})"
        return shown[:200].encode("unicode_escape").decode("ascii")


class ControlReply(_Line, frozen=True, omit_defaults=True):
    """The agent's reply.

    Attributes:
        ok: Whether ``value`` is the result; else ``error`` says why there is none and ``remedy`` what to do.
        value: Anything that JSON can hold.
        error: What happened.
        remedy: What to do; may be empty.
        follows: Bytes of the value's ``text`` that follow the line.
        code: The error's code (``core.codes``).
    """

    _NAME = "control reply"
    _MOST = limits.CONTROL_REPLY_MAX
    ok: bool
    value: Any = None  # the edge: each operation has its own type, and its caller converts the value
    error: str = ""
    remedy: str = ""
    follows: int = 0
    code: str = ""

    def serialize(self, yielder: Yielder = iter) -> bytes:
        """One line.

        Args:
            yielder: Yields to data between the pieces of a large reply, which take some 50 microseconds each.

        Raises:
            LocalProtocolError: The value is something that JSON cannot hold, or too large.
        """
        try:
            value, text = without_text(self.value)
            reply = msgspec.structs.replace(self, value=value, follows=len(text))
            line = b"".join((*yielder(json_pieces(reply)), b"\n", text))
        except (TypeError, ValueError, RecursionError) as error:
            raise LocalProtocolError(f"a handler's value is not JSON: {error}") from None
        if len(line) > limits.CONTROL_REPLY_MAX:
            raise LocalProtocolError(f"a reply of {len(line)} bytes is more than {limits.CONTROL_REPLY_MAX}")
        return line


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
