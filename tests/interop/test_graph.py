"""The graph of each module has the nodes of all with what they subscribe to, as that of one roscore would."""

from __future__ import annotations

import re

import pytest

from lab.bed.processes import eventually
from tests.interop.conftest import ModuleFactory
from tests.interop.modules import Module, flows, whole

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

PREFIX = """
[[peer]]
name = "base"
prefix = "/{peer}"
deny = ["/**/private"]
"""


def subscribers(module: Module, topic: str) -> set[str]:
    """What the stock ``rostopic info`` says of a topic's subscribers; empty for an unknown topic."""
    said = module.ros.tool("rostopic", "info", topic).partition("Subscribers:")[2]
    return set(re.findall(r"\* (\S+) \(http", said))


def wait_subscribers(module: Module, topic: str, *nodes: str) -> None:
    eventually(
        lambda: subscribers(module, topic) == set(nodes) if topic in module.topics() else not nodes,
        what=f"{nodes} as the subscribers of {topic} at {module.name}",
    )


@pytest.mark.parametrize("client", ["rospy", "roscpp"])
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
