"""Agents, nodes, cores and cables fail; everything else goes on, and a returning part is found again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import Module, flows

if TYPE_CHECKING:
    from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]


def test_a_killed_agent_is_retracted_and_a_restarted_one_serves_new_nodes_and_its_peer(
    modules: ModuleFactory,
) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", "__name:=before", topic="/chatter", rate=100)
    at_home = a.ros.roscpp("listener", topic="/chatter")
    abroad = b.ros.roscpp("listener", topic="/chatter")
    flows(abroad)
    flows(at_home)
    a.agent.kill()
    b.agent.wait_no_peer("a")
    _wait_no_publisher(b, "/chatter")
    report = flows(at_home, 50)
    assert (report["gaps"], report["doubled"]) == (0, 0)
    a.agent.restart()
    a.agent.wait_peer("b")
    a.ros.roscpp("talker", "__name:=after", topic="/chatter", rate=100, source=2)
    report = abroad.wait_event("report", where=lambda event: "2" in event["sources"])  # type: ignore[operator]
    assert report["bad"] == 0
    assert len([row for row in b.agent.peers() if row == "a"]) == 1


def test_killed_agent_of_the_listening_side_comes_back(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    at_home = a.ros.roscpp("listener", topic="/chatter")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    flows(b.ros.roscpp("listener", topic="/chatter"))
    b.agent.kill()
    b.agent.restart()
    flows(b.ros.roscpp("listener", topic="/chatter"))
    report = flows(at_home)
    assert (report["gaps"], report["doubled"]) == (0, 0)


@pytest.mark.trap(14)
def test_restarted_talker_is_heard_again_by_the_same_listener(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    heard = b.ros.rospy("listener", topic="/chatter")
    talker = a.ros.roscpp("talker", "__name:=speaker", topic="/chatter", rate=100)
    flows(heard)
    talker.kill()
    a.ros.roscpp("talker", "__name:=speaker", topic="/chatter", rate=100, source=2)
    heard.wait_event("report", where=lambda event: "2" in event["sources"])  # type: ignore[operator]
    assert flows(heard)["bad"] == 0


def test_killed_listener_ends_the_demand_and_the_next_one_is_served(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    heard = b.ros.roscpp("listener", topic="/chatter")
    flows(heard)
    assert "Subscribers: None" not in a.ros.tool("rostopic", "info", "/chatter")
    heard.kill()
    eventually(
        lambda: "Subscribers: None" in a.ros.tool("rostopic", "info", "/chatter"), what="the talker has no listener"
    )
    assert flows(b.ros.rospy("listener", topic="/chatter"))["bad"] == 0


def test_a_cable_out_and_in_and_an_interface_off_and_on(modules: ModuleFactory) -> None:
    a, b, c = modules("a", "b", "c")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    b.ros.roscpp("talker", topic="/local", rate=100)
    at_home = b.ros.roscpp("listener", "__name:=home", topic="/local")
    abroad = b.ros.roscpp("listener", "__name:=abroad", topic="/chatter")
    others = c.ros.roscpp("listener", topic="/chatter")
    for heard in (abroad, at_home, others):
        flows(heard)
    b.host.cut()
    b.agent.wait_no_peer("a")
    a.agent.wait_no_peer("b")
    _wait_no_publisher(b, "/chatter")
    b.host.restore()
    report = flows(abroad)
    assert (report["bad"], report["doubled"]) == (0, 0)
    b.host.switch_off()
    b.agent.wait_no_peer("a")
    b.host.switch_on()
    assert flows(abroad)["bad"] == 0
    for one, other in ((a, "b"), (c, "b"), (b, "a"), (b, "c")):
        one.agent.wait_peer(other)
    for unhurt in (at_home, others):
        report = flows(unhurt)
        assert (report["gaps"], report["doubled"]) == (0, 0)


@pytest.mark.trap(18)
def test_frozen_agent_is_retracted_and_comes_back(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    abroad = b.ros.roscpp("listener", topic="/chatter")
    flows(abroad)
    a.agent.freeze()
    b.agent.wait_no_peer("a")
    a.agent.thaw()
    a.agent.wait_peer("b")
    assert flows(abroad)["bad"] == 0


def test_a_peer_that_ends_in_order_leaves_nothing(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    b.wait_topic("/chatter")
    assert a.agent.sockets()
    assert a.agent.terminate() == 0
    assert a.agent.sockets() == []
    b.wait_no_topic("/chatter", 3.0)


def _wait_no_publisher(module: Module, topic: str) -> None:
    """Wait until a topic has no publisher in a module's graph (a listener there may keep its name alive)."""

    def gone() -> bool:
        with module.ros.start("rostopic", "info", topic) as info:
            info.wait()
            return "Publishers: None" in info.output or "Unknown topic" in info.output

    eventually(gone, what=f"no publisher of {topic} at {module.name}")
