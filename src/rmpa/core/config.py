"""The agent's settings, as values; ``core.config_sources`` reads them from files, variables and flags."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.core import limits

if TYPE_CHECKING:
    from pathlib import Path


@dataclass(frozen=True, slots=True)
class HostPort:
    """An address as written by a user: a host (name or number) and a port, 0 where none was given."""

    host: str
    port: int = 0

    def __str__(self) -> str:
        """``host:port`` or ``host``."""
        return f"{self.host}:{self.port}" if self.port else self.host


@dataclass(frozen=True, slots=True)
class PolicySettings:
    """What may cross the mesh, by globs (``core.names.matches``); the stronger of two answers is "no".

    Args:
        allow: Topics that may cross; empty lets none cross.
        deny: Topics that stay home, on top of the built-in ones.
        allow_types: Message types that may cross.
        deny_types: Message types that stay home.
    """

    allow: tuple[str, ...] = ("/**",)
    deny: tuple[str, ...] = ()
    allow_types: tuple[str, ...] = ("**",)
    deny_types: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Settings:
    """All settings of one agent.

    Args:
        name: The module's name, a ROS base name; empty means: from the host's name.
        domain: Only agents of one domain join.
        core_host: The address that the ROS core listens at.
        core_port: Its port.
        port: The mesh's port (TCP links, UDP unicast beacons); 0 lets the system choose.
        interfaces: Names of the interfaces to use; empty means all usable ones.
        seeds: Agents to greet by unicast, across sub-networks; port 0 means the domain's discovery port.
        group: Multicast group of the beacons.
        group_port: Its port before the domain is added.
        multicast: Whether beacons are sent to the group at all (``ROS_AUTOMATIC_DISCOVERY_RANGE=OFF`` says no).
        policy: What may cross.
        log_level: ``debug``, ``info``, ``warning`` or ``error``.
        log_json: One JSON object a line instead of text.
        config_file: Where the file's part came from, if there was a file.
        runtime_dir: Where control sockets live; empty means the usual place of this user.
    """

    name: str = ""
    domain: int = 0
    core_host: str = "127.0.0.1"
    core_port: int = 11311
    port: int = 0
    interfaces: tuple[str, ...] = ()
    seeds: tuple[HostPort, ...] = ()
    group: str = limits.MULTICAST_GROUP
    group_port: int = limits.MULTICAST_PORT
    multicast: bool = True
    policy: PolicySettings = field(default_factory=PolicySettings)
    log_level: str = "info"
    log_json: bool = False
    config_file: Path | None = None
    runtime_dir: str = ""

    @property
    def discovery_port(self) -> int:
        """The port of this domain's beacons."""
        return self.group_port + self.domain
