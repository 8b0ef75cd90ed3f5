"""Looks at the network of this machine: interfaces, filters, routes, ports, firewalls."""

from __future__ import annotations

import contextlib
import os
import socket
from ipaddress import IPv4Interface
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

from rmpa.core.errors import StartError
from rmpa.discovery.io.interfaces import choose, list_interfaces
from rmpa.discovery.io.sockets import open_receiver
from rmpa.observe.check import FAIL, SKIPPED, WARN, Check
from rmpa.observe.doctor.firewall import judge_rules, read_iptables, read_nft
from rmpa.observe.doctor.io.multicast import hear_ourselves
from rmpa.observe.doctor.io.programs import ask_program
from rmpa.observe.doctor.network import MulticastEcho, NetworkInterface, Port, judge_multicast

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.config.settings import Settings

_CONF: Final = Path("/proc/sys/net/ipv4/conf")
_MTU_PROBING: Final = Path("/proc/sys/net/ipv4/tcp_mtu_probing")
_MARKS_OF_CONTAINERS: Final = (Path("/.dockerenv"), Path("/run/.containerenv"))


def look_at_cards(wanted: tuple[str, ...]) -> tuple[NetworkInterface, ...]:
    """All interfaces; ``wanted`` are those that the settings name, none for all."""
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
    """Whether this is a container whose network is not the machine's own."""
    if "container" not in os.environ and not any(mark.exists() for mark in _MARKS_OF_CONTAINERS):
        return False
    with contextlib.suppress(OSError, ValueError):
        link, own = (
            int(Path(f"/sys/class/net/eth0/{name}").read_text(encoding="ascii")) for name in ("iflink", "ifindex")
        )
        return link != own  # one end of a pair whose other end is outside
    return False


def look_at_multicast(settings: Settings) -> list[Check]:
    """Send and hear on each interface that an agent would use, at the agents' own port."""
    usable = choose(list_interfaces(), settings.interfaces)
    if not settings.multicast:
        return [Check("multicast", SKIPPED, "the settings switch it off (discovery.multicast)")]
    try:
        heard = hear_ourselves(usable, settings.group, settings.discovery_port)
    except StartError as error:
        return [Check("multicast", FAIL, f"{error.what} {error.problem}", error.remedy)]
    echoes = [MulticastEcho(one.interface.name, one.problem, one.after) for one in heard]
    return judge_multicast(echoes, settings.group, settings.discovery_port)


def look_at_rp_filter() -> dict[str, int]:
    """``rp_filter`` of each interface, and of ``all``."""
    found = {}
    for path in _CONF.glob("*/rp_filter") if _CONF.is_dir() else ():
        with contextlib.suppress(OSError, ValueError):
            found[path.parent.name] = int(path.read_text(encoding="ascii"))
    return found


def look_at_mtu_probing() -> int | None:
    """``net.ipv4.tcp_mtu_probing``; ``None`` where there is no such setting."""
    try:
        return int(_MTU_PROBING.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def look_at_route(host: str) -> str:
    """Why the kernel knows no way to an address, or an empty string; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, 9))
        except OSError as error:
            return error.strerror or str(error)
    return ""


def look_at_ports(settings: Settings, ours: Mapping[int, str], agents: Mapping[int, str]) -> tuple[Port, ...]:
    """Whether the ports of an agent with these settings can be had.

    Args:
        settings: The settings.
        ours: The ports that agents of this machine have, and whose each is.
        agents: The agents of this machine that answer, by their processes.
    """
    ports: list[Port] = []
    if settings.core_mode == "embedded":  # an external core has its port already
        ports.append(_tcp("the ROS core", settings.core_host, settings.core_port, ours))
    if settings.port:
        ports.append(_tcp("the mesh (TCP)", "", settings.port, ours))
    number = settings.discovery_port
    try:
        open_receiver(settings.group, number).close()
    except OSError as error:
        ports.append(Port("beacons (UDP)", number, error.strerror or str(error), _owner(number)))
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
            return Port(what, number, error.strerror or str(error), owner or _owner(number), ours=bool(owner))
    return Port(what, number)


def _owner(number: int) -> str:
    """Which program has a port, where the kernel tells us."""
    with contextlib.suppress(psutil.Error, OSError):
        for connection in psutil.net_connections("inet"):
            listens = connection.status in (psutil.CONN_LISTEN, psutil.CONN_NONE)
            if listens and connection.laddr and connection.laddr.port == number and connection.pid:
                return f"{psutil.Process(connection.pid).name()} (pid {connection.pid})"
    return ""


def _users(number: int, agents: Mapping[int, str]) -> str:
    """Which programs use a UDP port that can be shared, ready to read; empty for none."""
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


def look_at_firewall(settings: Settings) -> list[Check]:
    """What nftables, iptables and their front ends say."""
    numbers = frozenset({settings.discovery_port, *((settings.port,) if settings.port else ())})
    needed = f"UDP port {settings.discovery_port}, and the mesh's port (TCP and UDP"
    needed += f", {settings.port})" if settings.port else "; it is any one without --port)"
    found = []
    for words, read in ((("nft", "list", "ruleset"), read_nft), (("iptables", "-S"), read_iptables)):
        text = ask_program(*words)
        if text is not None:
            found.append(judge_rules(read(text, numbers), needed))
    if not found:
        why = "only root may read them" if os.geteuid() else "neither nft nor iptables is here, or they do not answer"
        found.append(Check("firewall", SKIPPED, why, "" if not os.geteuid() else "run it by sudo", where="rules"))
    return found + _front_ends(needed)


def _front_ends(needed: str) -> list[Check]:
    found = []
    with contextlib.suppress(OSError):
        if "ENABLED=yes" in Path("/etc/ufw/ufw.conf").read_text(encoding="utf-8", errors="replace"):
            text = f"is switched on: it must let in {needed}"
            found.append(Check("firewall", WARN, text, "`sudo ufw status` shows its rules", where="ufw"))
    if any(process.info["name"] == "firewalld" for process in psutil.process_iter(["name"])):
        text = f"runs: its zone must let in {needed}"
        found.append(Check("firewall", WARN, text, "`firewall-cmd --list-all` shows its zone", where="firewalld"))
    return found
