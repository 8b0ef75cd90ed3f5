"""Names, nodes and parameters of several modules at the stock tools."""

from __future__ import annotations

import json
import re

import pytest

from lab.bed.namespaces import Lab
from lab.bed.processes import eventually
from rmpa.observe.control_client import ControlClient
from rmpa.observe.snapshot import PeerInfo
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module, flows
from tests.interop.ros import lacks

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]
# The same file on every robot: robots leave each other alone.
ROBOT = """
[[peer]]
name = "robot*"
deny = ["/**"]
"""
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


def test_two_machines_with_one_address_are_told_as_a_conflict(lab: Lab, agent: AgentFactory) -> None:
    """Beacons of both come; TCP reaches whichever the ARP cache names, and the other one's port is refused."""
    a, b, c = lab.hosts("a", "b", "c")
    cable = c.cables[0]
    c.ip("address", "del", f"{cable.address}/24", "dev", cable.interface)
    c.ip("address", "add", f"{b.address}/24", "dev", cable.interface)
    seen_by, *_ = agent(a, name="a"), agent(b, name="b"), agent(c, name="c")

    def conflicts() -> list[PeerInfo]:
        with ControlClient(seen_by.sockets()[0]) as client:
            return [peer for peer in client.snapshot().peers if peer.state == "conflict"]

    eventually(conflicts, what="the conflict", every=0.5)
    assert all(f"its address {b.address} is also that of peer" in peer.conflicts[0] for peer in conflicts())


def test_nodes_are_pinged_and_ended_across_modules(modules: ModuleFactory) -> None:
    """What stock tools and ours do to the nodes of two modules."""
    a, b = modules("a", "b")
    for name in ("talker", "other"):
        b.ros.rospy("talker", f"__name:={name}", topic=f"/{name}", rate=20)
    a.ros.roscpp("talker", "__name:=mine", topic="/mine", rate=20)
    for name in ("talker", "other"):
        a.wait_topic(f"/{name}")
    b.wait_topic("/mine")
    listed = a.agent.rmpa("node", "list")[1].split()
    assert {"/mine", "b:/talker", "b:/other", "/rosout", "/rmpa"} <= set(listed)

    def rosout() -> str:
        code, said = a.agent.rmpa("node", "info", "/rosout", "--json")[:2]
        return "" if code else str(json.loads(said).get("uri", ""))  # it is away until it is started anew

    before = rosout()
    assert "killed" in a.ros.tool("rosnode", "kill", "-a")
    b.wait_no_topic("/mine")
    eventually(lambda: rosout() not in {"", before}, what="another /rosout")
    assert {"/talker", "/other"} <= b.topics(), "kill -a ends the nodes of this module alone"
    assert a.agent.rmpa("node", "ping", "b:/talker", "-c", "1")[0] == 0
    assert {"/talker", "/rosout_agg"} <= a.topics()

    ping = a.ros.start("rosnode", "ping", "/rmpa/b/talker", name="ping")
    ping.wait_for("xmlrpc reply from http://127")
    code, out = a.agent.rmpa("node", "kill", "b:/talker")
    assert (code, out.strip()) == (0, "killed b:/talker")
    b.wait_no_topic("/talker")
    ping.wait()
    assert "connection to [/rmpa/b/talker] failed" in ping.output, "as of any node that is gone"

    def killed() -> bool:
        a.ros.tool("rosnode", "kill", "/rmpa/b/other")  # refused as long as it may belong to kill -a
        return "/other" not in b.topics()

    eventually(killed, what="the end of b's /other", every=3.0)
    a.wait_no_topic("/other")
