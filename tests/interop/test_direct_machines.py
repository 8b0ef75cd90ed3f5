"""Direct transport elsewhere: two modules on one machine, three modules, a real roscore, hundreds of topics."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import Module, flows
from tests.interop.transports import (
    AUTO,
    RELAY,
    connections,
    heard,
    in_order,
    links,
    on_the_network,
    reload,
    unbroken,
    wait_direct,
    wait_relayed,
)

if TYPE_CHECKING:
    from lab.bed.namespaces import Host, Lab
    from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

EXTERNAL: Final = ("--core", "external")


def two_on_one(host: Host, agent: AgentFactory, shell: ShellFactory) -> tuple[Module, Module]:
    """Two linked modules on one host, with their cores at two ports."""
    first, second = (
        Module(host, agent(host, name=name, core_port=port, config=AUTO), shell(host, port))
        for name, port in (("a", 11311), ("b", 11312))
    )
    first.agent.wait_peer("b")
    second.agent.wait_peer("a")
    return first, second


@pytest.mark.parametrize(("client", "bound"), [("roscpp", True), ("rospy", False)])
def test_modules_of_one_machine_are_direct_over_loopback(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, client: str, *, bound: bool
) -> None:
    a, b = two_on_one(lab.host("both", 0), agent, shell)
    if not bound:
        on_the_network(a, b)
    talker = a.ros.node(client, "talker", topic="/chatter", rate=100)
    # A publisher of the module itself, which the subscriber hears all the time.
    b.ros.node(client, "talker", topic="/chatter", rate=100, source=2)
    listener = b.ros.node(client, "listener", topic="/chatter")
    wait_direct(listener, talker)
    assert {
        own.rpartition(":")[0] for own, other in connections(talker) if (other, own) in connections(listener)
    } == {"127.0.0.1"}
    listener.wait_event("report", where=lambda event: set(event["sources"]) == {"1", "2"})  # type: ignore[call-overload]
    home = str(flows(listener)["sources"])
    reload(b, AUTO + RELAY)
    in_order(wait_relayed(listener, talker))
    reload(b, AUTO)
    report = wait_direct(listener, talker)
    in_order(report)
    assert report["sources"]["2"]["gaps"] == 0, home  # type: ignore[index]
    a.agent.kill()
    unbroken_since = flows(listener, 200)
    in_order(unbroken_since)


def test_three_modules_are_direct_with_each_other(modules: ModuleFactory) -> None:
    """Each publishes and subscribes one topic: each subscriber has one connection to each publisher, its own too."""
    made = modules("a", "b", "c", config=AUTO)
    on_the_network(*made)
    clients = ("roscpp", "rospy", "roscpp")
    talkers = [
        module.ros.node(client, "talker", topic="/chatter", rate=50, source=number)
        for number, (module, client) in enumerate(zip(made, clients, strict=True), 1)
    ]
    listeners = [
        module.ros.node(client, "listener", topic="/chatter")
        for module, client in zip(made, reversed(clients), strict=True)
    ]
    for listener in listeners:
        for talker in talkers:
            eventually(lambda s=listener, p=talker: links(s, p) == 1, what="one connection to each")  # type: ignore[misc]
        report = listener.wait_event("report", where=lambda event: set(event["sources"]) == {"1", "2", "3"})  # type: ignore[call-overload]
        in_order(report)
        begin = flows(listener)
        assert flows(listener, 150)["gaps"] == begin["gaps"]


def test_nodes_of_a_real_roscore_are_direct_if_they_are_on_its_machine(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    """A roscore may have nodes on other machines: the agent cannot see their sockets, so they are relayed."""
    first, second, far = lab.hosts("a", "b", "far")
    ros = shell(first)
    ros.env["ROS_IP"] = first.address  # roscore listens for other machines too
    ros.roscore()
    a = Module(first, agent(first, name="a", flags=EXTERNAL, config=AUTO), ros)
    b = Module(second, agent(second, name="b", config=AUTO), shell(second))
    on_the_network(b)
    a.agent.wait_peer("b")
    elsewhere = shell(far)
    elsewhere.env.update(ROS_IP=far.address, ROS_MASTER_URI=f"http://{first.address}:11311/")
    near = a.ros.rospy("talker", topic="/near", rate=100)
    away = elsewhere.roscpp("talker", topic="/away", rate=100)
    near_heard, away_heard = (b.ros.roscpp("listener", topic=topic) for topic in ("/near", "/away"))
    wait_direct(near_heard, near)
    unbroken(flows(away_heard, 200))
    assert links(away_heard, away) == 0
    # The other way: a subscriber of that roscore.
    talker = b.ros.rospy("talker", topic="/back", rate=100)
    here = a.ros.rospy("listener", topic="/back")
    in_order(wait_direct(here, talker))


def test_two_hundred_topics_of_many_nodes_go_direct_at_once(modules: ModuleFactory) -> None:
    """Four publishers with 50 topics each, and two subscribers of all: 400 connections, and agents that answer."""
    a, b = modules("a", "b", config=AUTO, log_level="info")
    on_the_network(a, b)
    topics = [[f"/flood/n{node}/t{number}" for number in range(50)] for node in range(4)]
    every = [topic for some in topics for topic in some]
    talkers = [a.ros.roscpp("many_talker", topics=",".join(some), rate=2) for some in topics]
    b.wait_topic(every[-1], 60.0)
    listeners = [b.ros.roscpp("many_listener", topics=",".join(every)) for _ in range(2)]
    slowest = 0.0

    def all_direct() -> bool:
        nonlocal slowest
        begin = time.monotonic()
        code, _ = b.agent.rmpa("peer", "list", "--json")
        slowest = max(slowest, time.monotonic() - begin)
        assert code == 0
        return all(links(listener, talker) == 50 for listener in listeners for talker in talkers)

    eventually(all_direct, 60.0, what="400 connections", every=0.2)
    assert slowest < 10.0
    for listener in listeners:
        for report in heard(listener, every, 4).values():
            in_order(report)
