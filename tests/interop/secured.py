"""Modules of a lab that are members of one secured mesh before their agents start, and an attacker beside them."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any, Final

from lab.bed.agents import Agent
from lab.bed.namespaces import Host
from lab.bed.processes import Event, Process
from rmpa.config import limits as config_limits
from rmpa.core.identity import Guid
from rmpa.observe.control_client import ControlClient
from rmpa.runtime.loop import SystemClock
from rmpa.trust import certificates
from rmpa.trust import limits as trust_limits
from rmpa.trust.membership import Membership, MeshAuthority, found_mesh, new_key, private_key
from rmpa.trust.store import MemberFiles, TrustStore

ATTACKER: Final = Path(__file__).with_name("attacker.py")
UDP_PORT: Final = config_limits.MULTICAST_PORT
GROUP: Final = config_limits.MULTICAST_GROUP


@dataclass
class SecuredMesh:
    """The authority is the module that is named first.

    Args:
        home: The directory of the lab's agents (``Agent.home``).
        authority: The module that is the authority.
    """

    home: Path
    authority: str

    def __post_init__(self) -> None:
        found_mesh(self.store(self.authority), self.authority, "lab", time.time())

    def store(self, name: str) -> TrustStore:
        """Where the files of a module are whose host has its name."""
        return TrustStore(self.home / "state" / name, name)

    def _authority(self) -> MeshAuthority:
        store = self.store(self.authority)
        return MeshAuthority(Membership.load(store, SystemClock()))

    def add(self, *names: str) -> None:
        """Make modules members, as a join does, before their agents run."""
        authority = self._authority()
        for name in names:
            key = new_key()
            request = certificates.make_request(private_key(key, name), name)
            made = authority.grant(request)
            self.store(name).save(MemberFiles(key, made.certificate, made.ca, made.keys, made.deny))

    def expired(self, name: str) -> TrustStore:
        """Files whose certificate ended an hour ago; never used by an agent."""
        store = self.store(self.authority)
        ca_key = private_key(store.load_ca_key(), "ca.key")
        files, key = store.load(), new_key()
        asked = certificates.read_request(certificates.make_request(private_key(key, name), name))
        wall = time.time() - trust_limits.CERTIFICATE_LIFETIME - 3600
        made = certificates.issue(asked, files.ca, ca_key, 77, wall)
        away = TrustStore(self.home / "eve" / "expired", name)
        away.save(MemberFiles(key, made, files.ca, files.keys))
        return away

    @property
    def group_key(self) -> str:
        """The newest group key, hexadecimal: what a thief of a member's disk has."""
        return self._authority().membership.ring.newest.secret.hex()


def foreign_files(home: Path, name: str) -> TrustStore:
    """Files of a member of another mesh."""
    store = TrustStore(home / "eve" / "foreign", name)
    found_mesh(store, name, "elsewhere", time.time())
    return store


def start_attack(host: Host, mode: str, **arguments: object) -> Process:
    """The attacker, on its own host."""
    command = [sys.executable, str(ATTACKER), mode, json.dumps(arguments)]
    return Process(host.command(command), name=f"attack {mode}")


def attack(host: Host, mode: str, **arguments: object) -> Event:
    """Run an attack to its end; return what it says last."""
    with start_attack(host, mode, **arguments) as process:
        return process.wait_event("done", 60.0)


def control(agent: Agent, what: str, **arguments: object) -> dict[str, Any]:
    """Ask a module's agent as ``rmpa trust`` does."""
    with ControlClient(agent.sockets()[0]) as client:
        return client.call("trust", dict, what=what, **arguments)


def place(agent: Agent) -> dict[str, Any]:
    """Where an agent is reached: ``address``, ``port`` and ``guid`` for an attack."""
    guid = agent.snapshot().agent.guid
    found = Guid.parse(guid)
    assert isinstance(found.address, IPv4Address)
    return {"address": str(found.address), "port": found.port, "guid": guid}


def counter(agent: Agent, name: str) -> int:
    """One counter of an agent."""
    return agent.snapshot().counters.get(name, 0)
