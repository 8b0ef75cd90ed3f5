"""``rmpa gateway`` as a user starts it, and two sites behind NAT that a router joins.

::

     arm ──┐ 10.77.1.0/24                                   10.77.1.0/24 ┌── base
     more ─┼─ switch ── NAT ── 10.77.0.0/24 ── fleet ── NAT ── switch ───┼─ more
     gateway┘  "warehouse"                    (router)          "yard"   └ gateway

Both sites have the same addresses, as sites behind NAT do.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

from lab.bed.agents import RMPA, Agent
from lab.bed.processes import CommandFailed, Process, eventually
from rmpa.observe.control_client import GATEWAY_REPORT, ControlClient, choose_agent

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from contextlib import ExitStack

    from lab.bed.namespaces import Host, Lab

# Zenoh's usual port.
ROUTER_PORT: Final = 7447
# The mesh port of the router of secured sites, which lets modules of all sites join.
AUTHORITY_PORT: Final = 40001
# Where ``scripts/install-ros2`` keeps a venv for each distribution.
_ROS2: Final = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"), "rmpa", "ros2")
# The third byte of the addresses at every site.
SUBNET: Final = 1


@dataclass
class GatewayProcess(Agent):
    """One ``rmpa gateway`` and the commands against it; ``flags`` are its options, the rest is as of ``Agent``."""

    @property
    def command(self) -> list[str]:
        """The command of rmpa that it runs; a gateway's core has any free port."""
        return ["gateway"]

    def report(self) -> dict[str, object]:
        """What it joins, and its session.

        Raises:
            UnreachableError: It does not answer.
        """
        with ControlClient(choose_agent(self.env, self.name).path) as client:
            return client.call(GATEWAY_REPORT, dict[str, object])

    def half(self) -> int:
        """The process id of its half in ROS 2, while that runs."""
        children = psutil.Process(self.pid).children(recursive=True)
        return next(each.pid for each in children if any("half.child" in word for word in each.cmdline()))


def python_of(distribution: str) -> Path:
    """The Python of a distribution of ROS 2, which may not be there."""
    return _ROS2 / distribution / "bin" / "python"


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


@dataclass(frozen=True, slots=True)
class Site:
    """One site with one module and one gateway, each on a host of its own."""

    network: SiteNetwork
    module: Agent
    gateway: GatewayProcess

    @property
    def name(self) -> str:
        """The site's name."""
        return self.network.name


class JoinedSites:
    """Sites behind NAT and the router that joins them; all of it ends with ``stack``.

    Args:
        lab: Empty.
        home: Existing directory for logs and configurations.
        stack: Ends the processes.
        modules: The module of each site by the site's name.
        log_level: Of every agent and gateway.
        config: Text of every gateway's ``rmpa.toml``.
        secured: The ``rmpa.toml`` of each site, which its module and its gateway share, and of the router, by the
            name ``fleet``: the router is the authority of a secured mesh, and all others join it by a token from
            behind NAT. ``None``: without trust, by ``--insecure``.
    """

    def __init__(
        self,
        lab: Lab,
        home: Path,
        stack: ExitStack,
        modules: Mapping[str, str],
        *,
        log_level: str = "debug",
        config: str = "",
        secured: Mapping[str, str] | None = None,
    ) -> None:
        self._lab, self._home, self._stack, self._level = lab, home, stack, log_level
        self._config, self._secured = config, secured
        self.fleet, networks = site_networks(lab, *modules)
        flags = ["--router", "--listen", f"{self._protocol}/0.0.0.0:{ROUTER_PORT}"]
        flags += ["--insecure"] if secured is None else ["--port", str(AUTHORITY_PORT)]
        text = secured["fleet"] if secured is not None else ""
        self.router = GatewayProcess(self.fleet, home, name="fleet", log_level=log_level, flags=flags, config=text)
        started: list[Agent] = [self.router]
        self.sites: list[Site] = []
        for network, module in zip(networks, modules.values(), strict=True):
            text = secured[network.name] if secured is not None else ""
            agent = Agent(network.host(lab, module), home, name=module, log_level=log_level, config=text)
            gateway = self._gateway(network, f"{network.name}_gateway")
            self.sites.append(Site(network, agent, gateway))
            started += [agent, gateway]
        if secured is not None:
            command(self.router, "trust", "init", "--name", self.router.name)
        for agent in started:
            if secured is not None and agent is not self.router:
                self.join(agent)
            self._start(agent)
            if agent is self.router:
                agent.wait_ready()  # others join at it
        for agent in started[1:]:
            agent.wait_ready()
        if secured is not None:
            self._wait_settled()

    def _wait_settled(self) -> None:
        """Wait until the router's session names all that have joined: it is opened again for that, and links fall."""

        def settled() -> bool:
            report = self.router.report()
            return report["zid"] != "" and not report["stale"]

        eventually(settled, what="a session of the router that names all members")

    @property
    def endpoint(self) -> str:
        """Where gateways connect to the router."""
        return f"{self._protocol}/{self.fleet.address}:{ROUTER_PORT}"

    @property
    def _protocol(self) -> str:
        return "tcp" if self._secured is None else "tls"

    def join(self, agent: Agent) -> None:
        """Make an agent that does not run a member of the secured mesh, by a token of the router, as a user does."""
        place = f"{self.fleet.address}:{AUTHORITY_PORT}"
        invite = ("--no-wait", "--name", self.router.name, "--module", agent.name, "--address", place)
        token = next(word for word in command(self.router, "trust", "invite", *invite).split() if "rmpa1-" in word)
        command(agent, "trust", "join", "--name", agent.name, token)

    def second_gateway(self, site: Site, rank: int = 200) -> GatewayProcess:
        """One more gateway at a site; ready when this returns."""
        made = self._gateway(site.network, f"{site.name}_second", ["--rank", str(rank)])
        self._start(made)
        made.wait_ready()
        return made

    def gateway_of(self, site: str, network: SiteNetwork, name: str, config: str = "") -> GatewayProcess:
        """A gateway of any site on a host of its own in a site's network; it does not run, and has not joined."""
        flags = ["--site", site, "--connect", self.endpoint]
        host = network.host(self._lab, name)
        made = GatewayProcess(host, self._home, name=name, log_level=self._level, flags=flags, config=config)
        self._stack.enter_context(made)
        return made

    def _gateway(self, network: SiteNetwork, name: str, flags: Sequence[str] = ()) -> GatewayProcess:
        flags = ["--site", network.name, "--connect", self.endpoint, *flags]
        text = self._config
        if self._secured is None:
            flags.append("--insecure")
        else:
            text += self._secured[network.name]
        host = network.host(self._lab, name)
        return GatewayProcess(host, self._home, name=name, log_level=self._level, flags=flags, config=text)

    def _start(self, agent: Agent) -> None:
        self._stack.enter_context(agent)
        agent.start()


def command(agent: Agent, *words: str) -> str:
    """Run an ``rmpa`` command on an agent's host; return what it prints.

    Raises:
        CommandFailed: Its exit code is not 0.
    """
    with Process(agent.host.command([RMPA, *words]), env=agent.env, name=f"rmpa {words[0]}") as process:
        if code := process.wait():
            raise CommandFailed(f"rmpa {' '.join(words)} on {agent.host.name}: {code}\n{process.output}")
        return process.output
