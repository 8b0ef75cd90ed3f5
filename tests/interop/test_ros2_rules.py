"""Rules of a gateway to ROS 2, with real rclpy: renamed topics without echoes, log messages, rates, and time."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from lab.bed.gateways import python_of
from lab.bed.processes import Process, eventually
from tests.interop.ros2_hall import LONG, Hall, OtherEnd, running_hall

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


pytestmark = [
    pytest.mark.ros,
    pytest.mark.netns,
    pytest.mark.timeout(150),
    pytest.mark.skipif(not python_of("jazzy").exists(), reason="ROS 2 jazzy is not there: scripts/install-ros2"),
]
TEXT = "std_msgs/msg/String"
CLOCK = "rosgraph_msgs/msg/Clock"
LATE = """
import rospy
rospy.init_node("late")
while not rospy.Time.now().secs:
    rospy.rostime.wallsleep(0.1)
print("it is", rospy.Time.now().secs)
"""
SHARED = "[time]\nshare = true\n"
RULES = """
[time]
follow = "robot"
share = true
""" + "".join(
    f'[[gateway.rule]]\nsites = ["ros2"]\nnames = ["{names}"]\n{more}\n'
    for names, more in (
        ("/rosout", 'name = "/{site}{name}"'),
        ("/below/**", 'name = "/two{name}"'),
        ("/exact", 'name = "/moved"'),
        ("/first", 'name = "/taken"'),
        ("/slow/**", "rate = 5"),
    )
)


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    home = tmp_path_factory.mktemp("dds")
    with running_hall(home, SHARED, way="jazzy", gateway_config=RULES) as hall:
        yield hall


@pytest.fixture(scope="module")
def node(hall: Hall) -> OtherEnd:
    return hall.node("other2")


@pytest.fixture(scope="module")
def second(hall: Hall) -> OtherEnd:
    return hall.node("second2")


class Talker:
    """A node of ROS 1 that says what it is told, until a listener has heard it."""

    def __init__(self, hall: Hall, topic: str) -> None:
        self.process = hall.robot.ros.rospy("text_teller", topic=topic, commands=True)
        self.process.wait_event("up", LONG)

    def say(self, text: str) -> None:
        self.process.tell(json.dumps({"data": text}))


def texts(listener: Process, topic: str = "") -> list[str]:
    found = listener.events("heard" if topic else "text")
    return [str(e["data"]) for e in found if not topic or e["topic"] == topic]


@pytest.mark.parametrize(
    ("there", "here"),
    [("/below/a", "/two/below/a"), ("/exact", "/moved"), ("/first", "/taken"), ("/same", "/same")],
)
def test_under_each_name_a_message_arrives_once_and_never_comes_back(
    hall: Hall, node: OtherEnd, second: OtherEnd, there: str, here: str
) -> None:
    """Talkers and listeners of both names on both sides."""
    names = list(dict.fromkeys((there, here)))
    talkers = {name: Talker(hall, name) for name in names}
    sends = dict(zip(names, (node, second), strict=False))
    listeners = {name: hall.robot.ros.rospy("listener", topic=name, type="String") for name in names}
    for name in names:
        listeners[name].wait_event("up", LONG)
        node.do("subscribe", topic=name)
        sends[name].do("publish", topic=name, text="begin", count=1)

    def linked() -> bool:
        for name in names:
            talkers[name].say(f"begin {name}")
            sends[name].do("publish", topic=name, text=f"begin2 {name}", count=1)
        there_all = all(f"begin {name}" in texts(node.process, name) for name in names)
        return there_all and all(f"begin2 {name} 1" in texts(listeners[here]) for name in names)

    eventually(linked, LONG, what="messages both ways", every=0.3)
    for number in range(8):  # rospy drops what is beyond its queue of ten
        for name in names:
            talkers[name].say(f"one {name} {number}")
    for name in names:
        sends[name].do("publish", topic=name, text=f"two {name}", count=20, rate=100)
    for name in names:
        node.process.wait_event("heard", LONG, where=lambda e, n=name: e["data"] == f"one {n} 7")  # type: ignore[misc]
        listeners[here].wait_event("text", LONG, where=lambda e, n=name: e["data"] == f"two {n} 20")  # type: ignore[misc]
    for name in names:  # what would come back is on its way before these
        talkers[name].say(f"end {name}")
        node.process.wait_event("heard", LONG, where=lambda e, n=name: e["data"] == f"end {n}")  # type: ignore[misc]
    from1 = {name: [f"one {name} {number}" for number in range(8)] for name in names}
    from2 = [f"two {name} {number}" for name in names for number in range(1, 21)]
    for name in names:
        heard = [text for text in texts(node.process, name) if text.startswith("one ")]
        assert heard == from1[name], f"ROS 1's {name} in ROS 2"
        heard = [text for text in texts(listeners[name]) if text.startswith("one ")]
        assert heard == from1[name], f"ROS 1's {name} in ROS 1"
        heard = [text for text in texts(listeners[name]) if text.startswith("two ")]
        assert sorted(heard) == (sorted(from2) if name == here else []), f"ROS 2's at {name} in ROS 1"
    for name in names:
        sends[name].do("unpublish", topic=name)


def echoed(hall: Hall, topic: str, text: str) -> None:
    """Wait until a message with this text arrives at the module."""
    eventually(
        lambda: text in hall.robot.agent.rmpa("topic", "echo", topic, "-n", "1", timeout=LONG)[1], LONG, what=text
    )


def test_log_messages_cross_by_a_rule_and_in_ros1_under_another_name(hall: Hall, node: OtherEnd) -> None:
    """/rosout of ROS 1 never leaves its module: what is published elsewhere as rosgraph_msgs/Log does."""
    node.do("log", text="from ROS 2")
    hall.robot.wait_topic("/ros2/rosout", LONG)
    echoed(hall, "/ros2/rosout", "from ROS 2")
    assert "rosgraph_msgs/Log" in hall.robot.ros.tool("rostopic", "info", "/ros2/rosout")
    node.do("hear", topic="/robot/log", kind="rcl_interfaces/msg/Log")
    with hall.robot.ros.start("rostopic", "pub", "-r5", "/robot/log", "rosgraph_msgs/Log", "{msg: one}", name="pub"):
        node.process.wait_event(
            "heard", LONG, where=lambda e: e["topic"] == "/robot/log" and "msg='one'" in str(e["data"])
        )


def test_diagnostics_cross_both_ways(hall: Hall, node: OtherEnd) -> None:
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    node.do("hear", topic="/diagnostics", kind=kind)
    with hall.robot.ros.start(
        "rostopic",
        "pub",
        "-r5",
        "/diagnostics",
        "diagnostic_msgs/DiagnosticArray",
        "{status: [{name: arm}]}",
        name="p",
    ):
        node.process.wait_event("heard", LONG, where=lambda e: "name='arm'" in str(e["data"]))
    node.do("tell", topic="/diagnostics", kind=kind, fields={"header": {"frame_id": "two"}}, rate=10)
    echoed(hall, "/diagnostics", "two")
    node.do("untell", topic="/diagnostics")


@pytest.mark.long
def test_a_rate_holds_both_ways(hall: Hall, node: OtherEnd) -> None:
    with (
        hall.robot.ros.rospy("talker", topic="/slow/one", type="String", rate=100),
        hall.robot.ros.rospy("listener", topic="/slow/two", type="String") as listener,
    ):
        node.do("subscribe", topic="/slow/one")
        node.process.wait_event("heard", LONG, where=lambda e: e["topic"] == "/slow/one")
        since = len(texts(node.process, "/slow/one"))
        first = int(texts(node.process, "/slow/one")[0].split()[1])
        eventually(
            lambda: int(texts(node.process, "/slow/one")[-1].split()[1]) > first + 600, LONG, what="6 s of messages"
        )
        count = len(texts(node.process, "/slow/one")) - since
        assert 10 < count < 60, "5 Hz of 100 for 6 s"
        eventually(lambda: _told(node, listener), LONG, what="a message of ROS 2", every=0.3)
        since = len(texts(listener))
        node.do("publish", topic="/slow/two", text="fast", count=600, rate=100)
        count = len(texts(listener)) - since
        assert 10 < count < 60, "5 Hz of 100 for 6 s"
        assert "rule's rate" in hall.robot.agent.rmpa("why", "ros2:/slow/two")[1]


def _told(node: OtherEnd, listener: Process) -> bool:
    node.do("publish", topic="/slow/two", text="begin", count=1)
    return bool(listener.events("text"))


def test_nodes_of_ros2_follow_the_clock_of_a_simulator_of_ros1(hall: Hall) -> None:
    follower = hall.node("follower2", "/none", "--ros-args", "-p", "use_sim_time:=true")
    with hall.robot.ros.rospy("clock", start=1000, speed=10) as simulator:
        simulator.wait_event("up", LONG)
        eventually(lambda: 1000 < _now(follower) < 1e6, LONG, what="simulated time in ROS 2", every=0.2)
        before = _now(follower)
        eventually(lambda: _now(follower) > before + 5, LONG, what="time that goes on", every=0.2)


def _now(node: OtherEnd) -> float:
    return float(str(node.ask("now", "now")["seconds"]))


@pytest.mark.long
def test_nodes_of_ros1_follow_the_clock_of_a_simulator_of_ros2(tmp_path: Path) -> None:
    """The module takes its time from the gateway, and the gateway's from ROS 2."""
    follows = '[time]\nfollow = "gate"\n'
    with running_hall(tmp_path, follows, way="jazzy", gateway_config=SHARED) as hall:
        assert hall.gateway.rmpa("param", "set", "/use_sim_time", "true")[0] == 0
        hall.node("simulator2").do("tell", topic="/clock", kind=CLOCK, fields={"clock": {"sec": 4242}}, rate=50)
        hall.robot.wait_topic("/clock", LONG)

        def follows_it() -> bool:
            return "true" in hall.robot.ros.tool("rosparam", "get", "/use_sim_time")

        eventually(follows_it, LONG, what="/use_sim_time of the gateway")
        assert "it is 4242" in hall.robot.ros.tool("/usr/bin/python3", "-c", LATE, timeout=LONG)
