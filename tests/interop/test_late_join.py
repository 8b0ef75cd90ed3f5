"""Late agents and nodes find the earlier ones, in any order of starting."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.interop.modules import Module, flows, whole

if TYPE_CHECKING:
    from lab.bed.namespaces import Lab
    from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]


def test_an_agent_that_joins_late_gets_what_flows_already(
    modules: ModuleFactory, lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    early = b.ros.roscpp("listener", topic="/chatter")
    flows(early)
    host = lab.host("late", 0)
    late = Module(host, agent(host, name="late"), shell(host))
    late.wait_topic("/chatter")
    assert flows(late.ros.rospy("listener", topic="/chatter"))["bad"] == 0
    report = flows(early)
    assert (report["gaps"], report["doubled"]) == (0, 0)


@pytest.mark.parametrize(("role", "client"), [("talker", "roscpp"), ("listener", "rospy")])
def test_nodes_that_wait_for_their_master_find_the_agent(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, client: str, role: str
) -> None:
    first, second = lab.hosts("first", "second")
    agent(first, name="first")
    other = "listener" if role == "talker" else "talker"
    programs = {role: shell(second).node(client, role, topic="/chatter")}
    programs[other] = shell(first).node("roscpp", other, topic="/chatter")
    agent(second, name="second")
    assert flows(programs["listener"], 5)["bad"] == 0


def test_a_seed_reaches_across_a_router(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    near, far = lab.host("near", 0), lab.host("far", 1)
    router = lab.router(0, 1)
    lab.route(near, router)
    lab.route(far, router)
    agent(far, name="far", flags=["--port", "45000"])
    a = agent(near, name="near", flags=["--seed", f"{far.address}:45000"])
    a.wait_peer("far")
    heard = shell(near).roscpp("listener", topic="/chatter", count=20)
    shell(far).roscpp("talker", topic="/chatter", rate=100, count=20, wait=1)
    whole(heard.wait_event("done"), 20)


def test_agents_of_different_domains_do_not_meet(lab: Lab, agent: AgentFactory) -> None:
    hosts = lab.hosts("a", "b", "c")
    a, b, c = (
        agent(host, name=host.name, flags=["--domain", domain])
        for host, domain in zip(hosts, ("7", "7", "8"), strict=True)
    )
    a.wait_peer(b.name)
    assert c.name not in a.peers()
    assert not c.peers()


def test_an_interface_that_comes_after_the_agent_is_used(lab: Lab, agent: AgentFactory) -> None:
    alone = lab.host("alone")
    (b,) = lab.hosts("b")
    late = agent(alone, name="alone")
    agent(b, name="b")
    lab.network(0).plug(alone)
    late.wait_peer("b")
