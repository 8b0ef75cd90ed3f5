"""The kernel's TCP sockets over netlink: requests and answers as bytes, and the socket that carries them.

Sources: sock_diag(7), netlink(7), ``linux/inet_diag.h``. Netlink integers have the machine's byte order; ports and
addresses have the network's. ``/proc/net/tcp`` has most of it too, but the kernel walks its whole socket table for
that: some 10 ms on an ordinary machine, however few sockets there are, where a dump takes 0.1 ms.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from rmpa.runtime import limits

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import TracebackType

_NETLINK_SOCK_DIAG: Final = 4
BY_FAMILY: Final = 20
"""Message type ``SOCK_DIAG_BY_FAMILY``: a request for sockets, and each of its answers."""
DESTROY: Final = 21
"""Message type ``SOCK_DESTROY``, since Linux 4.5."""
_NOOP, _ERROR, _DONE = 1, 2, 3
_REQUEST, _ACK, _DUMP = 0x1, 0x4, 0x300
_INTERRUPTED: Final = 0x10
"""Flag ``NLM_F_DUMP_INTR``: the table changed during the dump, which may lack sockets."""
_HEADER: Final = struct.Struct("=IHHII")
_ERRNO: Final = struct.Struct("=i")
_ERRNO_MAX: Final = 4095
"""``MAX_ERRNO`` of the kernel."""
_QUERY: Final = struct.Struct("=BBBBI")
_FOUND: Final = struct.Struct("=BBBB")
_PORTS: Final = struct.Struct("!HH")
_PLACE: Final = struct.Struct("=III")
_OWNER: Final = struct.Struct("=IIIII")
_ADDRESS: Final = 16
_SOURCE_AT: Final = _FOUND.size + _PORTS.size
_DESTINATION_AT: Final = _SOURCE_AT + _ADDRESS
_PLACE_AT: Final = _DESTINATION_AT + _ADDRESS
_OWNER_AT: Final = _PLACE_AT + _PLACE.size
FOUND_SIZE: Final = _OWNER_AT + _OWNER.size
"""Bytes of ``struct inet_diag_msg``; attributes may follow."""
_ATTRIBUTE: Final = struct.Struct("=HH")
_BYTECODE: Final = 1
_OPERATION: Final = struct.Struct("=BBH")
_DESTINATION_IS: Final = 8
_CONDITION: Final = struct.Struct("=BBxxi")
_NO_COOKIE: Final = 0xFFFFFFFF
_NO_ADDRESS: Final = bytes(_ADDRESS)


class MalformedAnswer(ValueError):  # noqa: N818 - the name says what happened
    """The bytes are not an answer to the request."""


class InterruptedDump(OSError):  # noqa: N818 - the name says what happened
    """The kernel marked a dump as interrupted: sockets may be missing. It may be asked again."""


@dataclass(frozen=True, slots=True)
class InetSocket:
    """One socket of an answer (``struct inet_diag_msg``).

    Args:
        family: ``AF_INET`` or ``AF_INET6``.
        state: Its number in ``linux/tcp_states.h``.
        source: The local address, 16 bytes; those of IPv4 have 4 bytes and zeros.
        source_port: The local port.
        destination: The remote address, like ``source``.
        destination_port: The remote port.
        interface: Index of the interface to which the socket is bound, or 0.
        cookie: The kernel's number of the socket, in two words; no other socket ever has the same.
        uid: User id of the owner.
        inode: As in the links of ``/proc/PID/fd``; 0 where no process holds the socket any more.
    """

    family: int
    state: int
    source: bytes
    source_port: int
    destination: bytes
    destination_port: int
    interface: int
    cookie: tuple[int, int]
    uid: int = 0
    inode: int = 0

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """Read the body of an answer, as ``read_dump`` returns it."""
        family, state, _, _ = _FOUND.unpack_from(body)
        source_port, destination_port = _PORTS.unpack_from(body, _FOUND.size)
        interface, low, high = _PLACE.unpack_from(body, _PLACE_AT)
        *_, uid, inode = _OWNER.unpack_from(body, _OWNER_AT)
        return cls(
            family,
            state,
            body[_SOURCE_AT:_DESTINATION_AT],
            source_port,
            body[_DESTINATION_AT:_PLACE_AT],
            destination_port,
            interface,
            (low, high),
            uid,
            inode,
        )


# --- codec ------------------------------------------------------------------------------------------------------


def dump_request(
    family: int,
    states: int,
    *,
    source_port: int = 0,
    destination_port: int = 0,
    destination: bytes = b"",
    sequence: int = 0,
) -> bytes:
    """A request for all TCP sockets of a family.

    Args:
        family: ``AF_INET``, or ``AF_INET6``, whose sockets may have IPv4 addresses (v4-mapped).
        states: A bit for each state.
        source_port: Only sockets with this local port; 0 for any.
        destination_port: Only sockets with this remote port; 0 for any.
        destination: Only sockets with this remote address, of 4 or 16 bytes; one of 4 bytes fits v4-mapped ones too.
        sequence: The number that the answers repeat.
    """
    none = (_NO_ADDRESS, _NO_ADDRESS, 0, (_NO_COOKIE,) * 2)
    body = _query(family, states, source_port, destination_port, *none)
    return _message(BY_FAMILY, _REQUEST | _DUMP, sequence, body + (_filter(destination) if destination else b""))


def destroy_request(found: InetSocket, sequence: int = 0) -> bytes:
    """A request to end a socket: its owner's calls fail with ``ECONNABORTED``, its peer gets a reset."""
    at = (found.source_port, found.destination_port, found.source, found.destination, found.interface, found.cookie)
    return _message(DESTROY, _REQUEST | _ACK, sequence, _query(found.family, 0, *at))


def read_dump(data: bytes, found: list[bytes], sequence: int = 0) -> bool:
    """Append the bodies of one part of a dump; return whether more parts follow.

    Args:
        data: The part.
        found: The bodies, of ``FOUND_SIZE`` bytes each.
        sequence: The number of the request.

    Raises:
        MalformedAnswer: The bytes are not an answer to such a request, or end too early.
        InterruptedDump: The kernel says that sockets may be missing.
        OSError: The kernel refuses the request.
    """
    for kind, flags, start, end in _split(data, sequence):
        if flags & _INTERRUPTED:
            raise InterruptedDump(errno.EINTR, "the kernel's table of sockets changed while it was read")
        if kind == _DONE:
            # The status of the whole dump; some kernels leave it out.
            _raise(_status(data, start, end) if end > start else 0)
            return False
        if kind == _ERROR:
            _raise(_status(data, start, end))
            raise MalformedAnswer("a dump was answered by a mere acknowledgement")
        if kind != BY_FAMILY or end - start < FOUND_SIZE:
            raise MalformedAnswer(f"an answer of kind {kind} and {end - start} bytes")
        found.append(data[start : start + FOUND_SIZE])
    return True


def read_status(data: bytes, sequence: int = 0) -> int:
    """The result of a request that is no dump: 0, or the number of an error.

    Raises:
        MalformedAnswer: The bytes are not such an answer.
    """
    for kind, _, start, end in _split(data, sequence):
        if kind == _ERROR:
            return -_status(data, start, end)
        raise MalformedAnswer(f"an answer of kind {kind} and {end - start} bytes")
    raise MalformedAnswer("an answer without a message")


def _split(data: bytes, sequence: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield ``(kind, flags, start, end)`` for each message: the offsets are those of its body."""
    at = 0
    while at < len(data):
        if len(data) - at < _HEADER.size:
            raise MalformedAnswer(f"{len(data) - at} bytes where a netlink header begins")
        length, kind, flags, number, _ = _HEADER.unpack_from(data, at)
        if not _HEADER.size <= length <= len(data) - at:
            raise MalformedAnswer(f"a netlink message of {length} bytes where {len(data) - at} are left")
        if number != sequence:
            raise MalformedAnswer(f"an answer to request {number}, not {sequence}")
        if kind != _NOOP:
            yield kind, flags, at + _HEADER.size, at + length
        at += length + 3 & ~3


def _status(data: bytes, start: int, end: int) -> int:
    if end - start < _ERRNO.size:
        raise MalformedAnswer(f"an error of {end - start} bytes")
    number: int = _ERRNO.unpack_from(data, start)[0]
    if not -_ERRNO_MAX <= number <= 0:
        raise MalformedAnswer(f"an error with the number {number}")
    return number


def _raise(number: int) -> None:
    if number < 0:
        raise OSError(-number, os.strerror(-number))


def _query(
    family: int,
    states: int,
    source_port: int,
    destination_port: int,
    source: bytes,
    destination: bytes,
    interface: int,
    cookie: tuple[int, ...],
) -> bytes:
    """``struct inet_diag_req_v2``."""
    ports = _PORTS.pack(source_port, destination_port)
    place = _PLACE.pack(interface, *cookie)
    return _QUERY.pack(family, socket.IPPROTO_TCP, 0, 0, states) + ports + source + destination + place


def _filter(destination: bytes) -> bytes:
    """The attribute ``INET_DIAG_REQ_BYTECODE``: a program of one instruction that rejects other remote addresses."""
    family = socket.AF_INET if len(destination) == 4 else socket.AF_INET6
    condition = _CONDITION.pack(family, 8 * len(destination), -1) + destination
    size = _OPERATION.size + len(condition)
    # A jump to the end accepts a socket; one beyond it, by one instruction, rejects it.
    program = _OPERATION.pack(_DESTINATION_IS, size, size + _OPERATION.size) + condition
    return _ATTRIBUTE.pack(_ATTRIBUTE.size + size, _BYTECODE) + program


def _message(kind: int, flags: int, sequence: int, body: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(body), kind, flags, sequence, 0) + body


# --- socket -----------------------------------------------------------------------------------------------------


class SockDiag:
    """A netlink socket to the kernel, as a context manager. Not thread-safe.

    No call waits: the kernel makes each answer within the system call that asks for it.

    Raises:
        OSError: There is no such netlink here (``CONFIG_INET_DIAG``, a sandbox), or no file descriptor is left.
    """

    def __init__(self) -> None:
        kind = socket.SOCK_RAW | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
        self._sock = socket.socket(socket.AF_NETLINK, kind, _NETLINK_SOCK_DIAG)
        self._sequence = 0
        try:
            self._sock.connect((0, 0))  # so that the kernel alone can send to this socket
        except OSError:
            self._sock.close()
            raise

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        """Close the socket."""
        self._sock.close()

    def dump(
        self,
        family: int,
        states: int,
        *,
        source_port: int = 0,
        destination_port: int = 0,
        destination: bytes = b"",
    ) -> list[bytes]:
        """The bodies of all sockets that ``dump_request`` with these arguments asks for; see ``InetSocket.parse``.

        A socket that opens or closes meanwhile may be missing.

        Raises:
            MalformedAnswer: The kernel's answer cannot be read.
            OSError: The kernel refuses, or each of ``limits.SOCK_DIAG_DUMPS`` dumps was interrupted.
        """
        for attempt in range(limits.SOCK_DIAG_DUMPS):
            try:
                self._sequence += 1
                return self._dump(
                    dump_request(
                        family,
                        states,
                        source_port=source_port,
                        destination_port=destination_port,
                        destination=destination,
                        sequence=self._sequence,
                    )
                )
            except InterruptedDump:
                self._drain()
                if attempt == limits.SOCK_DIAG_DUMPS - 1:
                    raise
        raise AssertionError("no dump was tried")  # pragma: no cover - the limit is above 0

    def destroy(self, found: InetSocket) -> int:
        """End a socket; return 0, or the number of an error.

        Raises:
            MalformedAnswer: The kernel's answer cannot be read.
            OSError: Netlink itself failed.
        """
        self._sequence += 1
        self._sock.send(destroy_request(found, self._sequence))
        return read_status(self._receive(), self._sequence)

    def _dump(self, request: bytes) -> list[bytes]:
        self._sock.send(request)
        found: list[bytes] = []
        while read_dump(self._receive(), found, self._sequence):
            pass
        return found

    def _receive(self) -> bytes:
        data, _, flags, _ = self._sock.recvmsg(limits.SOCK_DIAG_BUFFER)
        if flags & socket.MSG_TRUNC:
            raise MalformedAnswer(f"an answer of more than {limits.SOCK_DIAG_BUFFER} bytes")
        return data

    def _drain(self) -> None:
        """Read the rest of an interrupted dump, during which the kernel would refuse another one."""
        try:
            while self._sock.recv(limits.SOCK_DIAG_BUFFER):
                pass
        except BlockingIOError:
            pass
