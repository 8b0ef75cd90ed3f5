"""Two sites behind NAT, each with a module, a gateway and a ROS user's shell, and the router between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lab.bed.gateways import JoinedSites, Site
from lab.bed.namespaces import Lab
from lab.bed.processes import DEADLINE, Process
from tests.interop.modules import Module
from tests.interop.ros import Ros

# The module of each site.
MODULES: Final = {"warehouse": "arm", "yard": "base"}


@dataclass(frozen=True, slots=True)
class JoinedModules:
    """The modules ``arm`` (of the site ``warehouse``) and ``base`` (of ``yard``), and all between them."""

    net: JoinedSites
    arm: Module
    base: Module

    @property
    def warehouse(self) -> Site:
        """The site of ``arm``."""
        return self.net.sites[0]

    @property
    def yard(self) -> Site:
        """The site of ``base``."""
        return self.net.sites[1]

    def crossed(self) -> int:
        """Bytes that the router has received and sent so far."""
        traffic = self.net.fleet.traffic()
        return traffic["rx_bytes"] + traffic["tx_bytes"]


@contextmanager
def joined_modules(home: Path, config: str = "", secured: Mapping[str, str] | None = None) -> Iterator[JoinedModules]:
    """Start all, the gateways with this ``rmpa.toml``, and wait until each module's agent is linked with its gateway.

    ``secured`` is as of ``JoinedSites``.
    """
    with ExitStack() as stack:
        net = JoinedSites(stack.enter_context(Lab()), home, stack, MODULES, config=config, secured=secured)
        hosts = [(site.module.host, site.module) for site in net.sites]
        made = [Module(host, agent, stack.enter_context(Ros(host, home, 11311))) for host, agent in hosts]
        for site in net.sites:
            site.module.wait_peer(site.gateway.name)
        yield JoinedModules(net, *made)


def nodes(module: Module) -> set[str]:
    """What the stock ``rosnode list`` says there."""
    return set(module.ros.tool("rosnode", "list").split())


def ended(watcher: Process, node: str, since: int, timeout: float = DEADLINE) -> int:
    """Wait until the watcher says that a node is gone; return when, ns of the steady clock."""
    return int(str(watcher.wait_event("gone", timeout, where=lambda e: e["node"] == node, since=since)["ns"]))
