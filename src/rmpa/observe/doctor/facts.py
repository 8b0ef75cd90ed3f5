"""What several checks of ``rmpa doctor`` read of this machine: settings, agents, interfaces; and programs."""

from __future__ import annotations

import contextlib
import shutil
import socket
import subprocess
import threading
from dataclasses import dataclass
from ipaddress import IPv4Interface
from typing import TYPE_CHECKING

import psutil

from rmpa.config.read import load_settings
from rmpa.config.settings import Settings
from rmpa.core.errors import ConfigError, RmpaError
from rmpa.discovery.network import choose, list_interfaces
from rmpa.observe import limits
from rmpa.observe.control_client import ControlClient, find_agents
from rmpa.observe.peer_info import FAIL, OK, WARN, Check
from rmpa.observe.snapshot import Snapshot

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


@dataclass(frozen=True, slots=True)
class NetworkInterface:
    """One network interface.

    Args:
        name: As in ``ip link``.
        networks: Its IPv4 addresses with their networks.
        up: Whether it is up and has a carrier.
        multicast: Whether its flags say so.
        loopback: Whether it never leaves this machine.
        used: Whether an agent started here would use it.
    """

    name: str
    networks: tuple[IPv4Interface, ...] = ()
    up: bool = True
    multicast: bool = True
    loopback: bool = False
    used: bool = True


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
    try:
        loaded = load_settings({"config": config}, environ, host_name=socket.gethostname())
    except ConfigError as error:
        settings = Settings()
        checks = [Check("settings", FAIL, str(error), "`rmpa up` will not start", where=error.source)]
    else:
        settings = loaded.settings
        where = f"read from {settings.config_file}" if settings.config_file else "no file; defaults and variables"
        checks = [Check("settings", OK, f"{where}: name {settings.name}, domain {settings.domain}")]
        checks += [Check("settings", WARN, note) for note in loaded.notes]
    agents: dict[str, Snapshot | str] = {}
    for found in find_agents(environ):
        try:
            with ControlClient(found.path) as client:
                agents[found.name] = client.snapshot(most=0)  # topics in use
        except RmpaError as error:
            agents[found.name] = str(error)
    return DoctorInput(environ, settings, tuple(checks), agents, read_interfaces(settings.interfaces), listen)


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
            one.name,
            tuple(IPv4Interface(f"{a}/{masks.get((one.name, str(a)), '255.255.255.255')}") for a in one.addresses),
            one.up,
            one.multicast,
            one.loopback,
            one.name in used,
        )
        for one in there
    )


def ask_program(*words: str) -> str | None:
    """What a program prints; ``None`` if it is missing, fails, or takes more than ``limits.DOCTOR_PROGRAM``."""
    path = shutil.which(words[0], path="/usr/sbin:/sbin:/usr/bin:/bin")
    if path is None:
        return None
    command, limit = [path, *words[1:]], limits.DOCTOR_PROGRAM
    try:
        done = subprocess.run(  # noqa: S603 - fixed arguments, and a program of the system's folders
            command, capture_output=True, timeout=limit, check=True, stdin=subprocess.DEVNULL
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout[: limits.DOCTOR_OUTPUT_MAX].decode("utf-8", "replace")


def resolve(names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """The IPv4 addresses of host names; none for a name that is not resolved within ``limits.DOCTOR_NAME``."""
    found: dict[str, tuple[str, ...]] = dict.fromkeys(names, ())

    def look(name: str) -> None:
        with contextlib.suppress(OSError, UnicodeError):
            found[name] = tuple(dict.fromkeys(str(a[4][0]) for a in socket.getaddrinfo(name, None, socket.AF_INET)))

    # The resolver cannot be interrupted: a thread that still waits ends with the program.
    threads = [threading.Thread(target=look, args=(name,), daemon=True) for name in found]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(limits.DOCTOR_NAME)
    return dict(found)
