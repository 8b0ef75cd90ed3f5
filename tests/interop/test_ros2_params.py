"""Parameters and ROS 2: rosparam and ``rmpa param`` on one side, the services of ``ros2 param`` on the other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from lab.bed.gateways import ROUTER_PORT
from lab.bed.processes import eventually
from tests.interop.ros2_hall import LONG, Hall, OtherEnd, running_hall

if TYPE_CHECKING:
    from collections.abc import Iterator

pytest.importorskip("zenoh", reason="the extra rmpa[zenoh] is not installed")
pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    """The gateway is a Zenoh router, on the robot's own host; the robot may not be told of /fixed."""
    with running_hall(tmp_path_factory.mktemp("hall"), '[params]\nremote_set = ["/gains/**"]\n') as hall:
        yield hall


@pytest.fixture(scope="module")
def ros2(hall: Hall) -> OtherEnd:
    """A program of ROS 2."""
    return hall.end("ros2_param_end", f"tcp/{hall.robot.host.address}:{ROUTER_PORT}")


def test_the_parameters_of_a_module_are_read_and_set_by_ros2(hall: Hall, ros2: OtherEnd) -> None:
    hall.robot.ros.tool("rosparam", "set", "/gains/p", "1.5")
    hall.robot.ros.tool("rosparam", "set", "/fixed", "[1, 2]")
    hall.robot.ros.node("rospy", "talker", name="talker")  # a module that has nothing is not in ROS 2's graph

    def names() -> list[str]:
        found: Any = ros2.ask("list", "names", node="/rmpa/robot")["names"]
        return list(found or ())

    eventually(lambda: {"gains.p", "fixed"} <= set(names()), LONG, what="parameters of the robot", every=0.2)
    assert ros2.ask("get", "values", node="/rmpa/robot", names=["gains.p", "fixed", "none"])["values"] == [
        1.5, [1, 2], None,
    ]  # fmt: skip
    assert ros2.ask("set", "result", node="/rmpa/robot", name="gains.p", value=2.5)["ok"]
    assert hall.robot.ros.tool("rosparam", "get", "/gains/p").strip() == "2.5"
    refused = ros2.ask("set", "result", node="/rmpa/robot", name="fixed", value=3)
    assert not refused["ok"]
    assert "/fixed" in str(refused["reason"])


def test_the_parameters_of_a_node_of_ros2_are_read_and_set_by_a_module(hall: Hall, ros2: OtherEnd) -> None:
    ros2.do("serve", values={"rate": 10, "camera.names": ["a", "b"]})

    def param(*words: str) -> str:
        return hall.robot.agent.rmpa("param", *words)[1].strip()

    eventually(lambda: param("get", "--peer", "gate", "/ros2/bot/rate") == "10", LONG, what="the rate", every=0.2)
    assert param("get", "--peer", "gate", "/ros2/bot/camera/names") == "- a\n- b"
    since = ros2.process.mark_events()
    param("set", "--peer", "gate", "/ros2/bot/rate", "20")
    event = ros2.process.wait_event("set", LONG, since=since)
    assert (event["name"], event["value"]) == ("rate", 20)
