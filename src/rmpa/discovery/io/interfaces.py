"""The machine's network interfaces: which there are, which we use, and when they change."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import TYPE_CHECKING, Final

import psutil

from rmpa.core.limits import KIB
from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

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
