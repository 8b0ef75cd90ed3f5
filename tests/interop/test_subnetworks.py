"""Two networks: joined by a router that forwards no multicast, or by modules that have a cable in each."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from tests.interop.modules import Module, flows
from tests.interop.processes import eventually

if TYPE_CHECKING:
    from tests.interop.conftest import AgentFactory, ShellFactory
    from tests.interop.namespaces import Lab

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]


def full_mesh(*modules: Module) -> None:
    """Wait until each of these is linked with all others."""
    for module in modules:
        names = {other.name for other in modules if other is not module}
        eventually(lambda m=module, n=names: n <= linked(m), what=f"{module.name} linked with {names}", every=0.2)


def linked(module: Module) -> set[str]:
    """The peers that a module has live links to."""
    return {name for name, row in module.agent.peers().items() if row["state"] == "linked"}


def test_one_seed_and_gossip_join_two_networks_behind_a_router(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    """Only ``a`` knows one address of the other side; when that one is gone, who starts is still found by all."""
    router = lab.router(0, 1)
    hosts = {name: lab.host(name, network) for name, network in (("a", 0), ("b", 0), ("c", 1), ("d", 1))}
    for host in hosts.values():
        lab.route(host, router)
    flags = {"a": ["--seed", f"{hosts['c'].address}:45000"], "c": ["--port", "45000"]}
    a, b, c, d = (
        Module(host, agent(host, name=name, flags=flags.get(name, [])), shell(host)) for name, host in hosts.items()
    )
    full_mesh(a, b, c, d)
    heard = d.ros.roscpp("listener", topic="/chatter")
    b.ros.roscpp("talker", topic="/chatter", rate=100)
    flows(heard)
    assert "/rmpa/b/talker" in d.ros.tool("rosnode", "list")

    c.agent.kill()
    b.agent.restart()
    full_mesh(a, b, d)
    steady = d.ros.roscpp("listener", "__name:=steady", topic="/steady")
    a.ros.roscpp("talker", "__name:=steady_talker", topic="/steady", rate=100)
    flows(steady)
    c.agent.restart()
    full_mesh(a, b, c, d)
    report = flows(steady)
    assert (report["gaps"], report["doubled"]) == (0, 0)


def test_a_peer_with_two_cables_is_reached_by_the_one_that_is_left(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    """Two modules share two networks; each cable in turn is out, and what is reliable loses nothing."""
    config = '[[contract]]\ntopics = ["/chatter"]\nreliability = "reliable"\ndepth = 2000\n'
    hosts = [lab.host(name, 0, 1) for name in ("a", "b")]
    a, b = (Module(host, agent(host, name=host.name, config=config), shell(host)) for host in hosts)
    full_mesh(a, b)
    heard = b.ros.roscpp("listener", topic="/chatter")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    flows(heard)
    for cable in (0, 1, 0):
        for module in (a, b):
            module.host.cut(cable)
        began = time.monotonic()
        report = flows(heard, 50)
        assert time.monotonic() - began < 10.0
        assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)
        for module in (a, b):
            module.host.restore(cable)
    assert "/chatter" in b.topics()


def test_a_module_whose_first_cable_leads_nowhere_is_found_by_its_second(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    """The GUID of each is of a network that the other cannot reach."""
    hosts = [lab.host("a", 2, 0), lab.host("b", 3, 0)]
    a, b = (Module(host, agent(host, name=host.name), shell(host)) for host in hosts)
    full_mesh(a, b)
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    flows(b.ros.roscpp("listener", topic="/chatter"))
