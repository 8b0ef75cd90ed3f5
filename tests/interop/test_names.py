"""Robots that are all alike, and one computer that works with each of them: names and policy for single peers."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import Module, flows
from tests.interop.ros import lacks

if TYPE_CHECKING:
    from lab.bed.namespaces import Lab
    from tests.interop.conftest import AgentFactory, ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

ROBOT = """
[[peer]]
name = "robot*"
deny = ["/**"]
"""
"""The same file on every robot: robots leave each other alone."""
PC = """
[[peer]]
name = "robot*"
prefix = "/{peer}"
remap_in = { "/left/**" = "/{peer}/arm/**", "/both" = "/{peer}/text" }
deny = ["/**/private"]
"""


def fleet(lab: Lab, agent: AgentFactory, shell: ShellFactory, *names: str) -> list[Module]:
    """A computer and its robots, linked."""
    configs = {name: PC if name == "pc" else ROBOT for name in names}
    hosts = lab.hosts(*names)
    made = [Module(host, agent(host, name=host.name, config=configs[host.name]), shell(host)) for host in hosts]
    for one in made[1:]:
        made[0].agent.wait_peer(one.name)
        one.agent.wait_peer("pc")
    return made


@pytest.mark.skipif(bool(lacks("actionlib")), reason=lacks("actionlib"))
def test_one_computer_works_with_two_identical_robots(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    pc, *robots = fleet(lab, agent, shell, "pc", "robot1", "robot2")
    hearing = {}
    for number, robot in enumerate(robots, 1):
        robot.ros.roscpp("talker", "__name:=base", topic="/odom", rate=50, source=number)
        robot.ros.roscpp("talker", "__name:=arm", topic="/left/joints", rate=50, source=number)
        robot.ros.roscpp("talker", "__name:=secret", topic="/private", rate=50)
        robot.ros.rospy("action_server", name="counter", action="/count")
        robot.ros.roscpp("worker", "__name:=tool", service="/work")
        hearing[robot.name] = robot.ros.rospy("listener", name="wheels", topic="/cmd_vel")
    robots[0].ros.rospy("talker", "__name:=text", topic="/both", rate=20, type="String")
    robots[1].ros.roscpp("talker", "__name:=bytes", topic="/both", rate=20)

    # What they publish is apart here, each under its robot's name, and says whence it comes.
    for number, client, topic in ((1, "rospy", "/robot1/odom"), (2, "roscpp", "/robot2/arm/joints")):
        heard = pc.ros.node(client, "listener", f"__name:=hear_robot{number}", topic=topic)
        assert set(flows(heard)["sources"]) == {str(number)}  # type: ignore[call-overload] # a dict, as JSON has it
    info = pc.ros.tool("rostopic", "info", "/robot1/odom")
    assert re.search(r"Publishers:\s+\* /rmpa/robot1/base \(http", info), info
    nodes = pc.ros.tool("rosnode", "list").split()
    assert {f"/rmpa/{robot.name}/{node}" for robot in robots for node in ("base", "arm", "counter")} <= set(nodes)
    topics = pc.topics()
    assert {"/robot1/text", "/robot2/text"} <= topics
    assert not {"/robot1/both", "/robot2/both", "/odom", "/left/joints"} & topics
    assert not [topic for topic in topics if "private" in topic]

    # What the computer says to one of them reaches that one alone.
    pc.ros.rospy("talker", name="driver", topic="/robot1/cmd_vel", rate=50)
    flows(hearing["robot1"])
    assert "/cmd_vel" in robots[0].topics()
    info = robots[1].ros.tool("rostopic", "info", "/cmd_vel")
    assert "Publishers: None" in info, info
    assert not hearing["robot2"].events("first")

    # Actions and services go by the same names.
    goals = pc.ros.rospy("action_client", name="client", action="/robot2/count", commands=True)
    goals.tell("server 20")
    assert goals.wait_event("server", 30.0)["found"] is True
    goals.tell("send 5")
    assert (done := goals.wait_event("done"))["state"] == "SUCCEEDED", done
    assert done["result"] == 5
    eventually(lambda: "/robot2/work" in pc.ros.tool("rosservice", "list").split(), what="the robot's service")
    caller = pc.ros.roscpp("caller", service="/robot2/work", wait=True, commands=True)
    caller.wait_event("there")
    caller.tell("echo 0 100 3 once")
    assert caller.wait_event("done")["same"] == 3
    assert pc.ros.tool("rosservice", "node", "/robot2/work").strip() == "/rmpa/robot2/tool"

    # The robots see nothing of each other.
    assert not [node for node in robots[1].ros.tool("rosnode", "list").split() if node.startswith("/rmpa/robot1")]
