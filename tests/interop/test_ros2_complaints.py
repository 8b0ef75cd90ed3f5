"""What users of ros1_bridge complain of, with real ROS 2 by rclpy: each is a test; numbers are of its issues."""

from __future__ import annotations

import os
import signal
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


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    with running_hall(tmp_path_factory.mktemp("dds"), way="jazzy") as hall:
        yield hall


@pytest.fixture(scope="module")
def node(hall: Hall) -> OtherEnd:
    return hall.node("other2")


def in_ros2(node: OtherEnd, kind: str, name: str, *, there: bool = True) -> None:
    """Wait until ROS 2 lists a topic, service or node, or does not any more."""

    def listed() -> bool:
        found = node.ask("list", "graph")[kind]
        names = found if kind == "nodes" else [each[0] for each in found]  # type: ignore[attr-defined]
        return (name in names) is there  # type: ignore[operator]

    eventually(listed, LONG, what=f"{name} {'in' if there else 'out of'} the {kind} of ROS 2", every=0.2)


def heard(node: OtherEnd, topic: str, data: str, since: int = 0) -> None:
    node.process.wait_event("heard", LONG, where=lambda e: (e["topic"], e["data"]) == (topic, data), since=since)


def test_topics_and_nodes_are_listed_before_anybody_subscribes(hall: Hall, node: OtherEnd) -> None:
    """ros2/ros2#596."""
    with hall.robot.ros.rospy("talker", "__name:=quiet", topic="/quiet", type="String"):
        in_ros2(node, "topics", "/quiet")
        in_ros2(node, "nodes", "/rmpa/robot/quiet")
    in_ros2(node, "topics", "/quiet", there=False)


def test_late_nodes_get_what_several_sources_keep(hall: Hall, node: OtherEnd) -> None:
    """#374, #442: /tf_static of two broadcasters, and a latched map; both ways, for nodes that come late."""
    for number in (1, 2):
        node.do("publish", topic=f"/kept{number}", text=f"two {number}", count=1, latched=True)
        with hall.robot.ros.rospy("listener", topic=f"/kept{number}", type="String") as listener:
            listener.wait_event("text", LONG, where=lambda e, n=number: e["data"] == f"two {n} 1")  # type: ignore[misc]
    other = hall.node("another2")
    other.do("publish", topic="/kept1", text="third", count=1, latched=True)
    with hall.robot.ros.rospy("listener", topic="/kept1", type="String") as listener:
        listener.wait_event("text", LONG, where=lambda e: e["data"] == "two 1 1")
        listener.wait_event("text", LONG, where=lambda e: e["data"] == "third 1")
    other.process.end()


def test_sensors_with_best_effort_are_heard(hall: Hall, node: OtherEnd) -> None:
    node.do("sensor", topic="/scan2")
    with hall.robot.ros.rospy("listener", topic="/scan2", type="String") as listener:
        listener.wait_event("text", LONG, where=lambda e: e["count"] == 5)


def test_an_incompatible_qos_is_told_with_its_policy(hall: Hall, node: OtherEnd) -> None:
    with hall.robot.ros.rospy("talker", topic="/volatile1", type="String"):
        in_ros2(node, "topics", "/volatile1")
        node.do("strict", topic="/volatile1")

        def said() -> bool:
            return "durability" in hall.robot.agent.rmpa("why", "/volatile1")[1]

        eventually(said, LONG, what="the policy in rmpa why", every=0.5)


def test_nothing_comes_back_as_an_echo(hall: Hall, node: OtherEnd) -> None:
    """#254, #111, ros2/domain_bridge#79: talkers and listeners of one topic on both sides."""
    with (
        hall.robot.ros.rospy("talker", topic="/both", type="String", rate=20, wait=1),
        hall.robot.ros.rospy("listener", topic="/both", type="String") as here,
    ):
        node.do("subscribe", topic="/both")
        node.do("publish", topic="/both", text="two", count=1)
        heard(node, "/both", "message 40")
        node.do("publish", topic="/both", text="again", count=1)
        here.wait_event("text", LONG, where=lambda e: e["data"] == "again 1")
        texts = [str(e["data"]) for e in here.events("text")]
        assert len(texts) == len(set(texts)), "a message came twice"
        there = [str(e["data"]) for e in node.process.events("heard") if e["topic"] == "/both"]
        assert len(there) == len(set(there)), "a message came twice in ROS 2"


@pytest.mark.long
def test_a_failing_and_a_slow_service_end_nothing(hall: Hall, node: OtherEnd) -> None:
    """#277, #340: after a call that fails the next one works; a call of 20 s is waited for."""
    with hall.robot.ros.rospy("switch", service="/broken", fail="it is out of order"):
        in_ros2(node, "services", "/broken")
        assert node.ask("call", "answered", service="/broken", data=True, within=3.0)["error"] == "no response"
    with hall.robot.ros.rospy("switch", service="/whole"):
        in_ros2(node, "services", "/whole")
        assert node.ask("call", "answered", service="/whole", data=True)["success"] is True
    node.do("serve", service="/slow2", delay=20.0)
    eventually(lambda: "/slow2" in hall.robot.ros.tool("rosservice", "list").split(), LONG, what="/slow2 in ROS 1")
    assert "from ROS 2" in hall.robot.ros.tool("rosservice", "call", "/slow2", "false")


def test_a_service_goes_with_its_server(hall: Hall, node: OtherEnd) -> None:
    """#265, #74: no server is left over, and a client makes none."""
    with hall.robot.ros.rospy("switch", service="/mortal1"):
        in_ros2(node, "services", "/mortal1")
    in_ros2(node, "services", "/mortal1", there=False)
    node.do("serve", service="/mortal2")

    def services() -> list[str]:
        return hall.robot.ros.tool("rosservice", "list").split()

    eventually(lambda: "/mortal2" in services(), LONG, what="/mortal2 in ROS 1")
    node.do("unserve", service="/mortal2")
    eventually(lambda: "/mortal2" not in services(), LONG, what="/mortal2 out of ROS 1")


def test_a_listener_may_be_restarted_again_and_again(hall: Hall, node: OtherEnd) -> None:
    """#105."""
    for turn in range(10):
        with hall.robot.ros.rospy("listener", topic="/again2", type="String") as listener:

            def told(turn: int = turn) -> bool:
                node.do("publish", topic="/again2", text=f"turn {turn}", count=1)
                return bool(listener.events("text"))

            eventually(told, LONG, what=f"a message in turn {turn}", every=0.2)


def test_a_type_that_ros2_lacks_is_named_with_its_package(hall: Hall) -> None:
    """#173, #103: what cannot cross says what to install."""
    with hall.robot.ros.start("rostopic", "pub", "/typed1", "actionlib_msgs/GoalID", "{id: x}", name="pub"):
        hall.robot.wait_topic("/typed1")

        def said() -> bool:
            text = hall.robot.agent.rmpa("why", "/typed1")[1]
            return "no package actionlib_msgs" in text and "install" in text

        eventually(said, LONG, what="the package in rmpa why", every=0.5)


def test_sixty_topics_come_and_go(hall: Hall, node: OtherEnd) -> None:
    for number in range(60):
        node.do("publish", topic=f"/many/t{number}", text="x", count=1)
    hall.robot.wait_topic("/many/t59", LONG)
    assert {f"/many/t{n}" for n in range(60)} <= hall.robot.ros.graph_topics()
    for number in range(60):
        node.do("unpublish", topic=f"/many/t{number}")
    hall.robot.wait_no_topic("/many/t59", LONG)


def test_a_half_that_is_killed_is_started_again(hall: Hall, node: OtherEnd) -> None:
    with (
        hall.robot.ros.rospy("talker", topic="/on", type="String", rate=20),
        hall.robot.ros.rospy("listener", topic="/back2", type="String") as listener,
    ):
        node.do("subscribe", topic="/on")
        node.process.wait_event("heard", LONG, where=lambda e: e["topic"] == "/on")
        for _ in range(3):
            os.kill(hall.gateway.half(), signal.SIGKILL)
            since = node.process.mark_events()
            node.process.wait_event("heard", LONG, where=lambda e: e["topic"] == "/on", since=since)
            before = len(listener.events("text"))

            def told(before: int = before) -> bool:
                node.do("publish", topic="/back2", text="back", count=1)
                return len(listener.events("text")) > before

            eventually(told, LONG, what="a message of ROS 2 by the next half", every=0.2)
