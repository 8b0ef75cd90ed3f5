"""The server of the control socket, and the users that it serves."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import grp
import inspect
import logging
import os
import socket
import struct
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.bridge.messages import with_text
from rmpa.config.values import did_you_mean
from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError, StartError
from rmpa.observe import limits
from rmpa.observe.control import ControlReply, ControlRequest
from rmpa.observe.control_client import NameLock
from rmpa.runtime.accept import Acceptor, Use
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from pathlib import Path


# The user at the other end of a UNIX socket, as the kernel knows it, and the users that are served.


_UCRED: Final = struct.Struct("3i")
"""``struct ucred``: pid, uid, gid (unix(7), SO_PEERCRED)."""
_SO_PEERGROUPS: Final = 59
"""Not in Python's ``socket``; Linux has it since 4.13."""
_GROUPS_MAX: Final = 256
"""Groups of one user that are read, besides the main one: Python reads no more bytes. Of a user in more of them the
main one alone counts."""


@dataclass(frozen=True, slots=True)
class PeerCredentials:
    """The user of a client, at the time of its ``connect``.

    Attributes:
        pid: Its process; 0 if that is in another namespace.
        uid: Its effective user.
        groups: All groups of that user's process.
    """

    pid: int
    uid: int
    groups: frozenset[int]


def peer_credentials(sock: socket.socket) -> PeerCredentials:
    """The user at the other end.

    Raises:
        OSError: The socket is not a connected UNIX socket.
    """
    pid, uid, gid = _UCRED.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    try:
        raw = sock.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, 4 * _GROUPS_MAX)
    except OSError:
        raw = b""
    return PeerCredentials(pid, uid, frozenset({gid, *(each for (each,) in struct.iter_unpack("I", raw))}))


@dataclass(frozen=True, slots=True)
class ControlAccess:
    """The users that a control socket serves: the agent's own, root, and those of one group.

    Args:
        uid: The agent's user.
        group: The number of the group; ``None`` for none.
    """

    uid: int
    group: int | None = None

    def allows(self, user: PeerCredentials) -> bool:
        """Whether a user is served."""
        return user.uid in {0, self.uid} or (self.group is not None and self.group in user.groups)


def control_access(group: str) -> ControlAccess:
    """Which users an agent of this process's user serves.

    Args:
        group: A group's name or number, which this user must be in; empty for none.

    Raises:
        StartError: There is no such group.
    """
    if not group:
        return ControlAccess(os.geteuid())
    try:
        number = int(group) if group.isdecimal() else grp.getgrnam(group).gr_gid
    except KeyError:
        remedy = f"make it (sudo groupadd {group}), or change group of [control]"
        raise StartError("control.group", f"there is no group {group!r}", remedy) from None
    return ControlAccess(os.geteuid(), number)


# The server of the control socket (protocol: ``observe.control``).


_log = logging.getLogger(__name__)
_yielder: Final = functools.partial(yielding_to_data, every=1)

Handler = Callable[[dict[str, object]], Awaitable[object] | object]


class ControlServer:
    """A UNIX stream socket ``<name>.sock`` for this user, root and one group, and the lock on its name.

    The modes of the directory and the socket keep others out; besides them the kernel is asked for the user of each
    client, since a socket may be passed on, bind-mounted into a container, or have had its mode changed.

    Args:
        place: The runtime directory; made if needed.
        name: The agent's name.
        handlers: By operation; each gets the request's ``args`` and returns a value for JSON (``msgspec`` structs
            too) or an awaitable of one. An ``RmpaError`` becomes the error that the client shows.
        counters: Where refusals are counted: ``control.user``, ``control.refused``, ``control.busy``,
            ``control.failed``.
        access: The users that are served; the agent's own and root, unless it is said.

    Raises:
        StartError: By ``lock()`` and ``start()``, if an agent of this name runs or the socket cannot be made.
    """

    def __init__(
        self,
        place: Path,
        name: str,
        handlers: Mapping[str, Handler],
        *,
        counters: Counters | None = None,
        access: ControlAccess | None = None,
    ) -> None:
        self._place = place
        self._name = name
        self._handlers = handlers
        self.counters = counters if counters is not None else Counters()
        self._refusals = RefusalLog(_log, self.counters)
        self._access = access if access is not None else ControlAccess(os.geteuid())
        self._lock: NameLock | None = None
        self._acceptor: Acceptor | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self.path = place / f"{name}.sock"

    def add(self, handlers: Mapping[str, Handler]) -> None:
        """Serve more operations, before ``start()``."""
        self._handlers = {**self._handlers, **handlers}

    def lock(self) -> None:
        """Lock the name, before anything else of the agent starts; else ``start()`` does it."""
        if self._lock is None:
            self._lock = NameLock(self._place, self._name, self._access.group)

    async def start(self) -> None:
        """Bind and serve. The socket of an agent that was killed is replaced, since its name's lock is ours."""
        if len(os.fsencode(self.path)) > limits.CONTROL_PATH_MAX:
            problem = f"longer than the {limits.CONTROL_PATH_MAX} bytes that a socket's path may have"
            raise StartError(str(self.path), problem, "set RMPA_RUNTIME_DIR to a shorter directory")
        sock = await asyncio.to_thread(self._bind)
        self._acceptor = Acceptor(sock, self._connected, name="control socket", use=Use.LINK)
        self._acceptor.start()
        _log.info("= control socket %s", self.path)

    def _bind(self) -> socket.socket:
        self.lock()
        with contextlib.suppress(FileNotFoundError):
            self.path.unlink()
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            # The directory's mode is 0700 (0750 with a group), so no other user can connect between bind and chmod.
            sock.bind(str(self.path))
            self.path.chmod(0o600)
            if self._access.group is not None:
                os.chown(self.path, -1, self._access.group)
                self.path.chmod(0o660)
            sock.listen(limits.CONTROL_BACKLOG)
        except OSError as error:
            sock.close()
            raise StartError(str(self.path), f"cannot be bound: {error.strerror}") from None
        return sock

    async def close(self) -> None:
        """Close all clients, remove socket and lock; may be called twice."""
        served = self._acceptor is not None
        if self._acceptor is not None:
            self._acceptor.close()
            self._acceptor = None
        await asyncio.sleep(0)  # lets tasks of clients accepted just now begin: only then do they close their sockets
        clients = list(self._clients)
        for task in clients:
            task.cancel()
        await asyncio.gather(*clients, return_exceptions=True)
        await asyncio.to_thread(self._remove, served=served)

    def _remove(self, *, served: bool) -> None:
        if served:
            with contextlib.suppress(FileNotFoundError):
                self.path.unlink()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _connected(self, sock: socket.socket, _address: str) -> None:
        task = asyncio.get_running_loop().create_task(self._open(sock))
        self._clients.add(task)
        task.add_done_callback(self._clients.discard)

    async def _open(self, sock: socket.socket) -> None:
        try:
            reader, writer = await asyncio.open_unix_connection(sock=sock, limit=limits.CONTROL_REQUEST_MAX)
        except BaseException:
            sock.close()
            raise
        await self._serve(reader, writer)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            if refused := self._wrong_user(writer.get_extra_info("socket")):
                await self._turn_away(reader, writer, refused)
                return
            if len(self._clients) > limits.CONTROL_CLIENTS_MAX:
                self._refuse("control.busy", f"more than {limits.CONTROL_CLIENTS_MAX} clients of the control socket")
                busy = ControlReply(
                    ok=False, error="the agent has too many clients", remedy="close some, or try again"
                )
                await self._turn_away(reader, writer, busy)
                return
            while await self._one(reader, writer):
                pass
        except (OSError, TimeoutError, asyncio.IncompleteReadError):
            pass  # gone, idle, or closed half-way: none is an error
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! control client failed")
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    def _wrong_user(self, sock: socket.socket) -> ControlReply | None:
        """The refusal for a client whose user is not served; ``None``: it is served."""
        user = peer_credentials(sock)
        if self._access.allows(user):
            return None
        self._refuse("control.user", f"user {user.uid} (pid {user.pid}) at the control socket")
        error = f"user {user.uid} may not use the control socket of user {self._access.uid}"
        remedy = "use sudo, or name a group of yours as group of [control] in rmpa.toml"
        return ControlReply(ok=False, error=error, remedy=remedy)

    async def _turn_away(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, reply: ControlReply
    ) -> None:
        """Send a reply, and wait for what the client sends: a socket closed before that would break its ``send``."""
        await self._send(writer, reply)
        writer.write_eof()
        async with asyncio.timeout(limits.CONTROL_REFUSED_TIMEOUT):
            await reader.read(limits.CONTROL_REQUEST_MAX)

    async def _one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """Serve one request; returns whether the connection stays open."""
        try:
            async with asyncio.timeout(limits.CONTROL_IDLE_TIMEOUT):
                line = await reader.readuntil(b"\n")
                request = ControlRequest.parse(line)
                if not 0 <= request.follows <= limits.CONTROL_TEXT_BYTES_MAX:
                    raise LimitExceeded("a text of a control request", request.follows, limits.CONTROL_TEXT_BYTES_MAX)
                if request.follows:
                    with_text(request.args, await reader.readexactly(request.follows))
        except asyncio.LimitOverrunError:
            self._refuse("control.refused", f"a control request of more than {limits.CONTROL_REQUEST_MAX} bytes")
            await self._send(writer, ControlReply(ok=False, error=f"more than {limits.CONTROL_REQUEST_MAX} bytes"))
            return False
        except RemoteProtocolError as error:
            self._refuse("control.refused", str(error))
            await self._send(writer, ControlReply(ok=False, error=str(error)))
            return False
        _log.debug("< control %s", request)
        return await self._send(writer, await self._answer(request))

    async def _answer(self, request: ControlRequest) -> ControlReply:
        handler = self._handlers.get(request.op)
        if handler is None:
            near = did_you_mean(request.op, self._handlers)
            remedy = f"did you mean {near}?" if near else f"there are {', '.join(sorted(self._handlers))}"
            return ControlReply(ok=False, error=f"no op {request.op!r}", remedy=remedy)
        try:
            async with asyncio.timeout(limits.CONTROL_HANDLER_TIMEOUT):
                value = handler(request.args)
                return ControlReply(ok=True, value=await value if inspect.isawaitable(value) else value)
        except RmpaError as error:
            return ControlReply(ok=False, error=str(error))
        except TimeoutError:
            return ControlReply(ok=False, error=f"{request.op} took more than {limits.CONTROL_HANDLER_TIMEOUT:.0f} s")
        except Exception:  # noqa: BLE001 - one handler's bug must not end the client's connection
            self.counters.add("control.failed")
            _log.exception("! control handler %s failed", request)
            return ControlReply(ok=False, error=f"the agent failed at {request.op}", remedy="its log says why")

    async def _send(self, writer: asyncio.StreamWriter, reply: ControlReply) -> bool:
        try:
            line = reply.serialize(_yielder)
        except RmpaError as error:
            _log.exception("! control reply")
            line = ControlReply(ok=False, error=str(error)).serialize()
        async with asyncio.timeout(limits.CONTROL_IDLE_TIMEOUT):
            writer.write(line)
            await writer.drain()
        return True

    def _refuse(self, name: str, text: str) -> None:
        self._refusals.refuse(asyncio.get_running_loop().time(), name, "local", text)
