"""All checks of ``rmpa doctor``. A new check goes here.

A check is a function of ``DoctorInput``. It reads something of this machine, by a module of this folder, and has a
pure ``judge_…`` function of the folder above say what that means. ``CHECKS`` lists them.
"""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import rmpa
from rmpa.config.read import load_settings
from rmpa.config.settings import Settings
from rmpa.core.errors import ConfigError, RmpaError, StartError
from rmpa.discovery.network import choose, list_interfaces
from rmpa.mesh.io.dial import may_use_bbr, repeats_quickly
from rmpa.observe import limits
from rmpa.observe.check import FAIL, OK, SKIPPED, WARN, Check
from rmpa.observe.doctor.agents import judge_agents
from rmpa.observe.doctor.exposed_nodes import judge_exposed_nodes
from rmpa.observe.doctor.io import machine, network
from rmpa.observe.doctor.io.exposed_nodes import exposed_nodes
from rmpa.observe.doctor.io.firewall import check_firewall
from rmpa.observe.doctor.io.multicast import hear
from rmpa.observe.doctor.io.programs import resolve
from rmpa.observe.doctor.machine import judge_clock, judge_rights, judge_sim_time
from rmpa.observe.doctor.network import (
    judge_interfaces,
    judge_multicast,
    judge_ports,
    judge_radio,
    judge_routes,
    judge_rp_filter,
)
from rmpa.observe.doctor.ros_environment import RosShell, judge_shell, names_of
from rmpa.observe.io.control_client import ControlClient, find_agents
from rmpa.observe.snapshot import Snapshot
from rmpa.ros.environment import DEFAULT_MASTER_URI, host_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.observe.doctor.network import NetworkInterface


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
    return DoctorInput(environ, settings, checks, agents, network.read_interfaces(settings.interfaces), listen)


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
    return judge_interfaces(given.interfaces, given.settings.interfaces, container=network.in_container())


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
    return judge_radio(network.read_radios(given.interfaces), quick=repeats_quickly(), bbr=may_use_bbr())


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
    found = {text: network.probe_route(host) for host, text in targets.items()}
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
    return judge_ports(network.probe_ports(given.settings, ours, processes))


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
    "rp_filter": lambda given: judge_rp_filter(network.read_rp_filter(), given.interfaces),
    "radio": _radio,
    "route": _routes,
    "port": _ports,
    "ROS": _shell,
    "clock": _clock,
    "realtime": _rights,
    "exposed nodes": _exposed_nodes,
}
"""All checks, in the order of the output; at least one result of each has its name. Each takes 2 s at most."""
