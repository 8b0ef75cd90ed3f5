"""Reads the network of this machine: interfaces, filters of the kernel, routes, ports."""

from __future__ import annotations

import contextlib
import os
import socket
from ipaddress import IPv4Interface
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

from rmpa.discovery.network import choose, list_interfaces, open_receiver
from rmpa.observe.doctor.io.programs import ask_program
from rmpa.observe.doctor.network import NetworkInterface, Port, Radio
from rmpa.runtime.tcp_connections import program_at

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.config.settings import Settings

_CONF: Final = Path("/proc/sys/net/ipv4/conf")
_INTERFACES: Final = Path("/sys/class/net")
_CONTAINER_MARKS: Final = (Path("/.dockerenv"), Path("/run/.containerenv"))


def read_interfaces(wanted: tuple[str, ...]) -> tuple[NetworkInterface, ...]:
    """All interfaces; ``wanted`` are the names that the settings give, none for all that can be used."""
    there = list_interfaces()
    used = {interface.name for interface in choose(there, wanted)}
    masks = {
        (name, address.address): address.netmask or "255.255.255.255"
        for name, addresses in psutil.net_if_addrs().items()
        for address in addresses
        if address.family == socket.AF_INET
    }
    return tuple(
        NetworkInterface(
            interface.name,
            tuple(
                IPv4Interface(f"{a}/{masks.get((interface.name, str(a)), '255.255.255.255')}")
                for a in interface.addresses
            ),
            interface.up,
            interface.multicast,
            interface.loopback,
            interface.name in used,
        )
        for interface in there
    )


def in_container() -> bool:
    """Whether this is a container with a network namespace of its own."""
    if "container" not in os.environ and not any(mark.exists() for mark in _CONTAINER_MARKS):
        return False
    with contextlib.suppress(OSError, ValueError):
        link, own = (
            int(Path(f"/sys/class/net/eth0/{name}").read_text(encoding="ascii")) for name in ("iflink", "ifindex")
        )
        return link != own  # a veth: its other end is outside
    return False


def read_rp_filter() -> dict[str, int]:
    """``net.ipv4.conf.NAME.rp_filter`` by name, ``all`` among them; empty where the kernel has none."""
    found = {}
    for path in _CONF.glob("*/rp_filter") if _CONF.is_dir() else ():
        with contextlib.suppress(OSError, ValueError):
            found[path.parent.name] = int(path.read_text(encoding="ascii"))
    return found


def read_radios(interfaces: Iterable[NetworkInterface]) -> list[Radio]:
    """The wireless ones of these interfaces that an agent would use, with what their routes say."""
    found = []
    for interface in interfaces:
        if interface.used and interface.networks and (_INTERFACES / interface.name / "phy80211").exists():
            network = str(interface.networks[0].network)
            route = ask_program("ip", "-4", "route", "show", network, "dev", interface.name) or ""
            words = route.partition(" rto_min ")[2].removeprefix("lock ").split()
            found.append(Radio(interface.name, network, words[0] if words else ""))
    return found


def probe_route(host: str) -> str:
    """Why the kernel has no route to an address, or an empty string. Sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, 9))
        except OSError as error:
            return error.strerror or str(error)
    return ""


def probe_ports(settings: Settings, ours: Mapping[int, str], agents: Mapping[int, str]) -> tuple[Port, ...]:
    """Try to bind the ports of an agent with these settings.

    Args:
        settings: The settings.
        ours: The owners of the ports that agents of this machine have, ready to read.
        agents: The names of the agents of this machine that answer, by process id.
    """
    ports: list[Port] = []
    if settings.core_mode == "embedded":  # an external core has its port already
        ports.append(_tcp("the ROS core", settings.core_host, settings.core_port, ours))
    if settings.port:
        ports.append(_tcp("the mesh (TCP)", "", settings.port, ours))
    number = settings.discovery_port
    try:
        open_receiver(settings.multicast.group, number).close()
    except OSError as error:
        ports.append(Port("beacons (UDP)", number, error.strerror or str(error), program_at(number)))
    else:
        ports.append(Port("beacons (UDP)", number, owner=_users(number, agents)))
    return tuple(ports)


def _tcp(what: str, host: str, number: int, ours: Mapping[int, str]) -> Port:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, number))
        except OSError as error:
            owner = ours.get(number, "")
            return Port(what, number, error.strerror or str(error), owner or program_at(number), ours=bool(owner))
    return Port(what, number)


def _users(number: int, agents: Mapping[int, str]) -> str:
    """The programs that share a UDP port, ready to read; empty for none."""
    names: dict[str, None] = {}
    with contextlib.suppress(psutil.Error, OSError):
        for connection in psutil.net_connections("udp4"):
            if connection.laddr and connection.laddr.port == number:
                names[_name(connection.pid, agents)] = None
    return " and ".join(names)


def _name(pid: int | None, agents: Mapping[int, str]) -> str:
    if pid is None:
        return "a program of another user"
    if pid in agents:
        return f"agent {agents[pid]}"
    with contextlib.suppress(psutil.Error):
        return f"{psutil.Process(pid).name()} (pid {pid})"
    return f"a program (pid {pid})"
