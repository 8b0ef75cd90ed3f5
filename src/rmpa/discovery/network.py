"""The network for discovery: interfaces, UDP sockets, and seeds that are resolved again and again.

The machine's network interfaces: which there are, which we use, and when they change.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import random
import socket
import struct
import threading
from dataclasses import dataclass
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING, Final

import psutil

from rmpa.core.counters import Backoff
from rmpa.core.limits import KIB
from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.config.values import HostPort
    from rmpa.core.counters import Counters
    from rmpa.discovery.beacon import Address

_log = logging.getLogger(__name__)

_RTMGRP_LINK: Final = 0x1
_RTMGRP_IPV4_IFADDR: Final = 0x10
_LOOPBACK: Final = IPv4Address("127.0.0.1")


@dataclass(frozen=True, slots=True)
class Interface:
    """One network interface.

    Args:
        name: As in ``ip link``.
        index: The kernel's number of it.
        addresses: Its IPv4 addresses, in the kernel's order.
        up: Whether it is up and has a carrier.
        multicast: Whether it can carry multicast.
        loopback: Whether it never leaves this machine.
    """

    name: str
    index: int
    addresses: tuple[IPv4Address, ...]
    up: bool
    multicast: bool
    loopback: bool

    @property
    def usable(self) -> bool:
        """Whether beacons can be sent there; loopback carries multicast though its flags do not say so."""
        return self.up and bool(self.addresses) and (self.multicast or self.loopback)

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
        ipv4 = [IPv4Address(a.address) for a in addresses.get(name, ()) if a.family == socket.AF_INET]
        found.append(
            Interface(
                name, index, tuple(dict.fromkeys(ipv4)), stats[name].isup, "multicast" in flags, "loopback" in flags
            )
        )
    return tuple(found)


def choose(interfaces: Iterable[Interface], wanted: tuple[str, ...] = ()) -> tuple[Interface, ...]:
    """The usable interfaces among those that the user named; among all if none was named."""
    return tuple(i for i in interfaces if i.usable and (not wanted or i.name in wanted))


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


class InterfaceWatcher:
    """Calls back when interfaces or their addresses change.

    The kernel reports changes through a netlink socket (``rtnetlink(7)``); where that is refused, the interfaces are
    listed every ``limits.INTERFACE_LOOK`` seconds.

    Args:
        on_change: Called in the loop with all interfaces, ``INTERFACE_SETTLE`` seconds after a change.
        look: Lists them.
    """

    def __init__(
        self,
        on_change: Callable[[tuple[Interface, ...]], None],
        *,
        look: Callable[[], tuple[Interface, ...]] = list_interfaces,
    ) -> None:
        self._on_change = on_change
        self._look = look
        self._known: tuple[Interface, ...] = ()
        self._netlink: socket.socket | None = None
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> tuple[Interface, ...]:
        """Begin to watch; return the present interfaces."""
        self._netlink = _open_netlink()
        self._known = self._look()
        if self._netlink is not None:
            asyncio.get_running_loop().add_reader(self._netlink.fileno(), self._netlink_readable)
        else:
            self._compare_in(limits.INTERFACE_LOOK)
        return self._known

    def close(self) -> None:
        """Stop watching."""
        if self._timer is not None:
            self._timer.cancel()
        if self._netlink is not None:
            asyncio.get_running_loop().remove_reader(self._netlink.fileno())
            self._netlink.close()
            self._netlink = None

    def _netlink_readable(self) -> None:
        # The messages only mean that something changed; ENOBUFS means that some were lost, which is the same.
        with contextlib.suppress(OSError):
            while self._netlink is not None:
                self._netlink.recv(64 * KIB)
        if self._timer is None:
            self._compare_in(limits.INTERFACE_SETTLE)

    def _compare_in(self, delay: float) -> None:
        self._timer = asyncio.get_running_loop().call_later(delay, self._compare)

    def _compare(self) -> None:
        self._timer = None
        if self._netlink is None:
            self._compare_in(limits.INTERFACE_LOOK)
        try:
            now = self._look()
        except OSError as error:  # no file descriptor is left to ask the kernel: tried again later
            _log.debug("! interfaces cannot be listed: %s", error)
            if self._timer is None:
                self._compare_in(limits.INTERFACE_LOOK)
            return
        if now != self._known:
            self._known = now
            self._on_change(now)


def _open_netlink() -> socket.socket | None:
    try:
        netlink = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC, 0)
    except OSError as error:
        _log.info("= no netlink here (%s); interfaces are read every %g s", error, limits.INTERFACE_LOOK)
        return None
    try:
        netlink.bind((0, _RTMGRP_LINK | _RTMGRP_IPV4_IFADDR))
    except OSError as error:
        netlink.close()
        _log.info("= netlink is refused (%s); interfaces are read every %g s", error, limits.INTERFACE_LOOK)
        return None
    return netlink


# Seeds: addresses of other agents in the settings. Host names are looked up in threads, again and again.


def resolve_ipv4(host: str) -> list[str]:
    """The IPv4 addresses of a host name; blocks.

    Raises:
        OSError: The name cannot be resolved now.
    """
    found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)
    return list(dict.fromkeys(str(entry[4][0]) for entry in found))


class SeedResolver:
    """Keeps the numeric addresses of the seeds up to date.

    Args:
        seeds: As the user wrote them.
        default_port: For seeds without a port.
        on_change: Called in the loop with all addresses known so far, when they change.
        resolve: Looks up a host name; runs in a thread.
    """

    def __init__(
        self,
        seeds: tuple[HostPort, ...],
        default_port: int,
        on_change: Callable[[tuple[Address, ...]], None],
        *,
        resolve: Callable[[str], list[str]] = resolve_ipv4,
    ) -> None:
        self._seeds = seeds
        self._default_port = default_port
        self._on_change = on_change
        self._resolve = resolve
        self._hosts: dict[str, list[str]] = {}
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Report the numeric addresses at once; start to look up the names."""
        names = []
        for host in dict.fromkeys(seed.host for seed in self._seeds):
            try:
                self._hosts[host] = [str(IPv4Address(host))]
            except AddressValueError:
                names.append(host)
        if self._hosts:
            self._report()
        self._tasks = [asyncio.get_running_loop().create_task(self._follow(host)) for host in names]

    async def close(self) -> None:
        """Stop. A look-up in progress ends by itself, in its thread."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _report(self) -> None:
        self._on_change(
            tuple((a, s.port or self._default_port) for s in self._seeds for a in self._hosts.get(s.host, ()))
        )

    async def _follow(self, host: str) -> None:
        backoff = Backoff(limits.SEED_RETRY_FIRST, limits.SEED_RETRY_MAX, random.random)
        failed = False
        while True:
            try:
                addresses = await self._look_up(host)
            except OSError as error:
                if not failed:
                    _log.warning("! seed %s: cannot be resolved (%s); tried again for ever", host, error)
                failed = True
                await asyncio.sleep(backoff.delay())
                continue
            failed = False
            backoff.reset()
            if addresses != self._hosts.get(host):
                _log.info("= seed %s is %s", host, ", ".join(addresses))
                self._hosts[host] = addresses
                self._report()
            await asyncio.sleep(limits.SEED_RESOLVE_INTERVAL)

    async def _look_up(self, host: str) -> list[str]:
        """Look up a name in a daemon thread: a name server that never answers must not delay the end."""
        loop = asyncio.get_running_loop()
        done: asyncio.Future[list[str]] = loop.create_future()

        def settle(result: list[str] | OSError) -> None:
            if done.cancelled():
                return
            if isinstance(result, OSError):
                done.set_exception(result)
            else:
                done.set_result(result)

        def work() -> None:
            result: list[str] | OSError
            try:
                result = self._resolve(host)
            except OSError as error:
                result = error
            except UnicodeError as error:  # a label that is empty or too long
                result = OSError(str(error))
            with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
                loop.call_soon_threadsafe(settle, result)

        threading.Thread(target=work, name=f"resolve {host}", daemon=True).start()
        return await done


# The UDP sockets of discovery. The group is joined, and sent to, on each interface by its index.


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
