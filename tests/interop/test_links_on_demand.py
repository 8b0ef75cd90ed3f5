"""Four modules that keep links on demand only: stock nodes and tools do not notice that no link stands."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import Module, flows
from tests.interop.ros import PYTHON, lacks

if TYPE_CHECKING:
    from lab.bed.namespaces import Lab
    from tests.interop.conftest import AgentFactory, ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(420)]

CONFIG = "[mesh]\nfull_mesh_up_to = 2\n"
SWITCH = """
import rospy
from std_srvs.srv import SetBool
rospy.init_node("switch")
service = rospy.Service("/switch", SetBool, lambda request: (request.data, "on"))
print("up", flush=True)
rospy.spin()
"""
SOON = 90.0
"""Seconds in which links that nothing needs are parked, on a busy machine too; the protocol takes 20 to 30."""


def states(module: Module) -> dict[str, str]:
    """The state of each peer, by name."""
    return {peer.name: peer.state for peer in module.agent.snapshot().peers}


def all_parked(*modules: Module) -> bool:
    """Whether no two of these have a link, though each knows all others."""
    return all(states(one) == {other.name: "parked" for other in modules if other is not one} for one in modules)


def offers(module: Module, service: str) -> bool:
    """Whether the stock ``rosservice list`` shows a service here."""
    return service in module.ros.tool("rosservice", "list").split()


def address_of(module: Module, peer: str) -> str:
    """The address of a peer as an agent knows it; empty if it does not know the peer."""
    return next((str(row.guid).partition(":")[0] for row in module.agent.snapshot().peers if row.name == peer), "")


def wait_parked(*modules: Module) -> None:
    eventually(partial(all_parked, *modules), SOON, what="every link is parked", every=1.0)


@pytest.fixture
def modules(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> list[Module]:
    hosts = lab.hosts("a", "b", "c", "d")
    return [Module(host, agent(host, name=host.name, config=CONFIG), shell(host)) for host in hosts]


def test_links_park_and_everything_of_a_parked_peer_works_at_once(modules: list[Module]) -> None:
    a, b, c, d = modules
    for client, module in (("rospy", a), ("roscpp", d)):
        module.ros.node(client, "talker", f"__name:=talker_{module.name}", topic=f"/chatter_{module.name}", rate=100)
    a.ros.tool("rosparam", "set", "/speed", "1.5")
    for module in modules:
        for topic in ("/chatter_a", "/chatter_d"):
            module.wait_topic(topic)
    wait_parked(*modules)

    code, listed = b.agent.rmpa("peer", "list")
    assert code == 0
    assert listed.count("parked") >= 3, listed
    assert "links on demand (4 modules, more than mesh.full_mesh_up_to = 2)" in listed
    assert {"/chatter_a", "/chatter_d"} <= b.topics()
    assert "/rmpa/a/talker_a" in b.ros.tool("rostopic", "info", "/chatter_a")
    assert states(b)["a"] == "parked", "to look at the graph needs no link"

    assert "data:" in b.ros.tool("rostopic", "echo", "-n", "1", "/chatter_a")
    assert b.agent.rmpa("param", "get", "--peer", "d", "/rosversion")[0] == 0
    assert b.agent.rmpa("param", "get", "--peer", "a", "/speed") == (0, "1.5")
    code, answered = c.agent.rmpa("peer", "ping", "d", "-c", "1")
    assert code == 0, answered
    loggers = c.ros.tool("rosservice", "list")
    assert "/talker_c" not in loggers

    for client, module in (("rospy", c), ("roscpp", b)):
        heard = module.ros.node(client, "listener", "__name:=heard_" + module.name, topic="/chatter_d")
        report = flows(heard, 100)
        assert (report["gaps"], report["doubled"]) == (0, 0), "the link stays for as long as the route is open"
        heard.end()
    wait_parked(*modules)

    a.ros.node("roscpp", "talker", "__name:=late", topic="/late", rate=10)
    for module in (b, c, d):
        module.wait_topic("/late", 20.0)

    wait_parked(*modules)
    d.agent.kill()
    for module in (a, b, c):
        module.wait_no_topic("/chatter_d", 30.0)
        assert "d" not in states(module) or states(module)["d"] != "parked"


def test_a_parked_module_that_is_cut_off_goes_and_comes_back(modules: list[Module]) -> None:
    a, b, c, d = modules
    a.ros.node("rospy", "talker", topic="/chatter", rate=50)
    for module in modules:
        module.wait_topic("/chatter")
    wait_parked(*modules)
    a.host.cut()
    for module in (b, c, d):
        module.wait_no_topic("/chatter", 60.0)
    a.host.restore()
    for module in (b, c, d):
        module.wait_topic("/chatter", 60.0)
    flows(c.ros.node("roscpp", "listener", topic="/chatter"))
    assert states(b).keys() == {"a", "c", "d"}


@pytest.mark.skipif(bool(lacks("actionlib")), reason=lacks("actionlib"))
def test_services_actions_and_parameters_of_parked_peers_are_served_at_once(modules: list[Module]) -> None:
    a, b, c, d = modules
    switch = a.ros.start(PYTHON, "-c", SWITCH)
    switch.wait_for("up")
    d.ros.roscpp("action_server", name="server")
    for module in (a, d):
        module.ros.tool("rosparam", "set", "/wheels", module.name)
    for module in (b, c):
        module.wait_topic("/count/status")
        eventually(partial(offers, module, "/switch"), what=f"/switch in the graph of {module.name}")
    wait_parked(*modules)

    client = b.ros.rospy("action_client", name="client", commands=True)
    callers = [module.ros.start("rosservice", "call", "/switch", "true") for module in (b, c, c)]
    assert c.agent.rmpa("param", "get", "--peer", "d", "/wheels") == (0, "d")
    assert c.agent.rmpa("param", "get", "--peer", "a", "/wheels") == (0, "a")
    for caller in callers:
        assert caller.wait(SOON) == 0, caller.output
        assert "success: True" in caller.output
    client.tell("server 20")
    assert client.wait_event("server", 30.0)["found"]
    client.tell("send 3")
    done = client.wait_event("done")
    assert (done["state"], done["result"]) == ("SUCCEEDED", 3)


def test_a_parked_peer_with_another_address_is_heard_at_once(modules: list[Module]) -> None:
    """As after another lease of DHCP: its agent takes a new GUID, and says goodbye under the former one."""
    a, b, c, _ = modules
    a.ros.rospy("talker", topic="/chatter", rate=50)
    for module in (b, c):
        module.wait_topic("/chatter")
    wait_parked(*modules)
    interface = a.host.cables[0].interface
    a.host.ip("address", "del", f"{a.host.address}/24", "dev", interface)
    a.host.ip("address", "add", "10.77.0.77/24", "brd", "+", "dev", interface)
    flows(b.ros.roscpp("listener", topic="/chatter"), 10, SOON)
    eventually(lambda: address_of(c, "a") == "10.77.0.77", SOON, what="the new address is known everywhere")
    assert "data:" in c.ros.tool("rostopic", "echo", "-n", "1", "/chatter")
