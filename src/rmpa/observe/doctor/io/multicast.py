"""Sends and receives multicast packets on chosen interfaces: for ``rmpa doctor`` and ``rmpa multicast``."""

from __future__ import annotations

import secrets
import select
import socket
import struct
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from rmpa.core.errors import ConfigError, StartError
from rmpa.discovery import limits as discovery_limits
from rmpa.discovery.beacon import MAGIC, VERSION, BeaconKind
from rmpa.discovery.io.sockets import GroupMembership, open_receiver, receive
from rmpa.observe import limits
from rmpa.observe.doctor.network import MulticastEcho

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.discovery.io.interfaces import Interface

_PKTINFO: Final = struct.Struct("@i4s4s")
_IP_PKTINFO: Final = 8  # Linux's (linux/in.h); not in the socket module of every supported Python
_NO_DOMAIN: Final = 0xFFFF
"""Greater than every domain: agents ignore beacons of it without logging."""


@dataclass(frozen=True, slots=True)
class Packet:
    """A packet that was received.

    Args:
        data: Its payload.
        source: ``address:port`` of its sender.
        interface: The name of the interface that it came in on.
    """

    data: bytes
    source: str
    interface: str


class _Socket:
    """A socket that a ``with`` block closes."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._sock.close()


class GroupSender(_Socket):
    """A socket that sends to a group on an interface of choice; a context manager.

    Args:
        group: Its address.
        port: Its port.

    Raises:
        ConfigError: The address is not a multicast group's.
    """

    def __init__(self, group: str, port: int) -> None:
        _check_group(group)
        self._to = (group, port)
        super().__init__(socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC))
        self._sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, discovery_limits.MULTICAST_TTL)
        self._sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)

    def send(self, interface: Interface, data: bytes) -> str:
        """Send one packet; return why that failed, or an empty string."""
        source = interface.addresses[0].packed if interface.addresses else bytes(4)
        ancillary = [(socket.IPPROTO_IP, _IP_PKTINFO, _PKTINFO.pack(interface.index, source, bytes(4)))]
        try:
            self._sock.sendmsg([data], ancillary, 0, self._to)
        except OSError as error:
            return error.strerror or str(error)
        return ""


class GroupReceiver(_Socket):
    """A socket that receives the packets of a group on the interfaces where it joined; a context manager.

    Args:
        group: Its address.
        port: Its port, which is shared with agents and others.

    Raises:
        ConfigError: The address is not a multicast group's.
        StartError: Another program has the port and does not share it.
    """

    def __init__(self, group: str, port: int) -> None:
        _check_group(group)
        try:
            super().__init__(open_receiver(group, port))
        except OSError as error:
            problem = f"cannot be opened ({error.strerror})"
            raise StartError(f"UDP port {port}", problem, "`ss -ulnp` shows who has it") from None
        self._members = GroupMembership([self._sock], group)
        self._names: dict[int, str] = {}

    def join(self, interfaces: Iterable[Interface]) -> dict[str, str]:
        """Join the group on these interfaces; return why it failed, by the names of those where it did."""
        wanted = tuple(interfaces)
        self._names = {interface.index: interface.name for interface in wanted}
        refused = self._members.update(wanted)
        return {name: error.strerror or str(error) for name, error in refused.items()}

    def wait(self, timeout: float | None = None) -> Packet | None:
        """The next packet, or ``None`` after ``timeout`` seconds; without a time-out it waits for ever."""
        if not select.select([self._sock], [], [], None if timeout is None else max(0.0, timeout))[0]:
            return None
        try:
            data, (host, port), index = receive(self._sock)
        except BlockingIOError:
            return None  # the kernel dropped it: its checksum was wrong
        return Packet(data, f"{host}:{port}", self._names.get(index, f"interface {index}"))


def hear_ourselves(interfaces: Iterable[Interface], group: str, port: int) -> tuple[MulticastEcho, ...]:
    """Send one packet on each interface, and receive it there as an agent does.

    The packets are beacons of a domain that cannot exist, so agents ignore them.

    Raises:
        StartError: Another program has the port and does not share it.
    """
    wanted = tuple(interfaces)
    found: dict[str, MulticastEcho] = {}
    with GroupReceiver(group, port) as receiver, GroupSender(group, port) as sender:
        refused = receiver.join(wanted)
        sent: dict[bytes, tuple[Interface, float]] = {}
        for interface in wanted:
            token = struct.pack(">4sBBH", MAGIC, VERSION, BeaconKind.HEARTBEAT, _NO_DOMAIN) + secrets.token_bytes(16)
            problem = refused.get(interface.name) or sender.send(interface, token)
            found[interface.name] = MulticastEcho(interface.name, problem)
            if not problem:
                sent[token] = (interface, time.monotonic())
        until = time.monotonic() + limits.DOCTOR_HEAR
        while sent and (rest := until - time.monotonic()) > 0:
            packet = receiver.wait(rest)
            # If two interfaces share a network, the packet is received on the other one too.
            if packet is not None and packet.data in sent and sent[packet.data][0].name == packet.interface:
                interface, when = sent.pop(packet.data)
                found[interface.name] = MulticastEcho(interface.name, after=time.monotonic() - when)
    return tuple(found.values())


def _check_group(group: str) -> None:
    try:
        first = socket.inet_aton(group)[0]
    except OSError:
        first = 0
    if not 224 <= first <= 239 or group.count(".") != 3:  # RFC 5771
        raise ConfigError(
            "--group", f"{group!r} is not an IPv4 multicast group", "they are 224.0.0.0 to 239.255.255.255"
        )
