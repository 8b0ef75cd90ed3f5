"""``rmpa gateway`` as a user starts it, and two sites behind NAT that a router joins.

::

     arm ──┐ 10.77.1.0/24                                   10.77.1.0/24 ┌── base
     more ─┼─ switch ── NAT ── 10.77.0.0/24 ── fleet ── NAT ── switch ───┼─ more
     gateway┘  "warehouse"                    (router)          "yard"   └ gateway

Both sites have the same addresses, as sites behind NAT do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lab.bed.agents import RMPA, Agent

if TYPE_CHECKING:
    from lab.bed.namespaces import Host, Lab

ROUTER_PORT: Final = 7447
"""Zenoh's usual port."""
SUBNET: Final = 1
"""The third byte of the addresses at every site."""


@dataclass
class GatewayProcess(Agent):
    """One ``rmpa gateway`` and the commands against it; ``flags`` are its options, the rest is as of ``Agent``."""

    @property
    def argv(self) -> list[str]:
        """The command line on its host."""
        words = [str(RMPA), "gateway", "--name", self.name, "--log-level", self.log_level]
        if self.multicast:
            words += ["--multicast", self.multicast]
        if not self.host.namespace:
            words += ["--interface", "lo"]  # tests keep to this machine
        if self.config:
            path = self.home / f"{self.name}.toml"
            path.write_text(self.config, encoding="utf-8")
            words += ["--config", str(path)]
        return self.host.command([*self.prefix, *words, *self.flags])


@dataclass(frozen=True, slots=True)
class SiteNetwork:
    """One site's network.

    Args:
        name: The site's.
        network: Its number in the lab.
        nat: Its router; cable 1 is the uplink.
    """

    name: str
    network: int
    nat: Host

    def host(self, lab: Lab, name: str) -> Host:
        """A new host at this site."""
        made = lab.host(name, self.network)
        lab.route(made, self.nat)
        return made

    def cut(self) -> None:
        """Pull the uplink out."""
        self.nat.cut(1)

    def restore(self) -> None:
        """Put it in again."""
        self.nat.restore(1)


def site_networks(lab: Lab, *names: str) -> tuple[Host, list[SiteNetwork]]:
    """The host of the router in the outer network (number 0), and a network behind NAT for each name."""
    fleet = lab.host("fleet", 0)
    sites = []
    for number, name in enumerate(names, 1):
        lab.network(number, subnet=SUBNET)
        sites.append(SiteNetwork(name, number, lab.nat(f"nat{number}", number, 0)))
    return fleet, sites


def router_flags() -> list[str]:
    """Options of the router on the host of ``site_networks``."""
    return ["--router", "--listen", f"tcp/0.0.0.0:{ROUTER_PORT}", "--insecure"]


def site_flags(site: str, fleet: Host) -> list[str]:
    """Options of a site's gateway that connects to that router."""
    return ["--site", site, "--connect", f"tcp/{fleet.address}:{ROUTER_PORT}", "--insecure"]
