"""What takes from the system: connections, descriptors, listening sockets and threads.

A connection for which no file descriptor is left is closed at once. Where accept(2) itself fails, the listening
socket stays readable, and the loop would call the server again and again: an ``Acceptor`` pauses then.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import enum
import errno
import logging
import os
import resource
import socket
import sys
import threading
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rmpa.core.errors import OutOfDescriptors, StartError
from rmpa.core.facts import FilesInfo
from rmpa.core.log import RefusalLog
from rmpa.core.statistics import Counters
from rmpa.runtime import limits

if TYPE_CHECKING:
    from collections.abc import Callable

_log = logging.getLogger(__name__)


# The mesh port. TCP for links and UDP for unicast beacons under one number.


def open_mesh_port(port: int = 0) -> tuple[socket.socket, socket.socket]:
    """Bind a listening TCP socket and a UDP socket to the same port on all addresses.

    Args:
        port: The port, or 0 for one that the system chooses.

    Returns:
        The listening TCP socket and the UDP socket, both non-blocking.

    Raises:
        StartError: The port is taken, or this user may not bind it.
    """
    for attempt in range(limits.MESH_PORT_ATTEMPTS):
        tcp = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            # A restarted agent gets its port back although old connections are in TIME_WAIT. Never set it on the UDP
            # socket: two agents could then bind one port without an error, and each would miss half of its beacons.
            tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tcp.bind(("", port))
            udp.bind(("", tcp.getsockname()[1]))
            tcp.listen(limits.MESH_BACKLOG)
        except OSError as error:
            tcp.close()
            udp.close()
            if port == 0 and error.errno == errno.EADDRINUSE and attempt + 1 < limits.MESH_PORT_ATTEMPTS:
                continue  # the number was free for TCP but not for UDP
            raise _refused(port, error) from error
        tcp.setblocking(False)
        udp.setblocking(False)
        return tcp, udp
    raise AssertionError("unreachable")


def _refused(port: int, error: OSError) -> StartError:
    if error.errno == errno.EADDRINUSE:
        problem = "is in use, perhaps by another agent"
        remedy = "choose another with --port, or leave the choice to the system (--port 0)"
    elif error.errno == errno.EACCES:
        problem, remedy = "is not for this user", "choose one above 1023 with --port"
    else:
        problem, remedy = f"cannot be opened ({error.strerror})", ""
    return StartError(f"mesh port {port}", problem, remedy, code="port-in-use")


# The file descriptors of this process. Which uses may take the last ones, and what is said when they run out.
#
# A process without a free descriptor can neither accept nor dial. Connections for data are refused early, so that
# the ROS core, the control socket and the links to peers still work: a user must be able to ask what is wrong.
#
# No count is kept. The kernel gives each new descriptor the lowest free number (POSIX, open(2)): a number near the
# limit means that all lower ones are taken.


# Errors of accept(2) and socket(2) about a lack of descriptors or memory, which may pass.
OUT_OF_DESCRIPTORS: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


class Use(enum.Enum):
    """The purpose of a descriptor; the value is the number of reserves that it must leave free."""

    # Listening sockets of the proxies of remote nodes; they must leave room for the connections to those sockets.
    PROXY = 2.0
    # Connections of topics and services, and to the slave APIs of nodes: they must leave the whole reserve.
    DATA = 1.0
    # The ROS core's XML-RPC.
    CORE = 0.5
    # Links to peers and the control socket: they may take the last descriptor.
    LINK = 0.0


class Descriptors:
    """The descriptors of one process, shared by all servers and clients. Not thread-safe: for the loop's thread.

    Attributes:
        counters: ``descriptors.refused.data`` (``.proxy``, ``.core``, ``.link``): attempts to accept or to dial
            without a free descriptor, repeated attempts included.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self._refusals = RefusalLog(_log, self.counters)
        self._problem, self._refused_at = "", float("-inf")
        self._count, self._count_until = 0, float("-inf")

    @property
    def limit(self) -> int:
        """The soft limit, which may be changed while the process runs (prlimit(1))."""
        return _file_limits()[0]

    @property
    def reserve(self) -> int:
        """The number of descriptors that are kept for the core and the links."""
        return min(limits.DESCRIPTORS_RESERVED, self.limit // limits.DESCRIPTORS_RESERVED_PART)

    @property
    def open(self) -> int:
        """The number of open descriptors, as of the last second or so."""
        now = time.monotonic()
        if now >= self._count_until:
            self._count = _count_open(self.limit)
            # On older kernels the descriptors must be listed, which takes 20 ms for 60,000 of them.
            self._count_until = now + max(1.0, (time.monotonic() - now) * limits.DESCRIPTORS_COUNT_SHARE)
        return self._count

    def has_room(self, use: Use, fd: int) -> bool:
        """Whether ``use`` may keep the descriptor ``fd``, whose number was the lowest free one."""
        return fd < self.limit - int(self.reserve * use.value)

    @property
    def problem(self) -> str:
        """What was refused in the last seconds and what to do, as a text for the user; empty for nothing."""
        return self._problem if time.monotonic() - self._refused_at < limits.DESCRIPTORS_TOLD else ""

    def info(self) -> FilesInfo:
        """Its piece of the snapshot."""
        used, limit, reserved = self.open, self.limit, self.reserve
        return FilesInfo(
            open=used,
            limit=limit,
            hard=_file_limits()[1],
            reserved=reserved,
            near=used >= limits.DESCRIPTORS_NEAR * (limit - reserved),
            refused=sum(count for name, count in self.counters.as_dict().items() if ".refused." in name),
            problem=self.problem,
        )

    def open_socket(self, use: Use, family: int = socket.AF_INET, what: str = "a new connection") -> socket.socket:
        """A new non-blocking stream socket, if there is a descriptor left for ``use``.

        Raises:
            OSError: There is no descriptor left (``EMFILE``; counted and logged), or another error.
        """
        try:
            sock = socket.socket(family, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        except OSError as error:
            if error.errno in OUT_OF_DESCRIPTORS:
                self.refuse(use, what, error)
            raise
        if not self.keeps(use, sock, what):
            raise OSError(errno.EMFILE, "too many open files; the last ones are kept for the core and the links")
        return sock

    def keeps(self, use: Use, sock: socket.socket, what: str) -> bool:
        """Whether there is a descriptor left for this new socket; else it is closed, counted and logged."""
        if self.has_room(use, sock.fileno()):
            return True
        sock.close()
        self.refuse(use, what)
        return False

    def refuse(self, use: Use, what: str, error: OSError | None = None) -> None:
        """Count an attempt for which there was no descriptor; log one of each use in a while.

        Args:
            use: What the descriptor was for.
            what: What needed it, for the log: ``node /talker``.
            error: The system's error; ``None`` if there was a descriptor, but it belongs to the reserve.
        """
        if error is not None and error.errno != errno.EMFILE:
            why = f"the system has no room for another file ({error.strerror}); see /proc/sys/fs/file-nr and `free`"
        else:
            kept = f"the limit is {self.limit}, of which the last {self.reserve} are kept for the core and the links"
            why = f"no file descriptors left ({kept}); {open_files_advice(os.getpid())}"
        self._problem, self._refused_at = f"{what} is refused: {why}", time.monotonic()
        self._refusals.refuse(self._refused_at, f"descriptors.refused.{use.name.lower()}", "", self._problem)


def is_shortage(error: BaseException | None) -> bool:
    """Whether an error, or its cause, is a lack of descriptors."""
    if error is None or isinstance(error, OutOfDescriptors):
        return error is not None
    return (isinstance(error, OSError) and error.errno in OUT_OF_DESCRIPTORS) or is_shortage(error.__cause__)


def _count_open(limit: int) -> int:
    with contextlib.suppress(OSError):
        # The directory's size, since Linux 6.2; 0 before.
        if count := Path("/proc/self/fd").stat().st_size:
            return count
    try:
        return sum(1 for _ in os.scandir("/proc/self/fd")) - 1  # without the descriptor of this listing
    except OSError:
        return limit  # no descriptor is left for the listing: all are open


def _file_limits() -> tuple[int, int]:
    """The soft and the hard limit of open files."""
    soft, hard = (
        sys.maxsize if limit == resource.RLIM_INFINITY else limit
        for limit in resource.getrlimit(resource.RLIMIT_NOFILE)
    )
    return soft, hard


def raise_file_limit() -> int:
    """Raise the soft limit of open files to the hard one, or ``limits.OPEN_FILES``; return the new limit."""
    soft, hard = _file_limits()
    wanted = min(hard, limits.OPEN_FILES)
    with contextlib.suppress(OSError, ValueError):  # some sandboxes forbid it; then the old limit stays
        if soft < wanted:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
            return wanted
    return soft


# The descriptors of this process.
DESCRIPTORS: Final = Descriptors()


# Runs a user's function in a thread of its own, where it may hang forever without blocking anything else.


_T = TypeVar("_T")


async def in_thread(function: Callable[[], _T], name: str) -> _T:
    """Call ``function`` in a new daemon thread, and return its result. Cancellation does not stop the thread.

    ``asyncio.to_thread`` uses a pool, which a few hanging functions would exhaust. A daemon thread does not keep the
    process from ending.

    Args:
        function: Its exceptions are raised here; ``SystemExit`` and the like as ``RuntimeError``.
        name: The thread's name.
    """
    loop = asyncio.get_running_loop()
    result: asyncio.Future[_T] = loop.create_future()

    def run() -> None:
        settle: Callable[[], None]
        try:
            settle = partial(result.set_result, function())
        except BaseException as error:  # noqa: BLE001 - handed on; what ends a process ends this function alone
            raised = error
            if not isinstance(error, Exception) or isinstance(error, StopIteration):
                raised = RuntimeError(f"{type(error).__name__}: {error}")
            settle = partial(result.set_exception, raised)
        with contextlib.suppress(RuntimeError):  # the loop ended before this thread
            loop.call_soon_threadsafe(lambda: None if result.done() else settle())

    context = contextvars.copy_context()
    threading.Thread(target=context.run, args=(run,), name=name, daemon=True).start()
    return await result


# Errors of accept(2) that concern one waiting connection only; the next one may succeed.
_GONE: Final = frozenset(
    {
        errno.ECONNABORTED,
        errno.EHOSTDOWN,
        errno.EHOSTUNREACH,
        errno.ENETDOWN,
        errno.ENETUNREACH,
        errno.ENONET,
        errno.ENOPROTOOPT,
        errno.EOPNOTSUPP,
        errno.EPROTO,
    }
)


@dataclass(eq=False)
class Acceptor:
    """Hands each connection of ``sock`` to ``on_accept``, a few at a time.

    Args:
        sock: Bound and listening; closed by ``close()``.
        on_accept: ``(connection, address)``, called from the loop. The connection is non-blocking and belongs to the
            callee, unless the call raises.
        name: The server, for log messages: ``XML-RPC of /talker``.
        use: The purpose of the connections, which decides whether they may take the last descriptors; else they are
            closed.
        at_once: Connections that are accepted in one callback of the loop.
        make_room: Closes another connection where no descriptor is left for a new one, whose turn comes in the loop's
            next iteration; returns whether there was one.
    """

    sock: socket.socket
    on_accept: Callable[[socket.socket, Any], None]
    name: str
    use: Use = Use.DATA
    at_once: int = limits.ACCEPTS
    make_room: Callable[[], bool] | None = None

    def __post_init__(self) -> None:
        self.sock.setblocking(False)
        self._refusals = RefusalLog(_log, DESCRIPTORS.counters)
        self._listening = False
        self._closed = False
        self._timer: asyncio.TimerHandle | None = None

    @property
    def address(self) -> Any:
        """The address that the socket listens at, as ``getsockname`` returns it."""
        return self.sock.getsockname()

    @property
    def paused(self) -> bool:
        """Whether accepting is paused."""
        return self._timer is not None

    def start(self) -> None:
        """Begin to accept."""
        self._timer = None
        if not self._listening and not self._closed:
            asyncio.get_running_loop().add_reader(self.sock.fileno(), self._acceptable)
            self._listening = True

    def pause(self, seconds: float) -> None:
        """Leave connections to the kernel, which refuses those that its queue does not hold, for so long."""
        if not self._closed and self._timer is None:
            self._stop()
            self._timer = asyncio.get_running_loop().call_later(seconds, self.start)

    def close(self) -> None:
        """Stop accepting, and close the listening socket; may be called twice."""
        self._stop()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._closed = True
        self.sock.close()

    def _stop(self) -> None:
        if self._listening:
            asyncio.get_running_loop().remove_reader(self.sock.fileno())
            self._listening = False

    def _acceptable(self) -> None:
        for _ in range(self.at_once):
            if self._closed or self._timer is not None:
                return  # ``on_accept`` closed or paused this acceptor
            if self.make_room is not None and not self._has_room() and self.make_room():
                return
            try:
                sock, address = self.sock.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in _GONE:
                    continue
                self._failed(error)
                return
            if not DESCRIPTORS.keeps(self.use, sock, f"a connection to {self.name}"):
                continue
            try:
                sock.setblocking(False)
                self.on_accept(sock, address)
            except BaseException:
                sock.close()
                raise

    def _has_room(self) -> bool:
        """Whether these connections may take the lowest free descriptor, whose number a duplicate shows."""
        try:
            lowest = os.dup(self.sock.fileno())
        except OSError:
            return False
        os.close(lowest)
        return DESCRIPTORS.has_room(self.use, lowest)

    def _failed(self, error: OSError) -> None:
        if error.errno in OUT_OF_DESCRIPTORS:
            DESCRIPTORS.refuse(self.use, f"a connection to {self.name}", error)
        else:
            now, pause = asyncio.get_running_loop().time(), limits.ACCEPT_PAUSE
            text = f"{self.name} cannot accept connections: {error.strerror}; next attempt in {pause:g} s"
            self._refusals.refuse(now, "accept.failed", self.name, text)
        self.pause(limits.ACCEPT_PAUSE)


def open_files_advice(pid: int | None = None) -> str:
    """How to raise the limit permanently; with a process id also how to raise it for that process at once."""
    enough = 65_536  # for some ten thousand nodes
    text = (
        f"raise it: LimitNOFILE={enough} of a systemd unit, "
        f"`ulimit -n {enough}` as root in the shell that starts the agent"
    )
    if pid is not None:
        text += f", or at once, as root: prlimit --pid {pid} --nofile={enough}:{enough}"
    return text
