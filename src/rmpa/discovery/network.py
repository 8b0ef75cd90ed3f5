"""The network for discovery: interfaces and their changes, UDP sockets, and seeds, resolved again and again."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import errno
import logging
import random
import re
import socket
import struct
from dataclasses import dataclass, replace
from functools import partial
from ipaddress import IPv4Address, IPv4Interface
from typing import TYPE_CHECKING, Final

import psutil

from rmpa.core.limits import KIB
from rmpa.core.timers import Backoff
from rmpa.discovery import limits
from rmpa.discovery.beacon import KIND_AT, Address, BeaconKind
from rmpa.runtime.accept import in_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.core.statistics import Counters

_log = logging.getLogger(__name__)

# How often interfaces are read where the kernel does not report changes.
INTERFACE_LOOK: Final = 5.0

# Delay after a reported change of interfaces before they are read, because the kernel reports several at once.
_INTERFACE_SETTLE: Final = 0.2
# A seed's host name is looked up again this often: addresses change.
_SEED_RESOLVE_INTERVAL: Final = 60.0
# Delay before a failed look-up of a seed's name is repeated; it doubles each time (no name server yet).
_SEED_RETRY_FIRST: Final = 1.0
# The longest delay between two look-ups after failures.
_SEED_RETRY_MAX: Final = 30.0

_SO_ATTACH_FILTER: Final = 26  # asm-generic/socket.h; not in Python's socket module
_RTMGRP_LINK: Final = 0x1
_RTMGRP_IPV4_IFADDR: Final = 0x10
_LOOPBACK: Final = IPv4Address("127.0.0.1")
# Names of interfaces of containers and virtual machines.
CONTAINERS: Final = re.compile(r"(docker|br-|veth|virbr|lxc|lxd|cni|flannel|podman|cali)")


@dataclass(frozen=True, slots=True)
class Interface:
    """One network interface.

    Args:
        name: As in ``ip link``.
        networks: Its IPv4 addresses with their networks, in the kernel's order.
        index: The kernel's number of it.
        up: Whether it is up and has a carrier.
        multicast: Whether its flags say that it can carry multicast.
        loopback: Whether it never leaves this machine.
        used: Whether an agent started here would use it; see ``read_interfaces``.
    """

    name: str
    networks: tuple[IPv4Interface, ...] = ()
    index: int = 0
    up: bool = True
    multicast: bool = True
    loopback: bool = False
    used: bool = True

    @property
    def addresses(self) -> tuple[IPv4Address, ...]:
        """Its IPv4 addresses."""
        return tuple(dict.fromkeys(network.ip for network in self.networks))

    @property
    def usable(self) -> bool:
        """Whether beacons can be sent there; loopback carries multicast though its flags do not say so."""
        return self.up and bool(self.networks) and (self.multicast or self.loopback)

    def __str__(self) -> str:
        """``eth0 (10.0.0.1)``."""
        return f"{self.name} ({', '.join(map(str, self.addresses)) or 'no IPv4 address'})"


def list_interfaces() -> tuple[Interface, ...]:
    """All interfaces, in the order of their indices."""
    stats = psutil.net_if_stats()
    addresses = psutil.net_if_addrs()
    found = []
    for index, name in sorted(socket.if_nameindex()):
        if name not in stats:
            continue  # gone between the two looks
        flags = stats[name].flags.split(",")
        ipv4 = (
            IPv4Interface(f"{each.address}/{each.netmask or '255.255.255.255'}")
            for each in addresses.get(name, ())
            if each.family == socket.AF_INET
        )
        networks, up = tuple(dict.fromkeys(ipv4)), stats[name].isup
        one = Interface(name, networks, index, up, multicast="multicast" in flags, loopback="loopback" in flags)
        found.append(one)
    return tuple(found)


def choose(interfaces: Iterable[Interface], wanted: tuple[str, ...] = ()) -> tuple[Interface, ...]:
    """The usable interfaces among those that the user named; among all if none was named."""
    return tuple(i for i in interfaces if i.usable and (not wanted or i.name in wanted))


def read_interfaces(wanted: tuple[str, ...]) -> tuple[Interface, ...]:
    """All interfaces; ``wanted`` are the names that the settings give, none for all that can be used."""
    there = list_interfaces()
    used = choose(there, wanted)
    return tuple(replace(one, used=one in used) for one in there)


def unknown_names(interfaces: Iterable[Interface], wanted: tuple[str, ...]) -> str | None:
    """The error text about names in the settings that no interface has; ``None`` if all exist."""
    there = {i.name for i in interfaces}
    missing = [name for name in wanted if name not in there]
    if not missing:
        return None
    have = ", ".join(sorted(there)) or "none"
    return f"--interface {', '.join(missing)}: not here; there are {have}; it will be used if it comes"


def pick_address(interfaces: Iterable[Interface]) -> IPv4Address:
    """The address for this agent's GUID: the first that is not 127.x, or else 127.0.0.1."""
    addresses = [a for i in interfaces if i.up for a in i.addresses if not a.is_loopback]
    # A link-local address (169.254.x) only when nothing better is there: it changes from boot to boot.
    return min(addresses, key=lambda a: a.is_link_local, default=_LOOPBACK)


def further_addresses(interfaces: Iterable[Interface], guid_address: IPv4Address) -> tuple[IPv4Address, ...]:
    """The addresses besides the GUID's, best first, as many as a beacon carries; loopback is of no use to others."""
    addresses = [a for i in interfaces for a in i.addresses if not a.is_loopback and a != guid_address]
    return tuple(sorted(dict.fromkeys(addresses), key=lambda a: a.is_link_local))[: limits.BEACON_ADDRESSES_MAX]


def open_netlink() -> socket.socket | None:
    """A socket to which the kernel reports changes of interfaces (rtnetlink(7)); ``None`` where that is refused."""
    netlink = None
    try:
        netlink = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC, 0)
        netlink.bind((0, _RTMGRP_LINK | _RTMGRP_IPV4_IFADDR))
    except OSError as error:
        _log.info("= netlink is refused (%s); interfaces are read every %g s", error, INTERFACE_LOOK)
        if netlink is not None:
            netlink.close()
        return None
    return netlink


async def watch_interfaces(look: Callable[[], bool]) -> None:
    """Look at the interfaces now and after each change of them, ``_INTERFACE_SETTLE`` seconds later.

    Where the kernel reports no changes, the interfaces are looked at every ``INTERFACE_LOOK`` seconds.

    Args:
        look: Looks at them; returns whether that was possible. If not, it is called again after a while.
    """
    netlink = open_netlink()
    try:
        while True:
            if not look() or netlink is None:
                await asyncio.sleep(INTERFACE_LOOK)
                continue
            # The messages only mean that something changed; ENOBUFS means that some were lost, which is the same.
            with contextlib.suppress(OSError):
                await asyncio.get_running_loop().sock_recv(netlink, 64 * KIB)
            await asyncio.sleep(_INTERFACE_SETTLE)
            with contextlib.suppress(OSError):
                while netlink.recv(64 * KIB):
                    pass
    finally:
        if netlink is not None:
            netlink.close()


# Seeds. Addresses of other agents in the settings. Host names are looked up in threads, again and again.


def resolve_ipv4(host: str) -> list[str]:
    """The IPv4 addresses of a host name; blocks.

    Raises:
        OSError: The name cannot be resolved now.
    """
    found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)
    return list(dict.fromkeys(str(entry[4][0]) for entry in found))


async def follow_seed(
    host: str, resolve: Callable[[str], list[str]], on_addresses: Callable[[str, list[str]], None]
) -> None:
    """Look up the host name of a seed, again and again.

    Each look-up has a daemon thread: a name server that never answers must not delay the end.

    Args:
        host: The name.
        resolve: Looks it up; runs in a thread.
        on_addresses: Called in the loop with the name and the addresses that it has now.
    """
    backoff = Backoff(_SEED_RETRY_FIRST, _SEED_RETRY_MAX, random.random)
    failed = False
    while True:
        try:
            addresses = await in_thread(partial(resolve, host), f"resolve {host}")
        except (OSError, UnicodeError) as error:  # UnicodeError: a label that is empty or too long
            if not failed:
                _log.warning(
                    "! seed %s: the name has no address (%s); it is tried again [unresolved-name]", host, error
                )
            failed = True
            await asyncio.sleep(backoff.delay())
        else:
            failed = False
            backoff.reset()
            on_addresses(host, addresses)
            await asyncio.sleep(_SEED_RESOLVE_INTERVAL)


# The UDP sockets of discovery. The group is joined, and sent to, on each interface by its index.


_MREQN: Final = struct.Struct("@4s4si")
_PKTINFO: Final = struct.Struct("@i4s4s")
_ANY: Final = bytes(4)
# Not in the socket module of every supported Python; the values are Linux's (linux/in.h).
_IP_PKTINFO: Final = 8
_IP_MULTICAST_ALL: Final = 49
_SO_RCVBUFFORCE: Final = 33


def open_receiver(host: str, port: int, *, heartbeats: bool | None = None) -> socket.socket:
    """Open a socket that several agents of one machine may bind at once, and that receives only from joined groups.

    Args:
        host: The group, to receive its multicasts; an empty string: unicasts to this port.
        port: The domain's discovery port.
        heartbeats: Whether the kernel gives it the beacons of this kind alone, or all but them; ``None``: all.

    Raises:
        OSError: Another program has bound the port without SO_REUSEADDR, or the kernel takes no filter.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setsockopt(socket.IPPROTO_IP, _IP_PKTINFO, 1)
        enlarge_buffer(sock)
        # Without this, Linux also delivers the multicasts of groups that other programs of this machine joined.
        sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        if heartbeats is not None:
            memory = ctypes.create_string_buffer(_heartbeat_filter(passes=heartbeats))  # the kernel copies it
            program = struct.pack("@HP", len(memory) // 8, ctypes.addressof(memory))
            sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
        sock.bind((host, port))
    except OSError:
        sock.close()
        raise
    return sock


def _heartbeat_filter(*, passes: bool) -> bytes:
    """The program of a packet filter (socket(7), linux/filter.h) that passes heartbeats alone, or all but them."""
    kind = 8 + KIND_AT  # a filter sees the UDP header in front
    heartbeat, other = (0xFFFF, 0) if passes else (0, 0xFFFF)
    return b"".join(
        struct.pack("@HBBI", *instruction)
        for instruction in (  # code, instructions to skip if true, if false, operand
            (0x80, 0, 0, 0),  # the packet's length: a load behind the end would drop it, and nothing would count it
            (0x35, 0, 3, kind + 1),  # at least
            (0x30, 0, 0, kind),  # a byte
            (0x15, 0, 1, BeaconKind.HEARTBEAT),  # equal
            (0x06, 0, 0, heartbeat),  # the bytes that pass
            (0x06, 0, 0, other),
        )
    )


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


def join_group(
    sock: socket.socket, group: str, interfaces: Iterable[Interface], joined: set[int]
) -> dict[str, OSError]:
    """Join a group on these interfaces, and leave it on all others.

    Args:
        sock: From ``open_receiver``.
        group: The group's address.
        interfaces: Where to join.
        joined: The indices of the interfaces on which ``sock`` has joined; changed here.

    Returns:
        The errors by the name of the interface.
    """
    refused = {}
    wanted = {i.index: i.name for i in interfaces}
    for index in joined ^ wanted.keys():
        option = socket.IP_ADD_MEMBERSHIP if index in wanted else socket.IP_DROP_MEMBERSHIP
        joined ^= {index}
        try:
            sock.setsockopt(socket.IPPROTO_IP, option, _MREQN.pack(socket.inet_aton(group), _ANY, index))
        except OSError as error:
            # EADDRINUSE: joined already. An interface that is gone was left by the kernel.
            if index in wanted and error.errno != errno.EADDRINUSE:
                joined.discard(index)
                refused[wanted[index]] = error
    return refused


# Errors of an interface that is missing, down or without an address.
_NO_INTERFACE: Final = frozenset({errno.ENODEV, errno.ENXIO, errno.ENETDOWN, errno.ENETUNREACH, errno.EADDRNOTAVAIL})


def failure_code(error: OSError) -> str:
    """The code of a failure to join a group, or to send to it, on an interface."""
    return "no-interface" if error.errno in _NO_INTERFACE else "multicast-blocked"


@dataclass(eq=False)
class Sender:
    """Sends beacons through the mesh's UDP socket; a failure is logged once, and once more when it is over.

    Args:
        sock: Bound to the mesh's port; not closed here.
        group: Group and port of the multicasts.
        counters: Where failures are counted.
    """

    sock: socket.socket
    group: Address
    counters: Counters

    def __post_init__(self) -> None:
        self._failing: dict[str, int | None] = {}
        self.sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, limits.MULTICAST_TTL)
        self.sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)

    def multicast(self, data: bytes, interfaces: Iterable[Interface]) -> None:
        """Send to the group on each interface."""
        for interface in interfaces:
            name = interface.name
            # By default, Linux sends multicasts on loopback with a source address of another interface, because
            # loopback's own address has only host scope.
            source = interface.addresses[0].packed if interface.loopback and interface.addresses else _ANY
            ancillary = [(socket.IPPROTO_IP, _IP_PKTINFO, _PKTINFO.pack(interface.index, source, _ANY))]
            try:
                self.sock.sendmsg([data], ancillary, 0, self.group)
            except BlockingIOError:
                self.counters.add("beacon.send_full")
            except OSError as error:
                self.counters.add("beacon.send_failed")
                if self._failing.get(name) != error.errno:
                    self._failing[name] = error.errno
                    text = "! %s: beacons cannot be sent (%s); tried again with each beacon [%s]"
                    _log.warning(text, name, error.strerror, failure_code(error))
            else:
                self.counters.add("beacon.out_multicast")
                if self._failing.pop(name, None) is not None:
                    _log.info("= %s: works again", name)

    def unicast(self, data: bytes, address: Address) -> None:
        """Send to one address; a failure is only counted: the next packet tries again."""
        try:
            self.sock.sendto(data, address)
        except (OSError, OverflowError) as error:
            self.counters.add("beacon.send_failed")
            _log.debug("> %s:%d: %s", *address, error)
        else:
            self.counters.add("beacon.out_unicast")
