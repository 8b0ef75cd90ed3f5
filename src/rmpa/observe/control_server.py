"""The server of the control socket, the lock of its agent's name, and the users that it serves."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import grp
import inspect
import logging
import os
import socket
import stat
import struct
from collections.abc import Awaitable, Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge.messages import with_text
from rmpa.config.values import suggestion
from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError, StartError
from rmpa.core.log import RefusalLog
from rmpa.core.statistics import Counters
from rmpa.observe import limits
from rmpa.observe.control_client import ControlReply, ControlRequest
from rmpa.runtime.accept import Acceptor, Use
from rmpa.runtime.loop import yielding_to_data
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from pathlib import Path


_log = logging.getLogger(__name__)
# ``struct ucred``: pid, uid, gid (unix(7), SO_PEERCRED).
_UCRED: Final = struct.Struct("3i")
# Not in Python's ``socket``; Linux has it since 4.13.
_SO_PEERGROUPS: Final = 59
# Groups of one user that are read, besides the main one: Python reads no more bytes. Of a user in more of them the
# main one alone counts.
_GROUPS_MAX: Final = 256

Handler = Callable[[dict[str, Any]], Awaitable[object] | object]


def peer_credentials(sock: socket.socket) -> tuple[int, int, frozenset[int]]:
    """The process, the user and all groups of the other end of a UNIX socket, at the time of its ``connect``.

    The process is 0 if it is in another namespace.

    Raises:
        OSError: The socket is not a connected UNIX socket.
    """
    pid, uid, gid = _UCRED.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    raw = b""
    with contextlib.suppress(OSError):
        raw = sock.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, 4 * _GROUPS_MAX)
    return pid, uid, frozenset({gid, *(each for (each,) in struct.iter_unpack("I", raw))})


def control_group(name: str) -> int | None:
    """The number of the group that may use the control socket.

    Args:
        name: Its name or number, which this user must be in; empty for none.

    Raises:
        StartError: There is no such group.
    """
    try:
        return None if not name else int(name) if name.isdecimal() else grp.getgrnam(name).gr_gid
    except KeyError:
        remedy = f"make it (sudo groupadd {name}), or change group of [control]"
        raise StartError("control.group", f"there is no group {name!r}", remedy, code="invalid-value") from None


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
        group: The number of the group that is served.

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
        group: int | None = None,
    ) -> None:
        self._place = place
        self._name = name
        self._handlers = dict(handlers)
        self.counters = counters if counters is not None else Counters()
        self._refusals = RefusalLog(_log, self.counters)
        self._group = group
        self._lock: NameLock | None = None
        self._acceptor: Acceptor | None = None
        self._clients = OwnedTasks()
        self.path = place / f"{name}.sock"

    def add(self, handlers: Mapping[str, Handler]) -> None:
        """Serve more operations, before ``start()``."""
        self._handlers.update(handlers)

    def serves(self, uid: int, groups: frozenset[int]) -> bool:
        """Whether a user is served."""
        return uid in {0, os.geteuid()} or self._group in groups

    def lock(self) -> None:
        """Lock the name, before anything else of the agent starts; else ``start()`` does it."""
        if self._lock is None:
            self._lock = NameLock(self._place, self._name, self._group)

    async def start(self) -> None:
        """Bind and serve. The socket of an agent that was killed is replaced, since its name's lock is ours."""
        if len(os.fsencode(self.path)) > limits.CONTROL_PATH_MAX:
            problem = f"longer than the {limits.CONTROL_PATH_MAX} bytes that a socket's path may have"
            remedy = "set RMPA_RUNTIME_DIR to a shorter directory"
            raise StartError(str(self.path), problem, remedy, code="directory-unusable")
        sock = await asyncio.to_thread(self._bind)
        self._acceptor = Acceptor(sock, self._connected, name="control socket", use=Use.LINK)
        self._acceptor.start()
        _log.info("= control socket %s", self.path)

    def _bind(self) -> socket.socket:
        self.lock()
        self.path.unlink(missing_ok=True)
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            # The directory's mode is 0700 (0750 with a group), so no other user can connect between bind and chmod.
            sock.bind(str(self.path))
            self.path.chmod(0o600)
            if self._group is not None:
                os.chown(self.path, -1, self._group)
                self.path.chmod(0o660)
            sock.listen(128)
        except OSError as error:
            sock.close()
            problem = f"cannot be bound: {error.strerror}"
            raise StartError(str(self.path), problem, code="directory-unusable") from None
        return sock

    async def close(self) -> None:
        """Close all clients, remove socket and lock; may be called twice."""
        served, self._acceptor = self._acceptor, None
        if served is not None:
            served.close()
        await asyncio.sleep(0)  # lets tasks of clients accepted just now begin: only then do they close their sockets
        await self._clients.close()
        if served is not None:
            self.path.unlink(missing_ok=True)
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _connected(self, sock: socket.socket, _address: str) -> None:
        self._clients.start(self._serve(sock), "serve a client of the control socket")

    async def _serve(self, sock: socket.socket) -> None:
        try:
            reader, writer = await asyncio.open_unix_connection(sock=sock, limit=limits.CONTROL_REQUEST_MAX)
        except BaseException:
            sock.close()
            raise
        try:
            if (refused := self._refusal(sock)) is None:
                while await self._one(reader, writer):
                    pass
            else:
                await self._send(writer, refused)
                writer.write_eof()
                # What the client sends is awaited: a socket closed before that would break its ``send``. It holds
                # its place among the clients for so long.
                async with asyncio.timeout(1.0):
                    await reader.read(limits.CONTROL_REQUEST_MAX)
        except (OSError, asyncio.IncompleteReadError):
            pass  # gone, idle, or closed half-way: none is an error
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    def _refusal(self, sock: socket.socket) -> ControlReply | None:
        """The reply to a client that is not served; ``None``: it is."""
        pid, uid, groups = peer_credentials(sock)
        if not self.serves(uid, groups):
            error = f"user {uid} may not use the control socket of user {os.geteuid()}"
            remedy = "use sudo, or name a group of yours as group of [control] in rmpa.toml"
            return self._refuse("control.user", f"user {uid} (pid {pid}) at the control socket", error, remedy)
        if len(self._clients) > limits.CONTROL_CLIENTS_MAX:
            text = f"more than {limits.CONTROL_CLIENTS_MAX} clients of the control socket"
            return self._refuse("control.busy", text, "the agent has too many clients", "close some, or try again")
        return None

    def _refuse(self, counter: str, text: str, error: str = "", remedy: str = "") -> ControlReply:
        self._refusals.refuse(asyncio.get_running_loop().time(), counter, "local", text)
        return ControlReply(ok=False, error=error or text, remedy=remedy)

    async def _one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """Serve one request; returns whether the connection stays open."""
        try:
            async with asyncio.timeout(limits.CONTROL_IDLE_TIMEOUT):
                request = ControlRequest.parse(await reader.readuntil(b"\n"))
                if not 0 <= request.follows <= limits.CONTROL_TEXT_BYTES_MAX:
                    raise LimitExceeded("a text of a control request", request.follows, limits.CONTROL_TEXT_BYTES_MAX)
                if request.follows:
                    with_text(request.args, await reader.readexactly(request.follows))
            _log.debug("< control %s", request)
            reply, goes_on = await self._answer(request), True
        except asyncio.LimitOverrunError:
            text = f"more than {limits.CONTROL_REQUEST_MAX} bytes"
            reply, goes_on = self._refuse("control.refused", f"a control request of {text}", text), False
        except RemoteProtocolError as error:
            reply, goes_on = self._refuse("control.refused", str(error)), False
        await self._send(writer, reply)
        return goes_on

    async def _answer(self, request: ControlRequest) -> ControlReply:
        handler = self._handlers.get(request.op)
        if handler is None:
            remedy = suggestion(request.op, self._handlers, f"there are {', '.join(sorted(self._handlers))}")
            return ControlReply(ok=False, error=f"no op {request.op!r}", remedy=remedy)
        deadline = asyncio.timeout(limits.CONTROL_HANDLER_TIMEOUT)
        try:
            async with deadline:
                value = handler(request.args)
                return ControlReply(ok=True, value=await value if inspect.isawaitable(value) else value)
        except RmpaError as error:
            return ControlReply(ok=False, error=str(error), code=error.code)
        except Exception:  # noqa: BLE001 - one handler's bug must not end the client's connection
            if deadline.expired():
                text = f"{request.op} took more than {limits.CONTROL_HANDLER_TIMEOUT:.0f} s"
                return ControlReply(ok=False, error=text)
            self.counters.add("control.failed")
            _log.exception("! control handler %s failed", request)
            text = f"the agent failed at {request.op}"
            return ControlReply(ok=False, error=text, remedy="its log says why", code="internal-error")

    @staticmethod
    async def _send(writer: asyncio.StreamWriter, reply: ControlReply) -> None:
        try:
            line = reply.serialize(yielding_to_data)
        except RmpaError as error:
            _log.exception("! control reply")
            line = ControlReply(ok=False, error=str(error)).serialize()
        async with asyncio.timeout(limits.CONTROL_IDLE_TIMEOUT):
            writer.write(line)
            await writer.drain()
