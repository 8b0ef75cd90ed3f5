"""The TCP sockets of this network namespace, of all processes: where they listen, their connections, and their end.

The kernel is asked by ``runtime.sock_diag``. Each function may be called in the event loop: none waits, and each says
what it costs. A connection over IPv6 whose addresses are IPv4 (v4-mapped, as those to a socket that listens at "::")
has IPv4 addresses here.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import os
import socket
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.runtime.sock_diag import InetSocket, SockDiag

if TYPE_CHECKING:
    from collections.abc import Iterable

_STATES: Final = {
    1: "ESTABLISHED",
    2: "SYN_SENT",
    4: "FIN_WAIT1",
    5: "FIN_WAIT2",
    8: "CLOSE_WAIT",
    9: "LAST_ACK",
    11: "CLOSING",
}
"""The states of ``connections``, by their number in ``linux/tcp_states.h``."""
_CONNECTED: Final = sum(1 << number for number in _STATES)
_LISTEN: Final = 1 << 10
_FAMILIES: Final = (socket.AF_INET, socket.AF_INET6)
_ADDRESS: Final = 16
_MAPPED: Final = bytes(10) + b"\xff\xff"
_PORTS: Final = range(1, 1 << 16)
_GONE: Final = frozenset({errno.ENOENT, errno.ESTALE})
_UNSUPPORTED: Final = frozenset({errno.EOPNOTSUPP, errno.EINVAL})
"""``EINVAL`` comes from kernels before 4.5, which do not know the message."""
_libc: Final = ctypes.CDLL(None, use_errno=True)
_PIDFD_GETFD: Final = 438
"""The number of pidfd_getfd(2), the same on all machines, since Linux 5.6; Python has no function for it."""
_DISCONNECT: Final = bytes(16)
"""A socket address of the family AF_UNSPEC, which ends a connection (connect(2))."""
_YAMA: Final = Path("/proc/sys/kernel/yama/ptrace_scope")
REMEDY: Final = (
    "run the agent with CAP_NET_ADMIN: `AmbientCapabilities=CAP_NET_ADMIN` in its systemd unit, "
    "`--cap-add NET_ADMIN` for Docker, or `setcap cap_net_admin+ep PYTHON`"
)
"""What gives an agent the right to end connections."""


@dataclass(frozen=True, slots=True)
class TcpConnection:
    """One TCP socket that is connected, connecting, or closing.

    Args:
        local: Its own address and port.
        remote: The address and port of the other end.
        state: Its name in RFC 9293 without hyphens: ``ESTABLISHED``, ``SYN_SENT``, ``FIN_WAIT1``, ``FIN_WAIT2``,
            ``CLOSING``, ``CLOSE_WAIT``, ``LAST_ACK``.
        inode: As in the links of ``/proc/PID/fd``; 0 where no process holds the socket any more.
        uid: User id of its owner.
        cookie: The kernel's number of the socket; no other socket ever has the same.
        family: ``AF_INET`` or ``AF_INET6``; the latter with IPv4 addresses too.
        interface: Index of the interface to which the socket is bound, or 0.
    """

    local: tuple[str, int]
    remote: tuple[str, int]
    state: str
    inode: int
    uid: int
    cookie: tuple[int, int]
    family: int
    interface: int = 0


# --- looking ----------------------------------------------------------------------------------------------------


def ask_listening_ports() -> set[int] | None:
    """TCP ports in state LISTEN; ``None`` where the kernel does not report them. It takes some 0.1 ms."""
    found = _dump(_LISTEN)
    return None if found is None else {InetSocket.parse(body).source_port for body in found}


def listening_addresses(port: int) -> frozenset[str] | None:
    """The local addresses of the sockets in state LISTEN at a port, in some 0.1 ms.

    Returns:
        ``"0.0.0.0"`` and ``"::"`` for any address (``"::"`` may be for IPv6 alone), ``"127.0.0.1"``…; empty where
        nothing listens; ``None`` where the kernel does not report it.
    """
    if port not in _PORTS:
        return frozenset()
    found = _dump(_LISTEN, port)
    if found is None:
        return None
    sockets = map(InetSocket.parse, found)
    return frozenset(_text(of.family, of.source) for of in sockets)


@dataclass(frozen=True, slots=True)
class ListeningSocket:
    """A TCP socket in state LISTEN.

    Args:
        address: Its local address, numeric; ``0.0.0.0`` and ``::`` for any.
        port: Its port.
        inode: As in the links of ``/proc/PID/fd``.
    """

    address: str
    port: int
    inode: int


def listening_sockets() -> list[ListeningSocket] | None:
    """All TCP sockets in state LISTEN; ``None`` where the kernel does not report them. It takes some 0.1 ms."""
    found = _dump(_LISTEN)
    if found is None:
        return None
    sockets = map(InetSocket.parse, found)
    return [ListeningSocket(_text(of.family, of.source), of.source_port, of.inode) for of in sockets]


def program_at(port: int) -> str:
    """The program that has a port, TCP or UDP, such as ``rosmaster (pid 812)``; empty where the kernel does not say.

    It reads the descriptors of all processes that this user may see, which takes some 50 ms.
    """
    import psutil  # noqa: PLC0415 - for a text of an error

    with contextlib.suppress(psutil.Error, OSError):
        for connection in psutil.net_connections("inet"):
            listens = connection.status in (psutil.CONN_LISTEN, psutil.CONN_NONE)
            if listens and connection.laddr and connection.laddr.port == port and connection.pid:
                return f"{psutil.Process(connection.pid).name()} (pid {connection.pid})"
    return ""


def connections(
    *, local_port: int | None = None, remote: tuple[str, int | None] | None = None
) -> list[TcpConnection] | None:
    """The connections of all processes, of one local port, or to one remote address.

    The kernel selects them. With 2,000 connections of others here this takes 0.7 ms (0.4 ms with none), and 10
    microseconds more for each one that is returned.

    Args:
        local_port: Only those with this local port.
        remote: Only those to this address (IPv4 or IPv6, no name), at this port or, with ``None``, at any.

    Returns:
        The connections; one that opens or closes meanwhile may be missing. ``None`` where the kernel does not report
        them.
    """
    address, port = remote or (None, None)
    if (local_port is not None and local_port not in _PORTS) or (port is not None and port not in _PORTS):
        return []
    wanted = b"" if address is None else _packed(address)
    found = _dump(_CONNECTED, local_port or 0, port or 0, wanted)
    if found is None:
        return None
    return [made for body in found if (made := _connection(InetSocket.parse(body))) is not None]


def _dump(
    states: int, source_port: int = 0, destination_port: int = 0, destination: bytes = b""
) -> list[bytes] | None:
    try:
        with SockDiag() as kernel:
            return [
                body
                for family in _FAMILIES
                for body in kernel.dump(
                    family,
                    states,
                    source_port=source_port,
                    destination_port=destination_port,
                    destination=destination,
                )
            ]
    except (OSError, ValueError):
        return None


def _connection(found: InetSocket) -> TcpConnection | None:
    state = _STATES.get(found.state)
    if state is None:
        return None
    local = (_text(found.family, found.source), found.source_port)
    remote = (_text(found.family, found.destination), found.destination_port)
    return TcpConnection(local, remote, state, found.inode, found.uid, found.cookie, found.family, found.interface)


def _text(family: int, address: bytes) -> str:
    if family == socket.AF_INET:
        return socket.inet_ntop(socket.AF_INET, address[:4])
    if address.startswith(_MAPPED):
        return socket.inet_ntop(socket.AF_INET, address[len(_MAPPED) :])
    return socket.inet_ntop(socket.AF_INET6, address)


def _packed(address: str) -> bytes:
    """4 or 16 bytes.

    Raises:
        ValueError: The text is no IP address.
    """
    try:
        return socket.inet_pton(socket.AF_INET6 if ":" in address else socket.AF_INET, address)
    except OSError:
        raise ValueError(f"{address!r} is no IP address") from None


def _padded(family: int, address: str) -> bytes:
    """The 16 bytes that the kernel has for an address of a socket of this family."""
    packed = _packed(address)
    if len(packed) == _ADDRESS:
        return packed
    return _MAPPED + packed if family == socket.AF_INET6 else packed + bytes(_ADDRESS - len(packed))


# --- ending -----------------------------------------------------------------------------------------------------


def end_connections(found: Iterable[TcpConnection]) -> int:
    """End connections of any process (``SOCK_DESTROY``, what ``ss -K`` does), in some 0.02 ms each.

    Calls of the process that holds the socket fail with ``ECONNABORTED``, also those that wait already; the other end
    gets a reset. Without CAP_NET_ADMIN those of this user's processes are ended by a copy of their descriptor
    (pidfd_getfd, where Yama does not forbid it), with ``ECONNRESET`` or ``EPIPE``; a search for them takes some
    milliseconds.

    Returns:
        How many were ended. A connection that is gone already is not counted.

    Raises:
        PermissionError: Some could not be ended: this process has no CAP_NET_ADMIN, and they are not of processes
            that it may touch. The others were ended.
        OSError: ``EOPNOTSUPP``: the kernel lacks ``CONFIG_INET_DIAG_DESTROY``; or another error of netlink.
    """
    ended = refused = 0
    with SockDiag() as kernel:
        for connection in found:
            number = kernel.destroy(_socket(connection))
            if number == errno.EPERM:
                done = _disconnect(connection)
                ended, refused = ended + done, refused + (not done)
                continue
            if number in _UNSUPPORTED:
                raise OSError(errno.EOPNOTSUPP, "this kernel cannot end connections (CONFIG_INET_DIAG_DESTROY)")
            if number and number not in _GONE:
                raise OSError(number, os.strerror(number))
            ended += not number
    if refused:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
    return ended


def _disconnect(connection: TcpConnection) -> bool:
    """End a connection of a process of this user by a copy of its descriptor; return whether that was possible."""
    if not connection.inode or connection.uid != os.geteuid():
        return False
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if process.stat().st_uid != os.geteuid():
                continue
            for entry in (process / "fd").iterdir():
                if str(entry.readlink()) == f"socket:[{connection.inode}]":
                    return _disconnect_copy(int(process.name), int(entry.name), connection)
    return False


def _disconnect_copy(process: int, descriptor: int, connection: TcpConnection) -> bool:
    pidfd = os.pidfd_open(process)
    try:
        copy = _libc.syscall(_PIDFD_GETFD, pidfd, descriptor, 0)
    finally:
        os.close(pidfd)
    if copy < 0:
        return False
    with socket.socket(fileno=copy) as sock:
        if os.fstat(copy).st_ino != connection.inode:
            return False  # the number is another socket's by now
        if _libc.connect(copy, _DISCONNECT, len(_DISCONNECT)):
            # Some kernels refuse it while the process waits in a call. That is released, and closing drops the rest.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            sock.shutdown(socket.SHUT_RDWR)
    return True


def _socket(connection: TcpConnection) -> InetSocket:
    family = connection.family
    return InetSocket(
        family,
        0,
        _padded(family, connection.local[0]),
        connection.local[1],
        _padded(family, connection.remote[0]),
        connection.remote[1],
        connection.interface,
        connection.cookie,
    )


def may_end_connections() -> str:
    """Whether this process may end connections: an empty text, or why not, with the remedy after the first ``"; "``.

    It tries once, on a connection of its own over loopback, in about a millisecond; later calls return the same. An
    attempt that fails for another reason, as a lack of file descriptors, is made again by the next call.
    """
    try:
        return try_to_end()
    except (OSError, ValueError) as error:
        return f"an attempt to end a connection failed: {error}; see `rmpa doctor` for what this machine lacks"


@functools.cache
def try_to_end() -> str:
    """End a connection of this process, to see whether that works; the result is that of ``may_end_connections``.

    Raises:
        OSError, ValueError: The attempt failed for a reason that may pass.
    """
    try:
        with socket.socket() as listener, socket.socket() as client:
            for sock in (listener, client):
                sock.setblocking(False)
            listener.bind(("127.0.0.1", 0))
            listener.listen(1)
            client.connect_ex(listener.getsockname())  # done at once, or soon: SYN_SENT serves as well
            own = connections(local_port=client.getsockname()[1], remote=listener.getsockname())
            if own is None:
                return "the kernel does not report its sockets (CONFIG_INET_DIAG, or a sandbox); use another kernel"
            ended = end_connections(own)
            error = client.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    except PermissionError:
        return f"this process has no CAP_NET_ADMIN; {REMEDY}"
    except OSError as problem:
        if problem.errno != errno.EOPNOTSUPP:
            raise
        return f"{problem.strerror}; use a kernel with that option"
    if ended and error == errno.ECONNRESET:
        with contextlib.suppress(OSError):
            if _YAMA.read_text(encoding="ascii").strip() != "0":  # a process may touch itself and its children alone
                return f"this process has no CAP_NET_ADMIN; {REMEDY}"
        return f"this process has no CAP_NET_ADMIN, and ends those of its own user's nodes alone; {REMEDY}"
    if not ended or error != errno.ECONNABORTED:
        return "the kernel did not end a connection that it was told to end; use another kernel"
    return ""
