"""Two sites behind NAT, each with a module, a gateway and a ROS user's shell, and the router between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lab.bed.gateways import JoinedSites, Site
from lab.bed.processes import DEADLINE, Process
from tests.interop.modules import Module

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from contextlib import ExitStack
    from pathlib import Path

    from lab.bed.namespaces import Host, Lab
    from tests.interop.ros import Ros

MODULES: Final = {"warehouse": "arm", "yard": "base"}
"""The module of each site."""


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


def join(
    lab: Lab,
    home: Path,
    shell: Callable[[Host], Ros],
    stack: ExitStack,
    config: str = "",
    secured: Mapping[str, str] | None = None,
) -> JoinedModules:
    """Start all, the gateways with this ``rmpa.toml``; return when each module's agent is linked with its gateway.

    ``secured`` is as of ``JoinedSites``.
    """
    net = JoinedSites(lab, home, stack, MODULES, config=config, secured=secured)
    made = [Module(site.module.host, site.module, shell(site.module.host)) for site in net.sites]
    for site in net.sites:
        site.module.wait_peer(site.gateway.name)
    return JoinedModules(net, *made)


def nodes(module: Module) -> set[str]:
    """What the stock ``rosnode list`` says there."""
    return set(module.ros.tool("rosnode", "list").split())


def ended(watcher: Process, node: str, since: int, timeout: float = DEADLINE) -> int:
    """Wait until the watcher says that a node is gone; return when, ns of the steady clock."""
    return int(str(watcher.wait_event("gone", timeout, where=lambda e: e["node"] == node, since=since)["ns"]))
