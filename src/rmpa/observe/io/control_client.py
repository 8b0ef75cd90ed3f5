"""The blocking client of the control socket, and the search for this machine's agents; for the command line."""

from __future__ import annotations

import contextlib
import socket
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self, TypeVar
from urllib.parse import urlsplit

import msgspec

from rmpa.bridge.messages import with_text
from rmpa.config.module_name import NameFacts, running_agent
from rmpa.core.errors import ConfigError, PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.limits import KIB
from rmpa.observe import limits
from rmpa.observe.control import GATEWAY_ROLE, ROLE, ControlReply, ControlRequest
from rmpa.observe.io.runtime_dir import runtime_dir, runtime_dirs
from rmpa.observe.snapshot import Snapshot

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path
    from types import TracebackType

    from rmpa.observe.snapshot import AgentInfo
    from rmpa.observe.snapshot_decoder import SnapshotDecoder

_T = TypeVar("_T")
_START_ONE = "start one with `rmpa up`"


class ControlClient:
    """One connection to an agent; a context manager.

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
            raise UnreachableError("agent", str(path), _START_ONE) from None
        self._file = self._sock.makefile("rb", 256 * KIB)

    @property
    def name(self) -> str:
        """The agent's name."""
        return self.path.stem

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
            op: The name of the operation (``control_operations.REPLIES``).
            type: The type of its value.
            args: Its arguments.

        Raises:
            PeerRefused: The agent refused, and said why.
            UnreachableError: It closed the connection, or did not reply in time.
            RemoteProtocolError: Its value has another type.
        """
        return self._parse(op, self._exchange(op, args), type)

    def snapshot(self, decoder: SnapshotDecoder | None = None, **args: object) -> Snapshot:
        """Everything that the agent shows; raises as ``call``.

        Args:
            decoder: For those that ask again and again.
            args: Of the operation.
        """
        if decoder is None:
            return self.call("snapshot", Snapshot, **args)
        line = self._exchange("snapshot", args)
        with contextlib.suppress(RemoteProtocolError):
            return decoder.decode(line)
        return self._parse("snapshot", line, Snapshot)

    def agent(self) -> AgentInfo:
        """What the agent tells of itself, without its peers, topics and services; raises as ``call``."""
        return self.snapshot(topics=(), peers=False).agent

    def _exchange(self, op: str, args: dict[str, object]) -> bytes:
        def exchange() -> bytes:
            self._sock.sendall(ControlRequest(op, args).serialize())
            return self._file.readline(limits.CONTROL_REPLY_MAX + 1)

        line = self._received(exchange)
        if line.endswith(b"\n"):
            return line[:-1]
        if len(line) > limits.CONTROL_REPLY_MAX:
            raise RemoteProtocolError(f"agent {self.name} sends more than {limits.CONTROL_REPLY_MAX} bytes")
        raise UnreachableError("agent", f"{self.path}: it hung up", "its log says why")

    def _received(self, receive: Callable[[], bytes]) -> bytes:
        try:
            return receive()
        except TimeoutError:
            raise UnreachableError("agent", f"{self.path} in time", "is it stopped? its log may tell") from None
        except OSError as error:
            raise UnreachableError("agent", f"{self.path} ({error.strerror})", _START_ONE) from None

    def _parse(self, op: str, line: bytes, type: type[_T]) -> _T:  # noqa: A002 - as msgspec calls it
        reply = ControlReply.parse(line)
        if not reply.ok:
            raise PeerRefused(f"agent {self.name}", reply.error, reply.remedy)
        if reply.follows:
            with_text(reply.value, self._received(lambda: self._file.read(reply.follows)))
        try:
            return msgspec.convert(reply.value, type)
        except msgspec.ValidationError as error:
            raise RemoteProtocolError(
                f"agent {self.name} answers {op} in another way: {error}; is it older?"
            ) from None


@dataclass(frozen=True, slots=True)
class FoundAgent:
    """An agent that runs on this machine."""

    name: str
    path: Path


def find_agents(environ: Mapping[str, str]) -> list[FoundAgent]:
    """The agents of this machine that accept a connection, by name; sockets of killed agents are left out."""
    found = []
    for place in runtime_dirs(environ):
        for path in sorted(place.glob("*.sock")):
            with contextlib.suppress(UnreachableError), ControlClient(path, timeout=limits.CONTROL_LOOK_TIMEOUT):
                found.append(FoundAgent(path.stem, path))
    return sorted(found, key=lambda agent: agent.name)


def choose_agent(environ: Mapping[str, str], name: str | None = None) -> FoundAgent:
    """The named agent; else that of RMPA_AGENT, else the one that ``config.module_name.running_agent`` chooses.

    Raises:
        UnreachableError: No agent runs, or none of that name.
        RmpaError: Several agents run, and none is selected; the text lists them.
    """
    agents = find_agents(environ)
    wanted = name or environ.get("RMPA_AGENT")
    listed = ", ".join(agent.name for agent in agents)
    if not wanted and not agents:
        places = ", ".join(map(str, runtime_dirs(environ) or [runtime_dir(environ)]))
        raise UnreachableError("agent", places, _START_ONE)
    if not wanted:
        facts = NameFacts()
        if len(agents) > 1:
            from rmpa.config.read import load_settings  # noqa: PLC0415 - most commands need no settings

            with contextlib.suppress(ConfigError):  # a broken rmpa.toml is no reason not to ask
                facts = load_settings({}, environ, host_name=socket.gethostname()).name_facts
        wanted = running_agent(with_running(facts, agents, environ))
    for agent in agents:
        if agent.name == wanted:
            return agent
    path = runtime_dir(environ) / f"{wanted}.sock"
    remedy = f"running here: {listed}" if agents else f"start it with `rmpa up --name {wanted}`"
    raise UnreachableError(f"agent {wanted!r}", str(path), remedy)


def with_running(facts: NameFacts, agents: Sequence[FoundAgent], environ: Mapping[str, str]) -> NameFacts:
    """What the choice of a module depends on, with the agents that run; several are asked which of them they are."""
    gateways: tuple[str, ...] = ()
    of_master = ""
    if len(agents) > 1:
        gateways = tuple(agent.name for agent in agents if _is_gateway(agent))
        of_master = _of_master(agents, environ.get("ROS_MASTER_URI", ""))
    names = tuple(agent.name for agent in agents)
    return replace(facts, running=names, gateways=gateways, of_master=of_master)


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
