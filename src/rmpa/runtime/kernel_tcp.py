"""The TCP sockets of this network namespace, of all processes: where they listen, their connections, and their end.

The kernel is asked over netlink, and makes each answer within the system call that asks for it. So each function may
be called in the event loop: none waits, and each says what it costs. ``/proc/net/tcp`` has most of it too, but the
kernel walks its whole socket table for that: some 10 ms on an ordinary machine, however few sockets there are, where
a dump takes 0.1 ms.

Sources: sock_diag(7), netlink(7), ``linux/inet_diag.h``. Netlink integers have the machine's byte order; ports and
addresses have the network's. A connection over IPv6 whose addresses are IPv4 (v4-mapped, as those to a socket that
listens at "::") has IPv4 addresses here.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import itertools
import os
import socket
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from rmpa.runtime import limits

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

# By their number in ``linux/tcp_states.h``.
_STATES: Final = {
    1: "ESTABLISHED",
    2: "SYN_SENT",
    4: "FIN_WAIT1",
    5: "FIN_WAIT2",
    8: "CLOSE_WAIT",
    9: "LAST_ACK",
    10: "LISTEN",
    11: "CLOSING",
}
_LISTEN: Final = 1 << 10
_CONNECTED: Final = sum(1 << number for number in _STATES) - _LISTEN
_TCP_PORTS: Final = range(1, 1 << 16)
_GONE: Final = frozenset({errno.ENOENT, errno.ESTALE})
# ``EINVAL`` comes from kernels before 4.5, which do not know the message.
_UNSUPPORTED: Final = frozenset({errno.EOPNOTSUPP, errno.EINVAL})
_libc: Final = ctypes.CDLL(None, use_errno=True)
# The number of pidfd_getfd(2), the same on all machines, since Linux 5.6; Python has no function for it.
_PIDFD_GETFD: Final = 438
# A socket address of the family AF_UNSPEC, which ends a connection (connect(2)).
_DISCONNECT: Final = bytes(16)
_YAMA: Final = Path("/proc/sys/kernel/yama/ptrace_scope")
# What gives an agent the right to end connections.
REMEDY: Final = (
    "run the agent with CAP_NET_ADMIN: `AmbientCapabilities=CAP_NET_ADMIN` in its systemd unit, "
    "`--cap-add NET_ADMIN` for Docker, or `setcap cap_net_admin+ep PYTHON`"
)

_NETLINK_SOCK_DIAG: Final = 4
# Message type ``SOCK_DIAG_BY_FAMILY``: a request for sockets, and each of its answers.
_BY_FAMILY: Final = 20
# Message type ``SOCK_DESTROY``, since Linux 4.5.
_DESTROY: Final = 21
_NOOP, _ERROR, _DONE = 1, 2, 3
_REQUEST, _ACK, _DUMP = 0x1, 0x4, 0x300
# Flag ``NLM_F_DUMP_INTR``: the table changed during the dump, which may lack sockets.
_INTERRUPTED: Final = 0x10
_HEADER: Final = struct.Struct("=IHHII")
_ERRNO: Final = struct.Struct("=i")
# ``MAX_ERRNO`` of the kernel.
_ERRNO_MAX: Final = 4095
_QUERY: Final = struct.Struct("=BBBBI")
# ``struct inet_diag_sockid``: ports and addresses, and in the machine's byte order the interface and the cookie.
_SOCKET_ID: Final = struct.Struct("!HH16s16s12s")
# ``struct inet_diag_msg``: family, state, the socket's id, its owner and inode; attributes may follow.
_FOUND: Final = struct.Struct(f"=BBxx{_SOCKET_ID.size}s12xII")
_ANY_SOCKET: Final = bytes(4) + b"\xff" * 8
_MAPPED: Final = bytes(10) + b"\xff\xff"
_ATTRIBUTE: Final = struct.Struct("=HH")
_BYTECODE: Final = 1
_OPERATION: Final = struct.Struct("=BBH")
_DESTINATION_IS: Final = 8
_CONDITION: Final = struct.Struct("=BBxxi")
_sequences: Final = itertools.count(1)


@dataclass(frozen=True, slots=True)
class TcpSocket:
    """One TCP socket.

    Args:
        local: Its own address and port; ``0.0.0.0`` and ``::`` for any address.
        remote: The address and port of the other end.
        state: Its name in RFC 9293 without hyphens: ``LISTEN``, ``ESTABLISHED``, ``SYN_SENT``, ``FIN_WAIT1``,
            ``FIN_WAIT2``, ``CLOSING``, ``CLOSE_WAIT``, ``LAST_ACK``.
        family: ``AF_INET`` or ``AF_INET6``; the latter with IPv4 addresses too.
        uid: User id of its owner.
        inode: As in the links of ``/proc/PID/fd``; 0 where no process holds the socket any more.
        id: The kernel's name of it (``struct inet_diag_sockid``); no other socket ever has the same.
    """

    local: tuple[str, int]
    remote: tuple[str, int]
    state: str
    family: int
    uid: int
    inode: int
    id: bytes

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """Read the body of an answer, as ``read_answer`` returns it."""
        family, state, name, uid, inode = _FOUND.unpack_from(body)
        local_port, remote_port, source, destination, _ = _SOCKET_ID.unpack(name)
        local, remote = (_text(family, source), local_port), (_text(family, destination), remote_port)
        return cls(local, remote, _STATES.get(state, ""), family, uid, inode, name)


def ask_listening_ports() -> set[int] | None:
    """TCP ports in state LISTEN; ``None`` where the kernel does not report them. It takes some 0.1 ms."""
    found = _dump(_LISTEN)
    return None if found is None else {of.local[1] for of in found}


def listening_addresses(port: int) -> frozenset[str] | None:
    """The local addresses of the sockets in state LISTEN at a port, in some 0.1 ms.

    Returns:
        ``"0.0.0.0"`` and ``"::"`` for any address (``"::"`` may be for IPv6 alone), ``"127.0.0.1"``…; empty where
        nothing listens; ``None`` where the kernel does not report it.
    """
    if port not in _TCP_PORTS:
        return frozenset()
    found = _dump(_LISTEN, port)
    return None if found is None else frozenset(of.local[0] for of in found)


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
) -> list[TcpSocket] | None:
    """The connections of all processes, of one local port, or to one remote address.

    Those that connect or close are among them. The kernel selects them. With 2,000 connections of others here this
    takes 0.7 ms (0.4 ms with none), and 10 microseconds more for each one that is returned.

    Args:
        local_port: Only those with this local port.
        remote: Only those to this address (IPv4 or IPv6, no name), at this port or, with ``None``, at any.

    Returns:
        The connections; one that opens or closes meanwhile may be missing. ``None`` where the kernel does not report
        them.

    Raises:
        ValueError: The address is none.
    """
    address, port = remote or (None, None)
    if any(number is not None and number not in _TCP_PORTS for number in (local_port, port)):
        return []
    wanted = b"" if address is None else _packed(address)
    found = _dump(_CONNECTED, local_port or 0, port or 0, wanted)
    return None if found is None else [of for of in found if of.state]


def _dump(states: int, local_port: int = 0, remote_port: int = 0, remote: bytes = b"") -> list[TcpSocket] | None:
    try:
        with open_netlink() as kernel:
            return [
                TcpSocket.parse(body)
                for family in (socket.AF_INET, socket.AF_INET6)
                for body in dump(kernel, dump_query(family, states, local_port, remote_port, remote))
            ]
    except (OSError, ValueError):
        return None


def _text(family: int, address: bytes) -> str:
    if family == socket.AF_INET:
        return socket.inet_ntop(socket.AF_INET, address[:4])
    if address.startswith(_MAPPED):
        return socket.inet_ntop(socket.AF_INET, address[len(_MAPPED) :])
    return socket.inet_ntop(socket.AF_INET6, address)


def _packed(address: str) -> bytes:
    try:
        return socket.inet_pton(socket.AF_INET6 if ":" in address else socket.AF_INET, address)
    except OSError:
        raise ValueError(f"{address!r} is no IP address") from None


def end_connections(found: Iterable[TcpSocket]) -> int:
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
    with open_netlink() as kernel:
        for connection in found:
            try:
                destroy(kernel, connection)
            except PermissionError:
                done = _disconnect(connection)
                ended, refused = ended + done, refused + (not done)
            except OSError as error:
                if error.errno in _UNSUPPORTED:
                    text = "this kernel cannot end connections (CONFIG_INET_DIAG_DESTROY)"
                    raise OSError(errno.EOPNOTSUPP, text) from error
                if error.errno not in _GONE:
                    raise
            else:
                ended += 1
    if refused:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
    return ended


def _disconnect(connection: TcpSocket) -> bool:
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


def _disconnect_copy(process: int, descriptor: int, connection: TcpSocket) -> bool:
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


@contextlib.contextmanager
def open_netlink() -> Iterator[socket.socket]:
    """A netlink socket for ``dump`` and ``destroy``.

    Raises:
        OSError: There is no such netlink here (``CONFIG_INET_DIAG``, a sandbox), or no file descriptor is left.
    """
    kind = socket.SOCK_RAW | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
    with socket.socket(socket.AF_NETLINK, kind, _NETLINK_SOCK_DIAG) as kernel:
        kernel.connect((0, 0))  # so that the kernel alone can send to this socket
        yield kernel


def dump(kernel: socket.socket, query: bytes) -> list[bytes]:
    """The bodies of all sockets that a query asks for; one that opens or closes meanwhile may be missing.

    Raises:
        ValueError: The kernel's answer cannot be read.
        OSError: The kernel refuses, or each of ``limits.SOCK_DIAG_DUMPS`` dumps was interrupted.
    """
    for _ in range(limits.SOCK_DIAG_DUMPS - 1):
        with contextlib.suppress(InterruptedError):
            return _ask(kernel, _BY_FAMILY, _REQUEST | _DUMP, query)
        # The rest of an interrupted dump is read, during which the kernel would refuse another one.
        with contextlib.suppress(BlockingIOError):
            while kernel.recv(limits.SOCK_DIAG_BUFFER):
                pass
    return _ask(kernel, _BY_FAMILY, _REQUEST | _DUMP, query)


def destroy(kernel: socket.socket, found: TcpSocket) -> None:
    """End a socket: its owner's calls fail with ``ECONNABORTED``, its peer gets a reset.

    Raises:
        ValueError: The kernel's answer cannot be read.
        OSError: The kernel refuses.
    """
    _ask(kernel, _DESTROY, _REQUEST | _ACK, destroy_query(found))


def _ask(kernel: socket.socket, kind: int, flags: int, query: bytes) -> list[bytes]:
    sequence = next(_sequences) & 0xFFFFFFFF
    kernel.send(_HEADER.pack(_HEADER.size + len(query), kind, flags, sequence, 0) + query)
    found: list[bytes] = []
    more = True
    while more:
        data, _, truncated, _ = kernel.recvmsg(limits.SOCK_DIAG_BUFFER)
        if truncated & socket.MSG_TRUNC:
            raise ValueError(f"an answer of more than {limits.SOCK_DIAG_BUFFER} bytes")
        more = read_answer(data, found, sequence)
    return found


def dump_query(family: int, states: int, local_port: int = 0, remote_port: int = 0, remote: bytes = b"") -> bytes:
    """What asks for all TCP sockets of a family (``struct inet_diag_req_v2``).

    Args:
        family: ``AF_INET``, or ``AF_INET6``, whose sockets may have IPv4 addresses (v4-mapped).
        states: A bit for each state.
        local_port: Only sockets with this local port; 0 for any.
        remote_port: Only sockets with this remote port; 0 for any.
        remote: Only sockets with this remote address, of 4 or 16 bytes; one of 4 bytes fits v4-mapped ones too.
    """
    query = _QUERY.pack(family, socket.IPPROTO_TCP, 0, 0, states)
    query += _SOCKET_ID.pack(local_port, remote_port, b"", b"", _ANY_SOCKET)
    if not remote:
        return query
    # The attribute ``INET_DIAG_REQ_BYTECODE``: a program of one instruction that rejects other remote addresses.
    kind = socket.AF_INET if len(remote) == 4 else socket.AF_INET6
    condition = _CONDITION.pack(kind, 8 * len(remote), -1) + remote
    size = _OPERATION.size + len(condition)
    # A jump to the end accepts a socket; one beyond it, by one instruction, rejects it.
    program = _OPERATION.pack(_DESTINATION_IS, size, size + _OPERATION.size) + condition
    return query + _ATTRIBUTE.pack(_ATTRIBUTE.size + size, _BYTECODE) + program


def destroy_query(found: TcpSocket) -> bytes:
    """What asks for the end of a socket."""
    return _QUERY.pack(found.family, socket.IPPROTO_TCP, 0, 0, 0) + found.id


def read_answer(data: bytes, found: list[bytes], sequence: int) -> bool:
    """Read one part of the answer to a request; return whether more parts follow.

    Args:
        data: The part.
        found: The bodies of sockets are appended to it.
        sequence: The number of the request.

    Raises:
        ValueError: The bytes are not an answer to such a request, or end too early.
        InterruptedError: The kernel says that sockets may be missing.
        OSError: The kernel refuses the request.
    """
    at = 0
    while at < len(data):
        if len(data) - at < _HEADER.size:
            raise ValueError(f"{len(data) - at} bytes where a netlink header begins")
        length, kind, flags, number, _ = _HEADER.unpack_from(data, at)
        body = data[at + _HEADER.size : at + length]
        if len(body) != length - _HEADER.size:
            raise ValueError(f"a netlink message of {length} bytes where {len(data) - at} are left")
        if number != sequence:
            raise ValueError(f"an answer to request {number}, not {sequence}")
        if flags & _INTERRUPTED:
            raise InterruptedError(errno.EINTR, "the kernel's table of sockets changed while it was read")
        if kind in (_DONE, _ERROR):
            if kind == _ERROR or body:  # some kernels leave out the status of a whole dump
                _check_status(body)
            return False
        if kind == _BY_FAMILY and len(body) >= _FOUND.size:
            found.append(body[: _FOUND.size])
        elif kind != _NOOP:
            raise ValueError(f"an answer of kind {kind} and {len(body)} bytes")
        at += length + 3 & ~3
    return True


def _check_status(body: bytes) -> None:
    if len(body) < _ERRNO.size:
        raise ValueError(f"an error of {len(body)} bytes")
    number: int = _ERRNO.unpack_from(body)[0]
    if not -_ERRNO_MAX <= number <= 0:
        raise ValueError(f"an error with the number {number}")
    if number:
        raise OSError(-number, os.strerror(-number))
