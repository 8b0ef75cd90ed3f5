"""All checks of ``rmpa doctor``, with the facts of the network that they read. A new check goes here.

All checks of ``rmpa doctor``. A new check goes here.

A check is a function of ``DoctorInput``. It reads something of this machine, by a module of this folder, and has a
pure ``judge_…`` function of the folder above say what that means. ``CHECKS`` lists them.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import select
import socket
import struct
import time
from dataclasses import dataclass
from ipaddress import IPv4Interface
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

import rmpa
from rmpa.config.read import load_settings
from rmpa.config.settings import Settings
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.discovery import limits as discovery_limits
from rmpa.discovery.beacon import MAGIC, VERSION, BeaconKind
from rmpa.discovery.network import choose, join_group, list_interfaces, open_receiver, receive
from rmpa.mesh.io.dial import may_use_bbr, repeats_quickly
from rmpa.observe import limits
from rmpa.observe.control_client import ControlClient, find_agents
from rmpa.observe.doctor import machine
from rmpa.observe.doctor.agents import exposed_nodes, judge_agents, judge_exposed_nodes
from rmpa.observe.doctor.machine import (
    RosShell,
    ask_program,
    judge_clock,
    judge_rights,
    judge_shell,
    judge_sim_time,
    names_of,
    resolve,
)
from rmpa.observe.doctor.network import (
    MulticastEcho,
    NetworkInterface,
    Port,
    Radio,
    check_firewall,
    judge_interfaces,
    judge_multicast,
    judge_ports,
    judge_radio,
    judge_routes,
    judge_rp_filter,
)
from rmpa.observe.peer_info import FAIL, OK, SKIPPED, WARN, Check
from rmpa.observe.snapshot import Snapshot
from rmpa.ros.environment import DEFAULT_MASTER_URI, host_of
from rmpa.runtime.kernel_tcp import program_at

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.discovery.network import Interface


# Sends and receives multicast packets on chosen interfaces.


_PKTINFO: Final = struct.Struct("@i4s4s")
_IP_PKTINFO: Final = 8  # Linux's (linux/in.h); not in the socket module of every supported Python
_NO_DOMAIN: Final = 0xFFFF
"""Greater than every domain: agents ignore beacons of it without logging."""


def hear(interfaces: Iterable[Interface], group: str, port: int, listen: float = 0.0) -> tuple[MulticastEcho, ...]:
    """Send one packet on each interface, and receive it there as an agent does.

    The packets are beacons of a domain that cannot exist, so agents ignore them.

    Args:
        interfaces: Where to send.
        group: The multicast group.
        port: Its port, which is shared with agents and others.
        listen: Seconds to listen for packets of other machines; 0: only until the own ones are back.

    Raises:
        StartError: Another program has the port and does not share it.
    """
    wanted = {interface.index: interface for interface in interfaces}
    own = {str(address) for interface in wanted.values() for address in interface.addresses}
    try:
        receiver = open_receiver(group, port)
    except OSError as error:
        problem = f"cannot be opened ({error.strerror})"
        raise StartError(f"UDP port {port}", problem, "`ss -ulnp` shows the program that has it") from None
    found: dict[str, MulticastEcho] = {}
    with receiver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, discovery_limits.MULTICAST_TTL)
        refused = join_group(receiver, group, wanted.values(), set())
        sent: dict[bytes, tuple[str, float]] = {}
        for interface in wanted.values():
            token = struct.pack(">4sBBH", MAGIC, VERSION, BeaconKind.HEARTBEAT, _NO_DOMAIN) + secrets.token_bytes(16)
            why = refused.get(interface.name) or _send(sender, interface, token, (group, port))
            found[interface.name] = MulticastEcho(interface.name, (why.strerror or str(why)) if why else "")
            if why is None:
                sent[token] = interface.name, time.monotonic()
        until = time.monotonic() + max(limits.DOCTOR_HEAR, listen)
        while (sent or listen) and (rest := until - time.monotonic()) > 0:
            if not select.select([receiver], [], [], rest)[0]:
                break
            try:
                data, (host, _), index = receive(receiver)
            except BlockingIOError:
                continue  # the kernel dropped it: its checksum was wrong
            name = wanted[index].name if index in wanted else ""
            # If two interfaces share a network, the packet is received on the other one too.
            if data in sent and sent[data][0] == name:
                found[name].after = time.monotonic() - sent.pop(data)[1]
            elif name and host not in own and data.startswith(MAGIC):
                found[name].others.add(host)
    return tuple(found.values())


def _send(sender: socket.socket, interface: Interface, data: bytes, to: tuple[str, int]) -> OSError | None:
    """Send one packet on an interface; return why that failed."""
    source = interface.addresses[0].packed if interface.addresses else bytes(4)
    ancillary = [(socket.IPPROTO_IP, _IP_PKTINFO, _PKTINFO.pack(interface.index, source, bytes(4)))]
    try:
        sender.sendmsg([data], ancillary, 0, to)
    except OSError as error:
        return error
    return None


# Reads the network of this machine: interfaces, filters of the kernel, routes, ports.


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


@dataclass(frozen=True, slots=True)
class DoctorInput:
    """What several checks need, read once.

    Args:
        environ: The shell's variables.
        settings: What an agent that is started here would have; the defaults where they cannot be read.
        settings_checks: The results of reading the settings.
        agents: The snapshot of each agent of this machine by its name, or why it does not answer.
        interfaces: All network interfaces.
        listen: Seconds to listen for multicast packets of other machines; 0: not at all.
    """

    environ: Mapping[str, str]
    settings: Settings
    settings_checks: tuple[Check, ...]
    agents: Mapping[str, Snapshot | str]
    interfaces: tuple[NetworkInterface, ...]
    listen: float = 0.0

    @property
    def snapshots(self) -> dict[str, Snapshot]:
        """Of the agents that answer."""
        return {name: shown for name, shown in self.agents.items() if isinstance(shown, Snapshot)}


def look_at(environ: Mapping[str, str], config: str | None = None, listen: float = 0.0) -> DoctorInput:
    """Read the settings and the interfaces, and ask the agents.

    Args:
        environ: The shell's variables.
        config: The settings' file; the usual places by default.
        listen: Seconds to listen for multicast packets of other machines.
    """
    settings, checks = _settings(environ, config)
    agents: dict[str, Snapshot | str] = {}
    for found in find_agents(environ):
        try:
            with ControlClient(found.path) as client:
                agents[found.name] = client.snapshot(most=0)  # topics in use
        except RmpaError as error:
            agents[found.name] = str(error)
    return DoctorInput(environ, settings, checks, agents, read_interfaces(settings.interfaces), listen)


def _settings(environ: Mapping[str, str], config: str | None) -> tuple[Settings, tuple[Check, ...]]:
    try:
        loaded = load_settings({"config": config}, environ, host_name=socket.gethostname())
    except ConfigError as error:
        return Settings(), (Check("settings", FAIL, str(error), "`rmpa up` will not start", where=error.source),)
    settings = loaded.settings
    where = f"read from {settings.config_file}" if settings.config_file else "no file; defaults and variables"
    read = Check("settings", OK, f"{where}: name {settings.name}, domain {settings.domain}")
    return settings, (read, *(Check("settings", WARN, note) for note in loaded.notes))


def examine(given: DoctorInput) -> Iterator[Check]:
    """Run all checks; each result comes as soon as it is there. The whole takes some two seconds."""
    for check in CHECKS.values():
        yield from check(given)


def _interfaces(given: DoctorInput) -> Iterable[Check]:
    return judge_interfaces(given.interfaces, given.settings.interfaces, container=in_container())


def _multicast(given: DoctorInput) -> Iterable[Check]:
    """Send and receive on each interface that an agent would use, at the agents' own port."""
    settings = given.settings
    if not settings.multicast.enabled:
        return [Check("multicast", SKIPPED, "the settings switch it off (discovery.multicast)")]
    usable = choose(list_interfaces(), settings.interfaces)
    try:
        echoes = hear(usable, settings.multicast.group, settings.discovery_port, given.listen)
    except StartError as error:
        return [Check("multicast", FAIL, f"{error.what} {error.problem}", error.remedy)]
    return judge_multicast(echoes, settings.multicast.group, settings.discovery_port, given.listen)


def _radio(given: DoctorInput) -> Iterable[Check]:
    return judge_radio(read_radios(given.interfaces), quick=repeats_quickly(), bbr=may_use_bbr())


def _routes(given: DoctorInput) -> Iterable[Check]:
    targets = {
        address.partition(":")[0]: f"{address.partition(':')[0]} ({peer.name})"
        for snapshot in given.snapshots.values()
        for peer in snapshot.peers
        for address in peer.addresses[:1]
    }
    names = [seed.host for seed in given.settings.seeds]
    known = resolve(names)
    for seed, addresses in known.items():
        targets |= {address: f"{address} (seed {seed})" for address in addresses[:1]}
    found = {text: probe_route(host) for host, text in targets.items()}
    return judge_routes(found | {f"seed {name}": "the name cannot be resolved" for name in names if not known[name]})


def _ports(given: DoctorInput) -> Iterable[Check]:
    ours, processes = {}, {}
    for name, snapshot in given.snapshots.items():
        processes[snapshot.agent.pid] = name
        core = snapshot.agent.core_uri.rstrip("/").rpartition(":")[2]
        mesh = snapshot.agent.guid.partition("#")[0].rpartition(":")[2]
        for number, what in ((core, "the core of agent"), (mesh, "agent")):
            if number.isdecimal():
                ours[int(number)] = f"{what} {name}"
    return judge_ports(probe_ports(given.settings, ours, processes))


def _shell(given: DoctorInput) -> Iterable[Check]:
    host_name, settings = socket.gethostname(), given.settings
    own = {str(of.ip) for interface in given.interfaces for of in interface.networks}
    shell = RosShell(
        environ=given.environ,
        host_name=host_name,
        addresses=frozenset({*own, "127.0.0.1"}),
        resolved=resolve(names_of(given.environ, host_name)),
        cores={name: snapshot.agent.core_uri for name, snapshot in given.snapshots.items()},
        domains={name: snapshot.agent.domain for name, snapshot in given.snapshots.items()},
        answers=_accepts(given.environ.get("ROS_MASTER_URI", "") or DEFAULT_MASTER_URI),
        external=(settings.core_master or DEFAULT_MASTER_URI) if settings.core_mode == "external" else "",
    )
    return judge_shell(shell)


def _accepts(uri: str) -> bool:
    """Whether TCP connections are accepted at a URI's host and port."""
    host, port = host_of(uri), uri.rstrip("/").rpartition(":")[2]
    try:
        with socket.create_connection((host, int(port)), limits.CONTROL_LOOK_TIMEOUT):
            return True
    except (OSError, ValueError, OverflowError):
        return False


def _clock(given: DoctorInput) -> Iterable[Check]:
    yield from judge_clock(machine.read_clock())
    for name, shown in given.snapshots.items():
        yield from judge_sim_time(name, machine.read_sim_time(shown.agent.core_uri))


def _rights(given: DoctorInput) -> Iterable[Check]:
    rights = machine.probe_rights(wanted=given.settings.realtime.enabled, agents=bool(given.snapshots))
    return judge_rights(rights)


def _exposed_nodes(given: DoctorInput) -> Iterable[Check]:
    for name, shown in given.snapshots.items():
        trusted = shown.trust is not None
        found = exposed_nodes(shown.agent.core_uri, shown.agent.pid) if trusted else None
        yield judge_exposed_nodes(name, found, trusted=trusted, direct=given.settings.allows_direct)
    if not given.snapshots:
        yield Check("exposed nodes", SKIPPED, "no agent runs")


CHECKS: Final[dict[str, Callable[[DoctorInput], Iterable[Check]]]] = {
    "settings": lambda given: given.settings_checks,
    "agent": lambda given: judge_agents(given.agents, rmpa.__version__),
    "interface": _interfaces,
    "multicast": _multicast,
    "firewall": lambda given: check_firewall(given.settings),
    "rp_filter": lambda given: judge_rp_filter(read_rp_filter(), given.interfaces),
    "radio": _radio,
    "route": _routes,
    "port": _ports,
    "ROS": _shell,
    "clock": _clock,
    "realtime": _rights,
    "exposed nodes": _exposed_nodes,
}
"""All checks, in the order of the output; at least one result of each has its name. Each takes 2 s at most."""
