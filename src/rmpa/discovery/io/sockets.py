"""The UDP sockets of discovery. The group is joined, and sent to, on each interface by its index."""

from __future__ import annotations

import errno
import logging
import socket
import struct
from typing import TYPE_CHECKING, Final

from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.core.counters import Counters
    from rmpa.discovery.beacon import Address
    from rmpa.discovery.io.interfaces import Interface

_log = logging.getLogger(__name__)

_MREQN: Final = struct.Struct("@4s4si")
_PKTINFO: Final = struct.Struct("@i4s4s")
_ANY: Final = bytes(4)
# Not in the socket module of every supported Python; the values are Linux's (linux/in.h).
_IP_PKTINFO: Final = 8
_IP_MULTICAST_ALL: Final = 49
_SO_RCVBUFFORCE: Final = 33


def open_receiver(host: str, port: int) -> socket.socket:
    """Open a socket that several agents of one machine may bind at once, and that receives only from joined groups.

    Args:
        host: The group, to receive its multicasts; an empty string: unicasts to this port.
        port: The domain's discovery port.

    Raises:
        OSError: Another program has bound the port without SO_REUSEADDR.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setsockopt(socket.IPPROTO_IP, _IP_PKTINFO, 1)
        enlarge_buffer(sock)
        # Without this, Linux also delivers the multicasts of groups that other programs of this machine joined.
        sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        sock.bind((host, port))
    except OSError:
        sock.close()
        raise
    return sock


def enlarge_buffer(sock: socket.socket) -> int:
    """Ask the kernel for room for the beacons of a large mesh; return the bytes that it grants.

    ``net.core.rmem_max`` bounds it, except for programs with CAP_NET_ADMIN.
    """
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, limits.RECEIVE_BUFFER_BYTES)
    except OSError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, limits.RECEIVE_BUFFER_BYTES)
    return sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def receive(sock: socket.socket) -> tuple[bytes, Address, int]:
    """One packet, where it came from, and the index of the interface (0 if unknown).

    One byte more than the longest beacon is read, so that a packet that is too long is recognised.

    Raises:
        OSError: Nothing waits, or the socket is broken.
    """
    data, ancillary, _, source = sock.recvmsg(limits.BEACON_MAX_BYTES + 1, socket.CMSG_SPACE(_PKTINFO.size))
    index = 0
    for level, kind, value in ancillary:
        if level == socket.IPPROTO_IP and kind == _IP_PKTINFO and len(value) >= _PKTINFO.size:
            index = _PKTINFO.unpack_from(value)[0]
    return data, (source[0], source[1]), index


class GroupMembership:
    """The interfaces on which a receiving socket has joined the group.

    Args:
        sock: From ``open_receiver``.
        group: The group's address.
    """

    def __init__(self, sock: socket.socket, group: str) -> None:
        self._sock = sock
        self._group = socket.inet_aton(group)
        self._joined: set[int] = set()

    def update(self, interfaces: Iterable[Interface]) -> dict[str, OSError]:
        """Join on these interfaces and leave all others; return the errors by the name of the interface."""
        refused = {}
        wanted = {i.index: i for i in interfaces}
        for index in self._joined - wanted.keys():
            try:
                self._change(socket.IP_DROP_MEMBERSHIP, index)
            except OSError as error:
                _log.debug("= interface %d was left by the kernel already: %s", index, error)
        refused_indices = set()
        for index in sorted(wanted.keys() - self._joined):
            try:
                self._change(socket.IP_ADD_MEMBERSHIP, index)
            except OSError as error:
                if error.errno != errno.EADDRINUSE:  # joined already
                    refused[wanted[index].name] = error
                    refused_indices.add(index)
        self._joined = wanted.keys() - refused_indices
        return refused

    def _change(self, option: int, index: int) -> None:
        self._sock.setsockopt(socket.IPPROTO_IP, option, _MREQN.pack(self._group, _ANY, index))


class Sender:
    """Sends beacons through the mesh's UDP socket; a failure is logged once, and once more when it is over.

    Args:
        sock: Bound to the mesh's port; not closed here.
        group: Group and port of the multicasts.
        counters: Where failures are counted.
    """

    def __init__(self, sock: socket.socket, group: Address, counters: Counters) -> None:
        self._sock = sock
        self._group = group
        self._counters = counters
        self._failing: dict[str, int | None] = {}
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, limits.MULTICAST_TTL)
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)

    def multicast(self, data: bytes, interfaces: Iterable[Interface]) -> int:
        """Send to the group on each interface; return the number of interfaces without an error."""
        sent = 0
        for interface in interfaces:
            # By default, Linux sends multicasts on loopback with a source address of another interface, because
            # loopback's own address has only host scope.
            source = interface.addresses[0].packed if interface.loopback and interface.addresses else _ANY
            ancillary = [(socket.IPPROTO_IP, _IP_PKTINFO, _PKTINFO.pack(interface.index, source, _ANY))]
            try:
                self._sock.sendmsg([data], ancillary, 0, self._group)
            except (BlockingIOError, InterruptedError):
                self._counters.add("beacon.send_full")
            except OSError as error:
                self.failed(interface.name, error, "beacons cannot be sent there")
            else:
                sent += 1
                self.worked(interface.name)
        self._counters.add("beacon.out_multicast", sent)
        return sent

    def unicast(self, data: bytes, address: Address, *, count: str = "beacon.out_unicast") -> None:
        """Send to one address; a failure is only counted: the next packet tries again."""
        try:
            self._sock.sendto(data, address)
        except (OSError, OverflowError) as error:
            self._counters.add("beacon.send_failed")
            _log.debug("> %s:%d: %s", *address, error)
        else:
            self._counters.add(count)

    def failed(self, name: str, error: OSError, what: str) -> None:
        """Say once that an interface refuses."""
        self._counters.add("beacon.send_failed")
        if self._failing.get(name) != error.errno:
            self._failing[name] = error.errno
            _log.warning("! %s: %s (%s); tried again with each beacon", name, what, error.strerror)

    def worked(self, name: str) -> None:
        """Say once that an interface that refused works again."""
        if self._failing.pop(name, None) is not None:
            _log.info("= %s: works again", name)
