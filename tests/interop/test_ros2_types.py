"""Types of ROS 2 and large messages, with real rclpy: what crosses, what is told, and what is bounded."""

from __future__ import annotations

import os
import signal
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from lab.bed.gateways import python_of
from lab.bed.processes import eventually
from tests.interop.ros2_hall import LONG, Hall, OtherEnd, running_hall

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [
    pytest.mark.ros,
    pytest.mark.netns,
    pytest.mark.timeout(150),
    pytest.mark.skipif(not python_of("jazzy").exists(), reason="ROS 2 jazzy is not there: scripts/install-ros2"),
]
STRING = "std_msgs/msg/String"
RULES = """
[[gateway.rule]]
names = ["/double"]
sites = ["ros2"]
name = "/two{name}"
"""
MEGABYTE = 1_000_000
# What the gateway, its half and the module may keep of images for listeners that stand still, beside what they are.
KEPT_MAX = 250 * MEGABYTE
DEFINITION = """
import rospy
rospy.init_node("any")
message = rospy.wait_for_message("/velocity2", rospy.AnyMsg)
print(message._connection_header["type"], message._connection_header["message_definition"])
"""


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    with running_hall(tmp_path_factory.mktemp("dds"), way="jazzy", gateway_config=RULES) as hall:
        yield hall


@pytest.fixture(scope="module")
def node(hall: Hall) -> OtherEnd:
    return hall.node("other2")


def why(hall: Hall, topic: str, *words: str) -> None:
    """Wait until ``rmpa why`` has these words of a topic."""

    def told() -> bool:
        text = hall.robot.agent.rmpa("why", topic, timeout=LONG)[1]
        return all(word in " ".join(text.split()) for word in words)

    eventually(told, LONG, what=f"{words} in rmpa why {topic}", every=0.5)


def arrives(hall: Hall, topic: str, text: str) -> None:
    """Wait until a message with this text arrives at the module."""

    def heard() -> bool:
        return text in hall.robot.agent.rmpa("topic", "echo", topic, "-n", "1", timeout=LONG)[1]

    eventually(heard, LONG, what=f"{text} by {topic}")


def test_a_type_of_ros2_alone_is_offered_with_its_definition(hall: Hall, node: OtherEnd) -> None:
    fields = {"body_frame_id": "base", "velocity": {"linear": {"x": 2.5}}}
    node.do("tell", topic="/velocity2", kind="geometry_msgs/msg/VelocityStamped", fields=fields, rate=10)
    hall.robot.wait_topic("/velocity2", LONG)
    arrives(hall, "/velocity2", "2.5")
    found = hall.robot.ros.tool("/usr/bin/python3", "-c", DEFINITION, timeout=LONG)
    assert "geometry_msgs/VelocityStamped" in found
    assert "string body_frame_id" in found
    node.do("untell", topic="/velocity2")


def test_a_second_type_of_a_topic_is_told_and_crosses_once_the_first_is_gone(hall: Hall, node: OtherEnd) -> None:
    """rclpy has one type of a topic name in a process; the half goes on without the other."""
    with hall.robot.ros.rospy("listener", topic="/two/double", type="String") as listener:
        with hall.robot.ros.start("rostopic", "pub", "-r5", "/double", "std_msgs/Float64", "1.5", name="pub"):
            node.do("hear", topic="/double", kind="std_msgs/msg/Float64")
            node.process.wait_event("heard", LONG, where=lambda e: e["topic"] == "/double")
            hall.node("second2").do("tell", topic="/double", kind=STRING, fields={"data": "two"}, rate=10)
            why(hall, "ros2:/two/double", "std_msgs/msg/Float64 crosses, and std_msgs/msg/String does not")
            since = node.process.mark_events()
            node.process.wait_event("heard", LONG, where=lambda e: e["topic"] == "/double", since=since)
        listener.wait_event("text", LONG, where=lambda e: e["data"] == "two")


def test_a_topic_may_change_its_type(hall: Hall, node: OtherEnd) -> None:
    with hall.robot.ros.start("rostopic", "echo", "/turned2", name="echo") as echo:
        node.do("tell", topic="/turned2", kind=STRING, fields={"data": "words"}, rate=10)
        eventually(lambda: "words" in echo.output, LONG, what="a text")
        node.do("untell", topic="/turned2")
    node.do("tell", topic="/turned2", kind="std_msgs/msg/Int32", fields={"data": 77}, rate=10)
    arrives(hall, "/turned2", "77")
    node.do("untell", topic="/turned2")


def resident(pid: int) -> int:
    """Bytes of a process and its children in memory."""
    status = Path(f"/proc/{pid}/status").read_text("ascii")
    own = next(int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmRSS"))
    return own + sum(map(resident, children_of(pid)))


def children_of(pid: int) -> list[int]:
    return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii").split()]


def half_of(pid: int) -> int:
    """The process with rclpy of a gateway."""
    every = [pid, *children_of(pid)]
    found = [child for each in every for child in children_of(each)]
    return next(each for each in found if b"half.child" in Path(f"/proc/{each}/cmdline").read_bytes())


@contextmanager
def stopped(pid: int) -> Iterator[None]:
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def images_for(hall: Hall, seconds: float) -> int:
    """The most that module and gateway have grown in this time."""
    agents = hall.robot.agent.process.pid, hall.gateway.process.pid
    before, most, end = sum(map(resident, agents)), 0, time.monotonic() + seconds
    while time.monotonic() < end:
        most = max(most, sum(map(resident, agents)) - before)
        time.sleep(0.2)
    return most


@pytest.mark.parametrize("kind", ["Image", "PointCloud2"])
def test_large_messages_for_a_listener_that_stands_still_are_bounded_and_counted(
    hall: Hall, node: OtherEnd, kind: str
) -> None:
    topic = f"/large2/{kind}"
    node.do("tell", topic=topic, kind=f"sensor_msgs/msg/{kind}", fields={}, rate=30, size=MEGABYTE)
    hall.robot.wait_topic(topic, LONG)
    with hall.robot.ros.start("rostopic", "bw", topic, name="bw") as listener:
        listener.wait_for("average", LONG)
        with stopped(listener.pid):
            assert images_for(hall, 10) < KEPT_MAX
            why(hall, f"ros2:{topic}", "dropped")
        node.do("untell", topic=topic)


def test_large_messages_for_a_half_that_stands_still_are_bounded_and_counted(hall: Hall, node: OtherEnd) -> None:
    node.do("hear", topic="/large1", kind="std_msgs/msg/UInt8MultiArray")
    with hall.robot.ros.rospy("talker", topic="/large1", size=MEGABYTE, rate=30):
        node.process.wait_event("heard", LONG, where=lambda e: e["topic"] == "/large1")
        with stopped(half_of(hall.gateway.process.pid)):
            assert images_for(hall, 10) < KEPT_MAX
            why(hall, "/large1", "dropped by a full queue")
        since = node.process.mark_events()
        node.process.wait_event("heard", LONG, where=lambda e: e["topic"] == "/large1", since=since)
