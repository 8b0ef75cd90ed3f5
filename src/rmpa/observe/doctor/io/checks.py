"""Everything that ``rmpa doctor`` looks at, one group of checks after the other."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING

import rmpa
from rmpa.config.settings import Settings
from rmpa.config.sources import Flags, load_settings
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.observe import limits
from rmpa.observe.check import FAIL, OK, WARN, Check
from rmpa.observe.doctor.agents import judge_agents
from rmpa.observe.doctor.io import machine, network
from rmpa.observe.doctor.io.programs import resolve
from rmpa.observe.doctor.machine import judge_clock, judge_rights
from rmpa.observe.doctor.network import judge_cards, judge_mtu_probing, judge_ports, judge_routes, judge_rp_filter
from rmpa.observe.doctor.ros_environment import RosShell, judge_shell, names_of
from rmpa.observe.io.control_client import ControlClient, find_agents
from rmpa.observe.snapshot import Snapshot
from rmpa.ros.environment import DEFAULT_MASTER_URI, host_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


@dataclass(frozen=True, slots=True)
class DoctorInput:
    """What the checks are about.

    Args:
        environ: The shell's variables.
        settings: What an agent that is started here would have; the defaults where they cannot be read.
        problems: What is wrong with the settings.
        agents: What each agent of this machine shows, by its name, or why it does not answer.
    """

    environ: Mapping[str, str]
    settings: Settings
    problems: tuple[Check, ...]
    agents: Mapping[str, Snapshot | str]

    @property
    def snapshots(self) -> dict[str, Snapshot]:
        """Of the agents that answer."""
        return {name: shown for name, shown in self.agents.items() if isinstance(shown, Snapshot)}


def look_at(environ: Mapping[str, str], config: str | None = None) -> DoctorInput:
    """Read the settings, and ask the agents.

    Args:
        environ: The shell's variables.
        config: The settings' file; the usual places by default.
    """
    settings, problems = Settings(), []
    try:
        loaded = load_settings(Flags(config=config), environ, host_name=socket.gethostname())
    except ConfigError as error:
        problems.append(Check("settings", FAIL, str(error), "`rmpa up` will not start", where=error.source))
    else:
        settings = loaded.settings
        where = f"read from {settings.config_file}" if settings.config_file else "no file; defaults and variables"
        text = f"{where}: name {settings.name}, domain {settings.domain}"
        problems.append(Check("settings", OK, text))
        problems += [Check("settings", WARN, note) for note in loaded.notes]
    agents: dict[str, Snapshot | str] = {}
    for found in find_agents(environ):
        try:
            with ControlClient(found.path) as client:
                agents[found.name] = client.snapshot()
        except RmpaError as error:
            agents[found.name] = str(error)
    return DoctorInput(environ, settings, tuple(problems), agents)


def examine(patient: DoctorInput) -> Iterator[Check]:
    """Each finding as soon as it is there; the whole takes some two seconds."""
    settings, snapshots = patient.settings, patient.snapshots
    yield from patient.problems
    yield from judge_agents(patient.agents, rmpa.__version__)
    cards = network.look_at_cards(settings.interfaces)
    yield from judge_cards(cards, settings.interfaces, container=network.in_container())
    yield from network.look_at_multicast(settings)
    yield from network.look_at_firewall(settings)
    yield from judge_rp_filter(network.look_at_rp_filter(), cards)
    holes = any(peer.link and peer.link.path_problem for shown in snapshots.values() for peer in shown.peers)
    yield judge_mtu_probing(network.look_at_mtu_probing(), black_hole=holes)
    yield from judge_routes(_routes(patient))
    yield from judge_ports(network.look_at_ports(settings, _ports(snapshots), _processes(snapshots)))
    yield from judge_shell(_shell(patient, {str(n.ip) for card in cards for n in card.networks}))
    yield from judge_clock(machine.look_at_clock())
    yield from judge_rights(machine.look_at_rights(wanted=settings.realtime.enabled, agents=bool(snapshots)))


def _routes(patient: DoctorInput) -> dict[str, str]:
    targets = {
        address.partition(":")[0]: f"{address.partition(':')[0]} ({peer.name})"
        for snapshot in patient.snapshots.values()
        for peer in snapshot.peers
        for address in peer.addresses[:1]
    }
    names = [seed.host for seed in patient.settings.seeds]
    known = resolve(names)
    for seed, addresses in known.items():
        targets |= {address: f"{address} (seed {seed})" for address in addresses[:1]}
    found = {text: network.look_at_route(host) for host, text in targets.items()}
    return found | {f"seed {name}": "nobody knows this name" for name in names if not known[name]}


def _processes(snapshots: Mapping[str, Snapshot]) -> dict[int, str]:
    """The agents of this machine, by their processes."""
    return {snapshot.agent.pid: name for name, snapshot in snapshots.items()}


def _ports(snapshots: Mapping[str, Snapshot]) -> dict[int, str]:
    """The ports that agents of this machine have."""
    found = {}
    for name, snapshot in snapshots.items():
        core = snapshot.agent.core_uri.rstrip("/").rpartition(":")[2]
        mesh = snapshot.agent.guid.partition("#")[0].rpartition(":")[2]
        for number, what in ((core, "the core of agent"), (mesh, "agent")):
            if number.isdecimal():
                found[int(number)] = f"{what} {name}"
    return found


def _shell(patient: DoctorInput, addresses: set[str]) -> RosShell:
    host_name = socket.gethostname()
    environ, settings = patient.environ, patient.settings
    resolved = resolve(names_of(environ, host_name))
    return RosShell(
        environ=environ,
        host_name=host_name,
        addresses=frozenset({*addresses, "127.0.0.1"}),
        resolved=resolved,
        cores={name: snapshot.agent.core_uri for name, snapshot in patient.snapshots.items()},
        domains={name: snapshot.agent.domain for name, snapshot in patient.snapshots.items()},
        answers=_answers(environ.get("ROS_MASTER_URI", "") or DEFAULT_MASTER_URI),
        external=(settings.core_master or DEFAULT_MASTER_URI) if settings.core_mode == "external" else "",
    )


def _answers(uri: str) -> bool:
    """Whether somebody accepts connections where a URI says."""
    host, port = host_of(uri), uri.rstrip("/").rpartition(":")[2]
    try:
        with socket.create_connection((host, int(port)), limits.CONTROL_LOOK_TIMEOUT):
            return True
    except (OSError, ValueError, OverflowError):
        return False
