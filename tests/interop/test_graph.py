"""The graph of each module has the nodes of all with what they subscribe to, as that of one roscore would."""

from __future__ import annotations

import json
import re
from functools import partial
from typing import Final

import pytest

from lab.bed.processes import CommandFailed, eventually
from tests.interop.conftest import ModuleFactory, ShellFactory
from tests.interop.modules import Module, flows, whole
from tests.interop.ros import PYTHON, Ros, free_port

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

PREFIX = """
[[peer]]
name = "base"
prefix = "/{peer}"
deny = ["/**/private"]
"""

# What rqt_graph does to draw its nodes and topics: ROS's own code, of rosgraph.
DRAW: Final = """
import json, rosgraph.impl.graph
graph = rosgraph.impl.graph.Graph()
graph.set_master_stale(5.0)
graph.set_node_stale(5.0)
graph.update()
print(json.dumps([[edge.start.strip(), edge.end.strip()] for edge in graph.nt_edges]))
"""


def drawn(ros: Ros) -> set[tuple[str, str]]:
    """The edges that rqt_graph draws between nodes and topics of the tests, without the names of proxies' modules."""
    edges = json.loads(ros.tool(PYTHON, "-c", DRAW).splitlines()[-1])
    named = {tuple(re.sub("^/rmpa/[^/]+/", "/", end) for end in edge) for edge in edges}
    return {(start, end) for start, end in named if "/test/" in start + end and "/rmpa" not in (start, end)}


def is_drawn(ros: Ros, edges: set[tuple[str, str]]) -> bool:
    found = drawn(ros)
    print(sorted(found ^ edges))  # shown where the wait is in vain
    return found == edges


def start_all(*shells: Ros) -> None:
    """Start nodes that publish and subscribe to each other's topics, on one module or on three."""
    base, arm, pc = shells
    base.roscpp("listener", "__name:=motors", topic="/test/cmd_vel")
    base.rospy("talker", "__name:=wheels", topic="/test/odom", rate=10)
    arm.rospy("listener", "__name:=planner", topic="/test/odom")
    arm.rospy("listener", "__name:=waiting", topic="/test/goal")
    pc.roscpp("talker", "__name:=driver", topic="/test/cmd_vel", rate=10)
    pc.rospy("listener", "__name:=screen", topic="/test/odom")


def subscribers(module: Module, topic: str) -> set[str]:
    """What the stock ``rostopic info`` says of a topic's subscribers; empty for an unknown topic."""
    try:
        said = module.ros.tool("rostopic", "info", topic)
    except CommandFailed:
        return set()
    return set(re.findall(r"\* (\S+) \(http", said.partition("Subscribers:")[2]))


def wait_subscribers(module: Module, topic: str, *nodes: str) -> None:
    what = f"{nodes} as the subscribers of {topic} at {module.name}"
    eventually(lambda: subscribers(module, topic) == set(nodes), what=what)


@pytest.mark.parametrize("client", ["rospy", pytest.param("roscpp", marks=pytest.mark.long)])
def test_a_topic_that_is_only_subscribed_to_is_known_everywhere(modules: ModuleFactory, client: str) -> None:
    base, pc = modules("a", "b")
    motors = base.ros.node(client, "listener", "__name:=motors", topic="/test/cmd_vel", count=50)
    wait_subscribers(pc, "/test/cmd_vel", f"/rmpa/{base.name}/motors")
    assert pc.ros.tool("rostopic", "type", "/test/cmd_vel").strip() == "std_msgs/UInt8MultiArray"
    assert "/test/cmd_vel" in pc.ros.tool("rosnode", "info", f"/rmpa/{base.name}/motors")
    assert "/test/cmd_vel" in pc.agent.rmpa("topic", "list")[1]
    listed = pc.agent.rmpa("topic", "info", "/test/cmd_vel")[1]
    assert f"/motors of peer {base.name}" in listed

    # A node may connect to it as to one of its own module, and no tool finds anything wrong.
    driver = pc.ros.node(client, "talker", "__name:=driver", topic="/test/cmd_vel", rate=50, count=50, wait=1)
    whole(motors.wait_event("done"), 50)
    said = pc.ros.tool("roswtf")
    assert "should be connected" not in said, said
    assert "unexpected" not in said, said
    driver.end()
    motors.end()
    wait_subscribers(pc, "/test/cmd_vel")


def test_a_publisher_has_the_connections_that_it_had(modules: ModuleFactory) -> None:
    """A third module shows a publisher and a subscriber of two others, and connects neither."""
    a, b, c = modules("a", "b", "c")
    a.ros.rospy("talker", "__name:=scanner", topic="/test/scan", rate=20)
    heard = b.ros.rospy("listener", "__name:=mapper", topic="/test/scan")
    flows(heard)
    wait_subscribers(c, "/test/scan", f"/rmpa/{b.name}/mapper")
    said = a.ros.tool("rosnode", "info", "/scanner")
    assert len(re.findall(r"topic: /test/scan", said)) == 1, said
    (topic,) = (each for each in c.agent.snapshot().topics if each.name == "/test/scan")
    assert [(route.direction, route.state) for route in topic.routes] == [("in", "idle")]
    assert topic.remote_subscribers == (f"{b.name}:/mapper",)


def test_a_subscription_follows_the_rules_and_names_of_its_module(modules: ModuleFactory) -> None:
    base, pc = modules("base", "pc", fresh=True, config="\n")
    base.ros.rospy("listener", "__name:=motors", topic="/cmd_vel")
    base.ros.rospy("listener", "__name:=secret", topic="/private")
    wait_subscribers(pc, "/cmd_vel", "/rmpa/base/motors")
    (pc.agent.home / f"{pc.name}.toml").write_text(PREFIX)
    assert pc.agent.rmpa("reload")[0] == 0
    wait_subscribers(pc, "/base/cmd_vel", "/rmpa/base/motors")
    wait_subscribers(pc, "/cmd_vel")
    assert not [topic for topic in pc.topics() if "private" in topic]

    # It leaves with its module, and comes back with it.
    base.host.cut()
    wait_subscribers(pc, "/base/cmd_vel")
    base.host.restore()
    wait_subscribers(pc, "/base/cmd_vel", "/rmpa/base/motors")


def test_rqt_graph_draws_in_each_module_what_it_draws_of_one_roscore(
    modules: ModuleFactory, shell: ShellFactory
) -> None:
    """By the calls of rqt_graph, which Debian does not have."""
    alone = shell(port=free_port())
    alone.roscore()
    start_all(alone, alone, alone)
    expected = {
        ("/driver", "/test/cmd_vel"), ("/test/cmd_vel", "/motors"), ("/wheels", "/test/odom"),
        ("/test/odom", "/planner"), ("/test/odom", "/screen"),
    }  # fmt: skip
    # It draws connections; a topic without a publisher has none.
    eventually(lambda: is_drawn(alone, expected), what="the graph of one roscore")
    made = modules("a", "b", "c")
    start_all(*(module.ros for module in made))
    for module in made:
        eventually(partial(is_drawn, module.ros, expected), what=f"the whole graph at {module.name}")


@pytest.mark.long
def test_a_lazy_relay_is_still_lazy(modules: ModuleFactory) -> None:
    """topic_tools' relay subscribes while its own topic has a subscriber; a shown one elsewhere is none."""
    pc, base, other = modules("a", "b", "c")
    pc.ros.roscpp("talker", "__name:=camera", topic="/test/image", rate=20)
    pc.wait_topic("/test/image")
    relay = ("/usr/lib/topic_tools/relay", "/test/image", "/test/small", "__name:=lazy", "_lazy:=true")
    pc.ros.start(*relay, name="relay")
    pc.wait_topic("/test/small")
    heard = base.ros.rospy("listener", "__name:=eyes", topic="/test/small")
    flows(heard)
    wait_subscribers(other, "/test/small", f"/rmpa/{base.name}/eyes")
    assert "/lazy" in subscribers(pc, "/test/image")
    heard.end()
    eventually(lambda: "/lazy" not in subscribers(pc, "/test/image"), what="the relay lazy again")
