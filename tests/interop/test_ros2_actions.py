"""actionlib's unmodified clients and servers beside those of ROS 2 in rmw_zenoh's format, by one gateway."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final

import pytest

from lab.bed.gateways import ROUTER_PORT
from lab.bed.processes import eventually
from rmpa.gateway.ros2.conversion import ActionPair
from rmpa.gateway.ros2.types import Ros2Types, TypePair
from rmpa.ros.types.messages import MessageType
from tests.interop.ros import lacks
from tests.interop.ros2_hall import LONG, Hall, OtherEnd, running_hall

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.processes import Process

pytest.importorskip("zenoh", reason="the extra rmpa[zenoh] is not installed")
pytestmark = [
    pytest.mark.ros,
    pytest.mark.netns,
    pytest.mark.timeout(120),
    pytest.mark.skipif(bool(lacks("actionlib")), reason=lacks("actionlib")),
]
KINDS: Final = ["rospy", "roscpp"]


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    """The gateway is a Zenoh router, on the robot's own host."""
    with running_hall(tmp_path_factory.mktemp("hall")) as hall:
        yield hall


def hashes() -> str:
    """The type hashes of actionlib's TestAction, by the ends of their names."""
    kinds = [MessageType(f"actionlib/Test{part}") for part in ("Goal", "Result", "Feedback")]
    pair = ActionPair(kinds, TypePair("actionlib/action/Test"), Ros2Types("jazzy"))
    return json.dumps({name.rpartition("/")[2].rpartition("_")[2]: each for name, each in pair.types.values()})


def end(hall: Hall, action: str) -> OtherEnd:
    endpoint = f"tcp/{hall.robot.host.address}:{ROUTER_PORT}"
    return hall.end("ros2_action_end", endpoint, action, "actionlib/Test", hashes())


def client_of_ros1(hall: Hall, kind: str, action: str) -> Process:
    client = hall.robot.ros.node(kind, "action_client", "--action", action, name=f"client_{kind}", commands=True)
    client.tell("server 20")
    assert client.wait_event("server", LONG)["found"]
    return client


@pytest.mark.parametrize("kind", KINDS)
def test_a_client_of_ros1_uses_a_server_of_ros2(hall: Hall, kind: str) -> None:
    server = end(hall, f"/count2_{kind}")
    server.do("serve")
    client = client_of_ros1(hall, kind, f"/count2_{kind}")
    client.tell("send 5")
    done = client.wait_event("done", LONG)
    assert (done["state"], done["result"]) == ("SUCCEEDED", 5)
    assert client.events("feedback")[-1]["value"] == 5
    since = client.mark_events()
    client.tell("send -1")
    assert client.wait_event("done", LONG, since=since)["state"] == "REJECTED"
    since = client.mark_events()
    client.tell("send 100000")
    client.wait_event("feedback", LONG, since=since)
    client.tell("cancel")
    assert client.wait_event("done", LONG, since=since)["state"] == "PREEMPTED"


def test_a_server_of_ros2_that_is_killed_aborts_the_goal(hall: Hall) -> None:
    server = end(hall, "/mortal")
    server.do("serve")
    client = client_of_ros1(hall, "rospy", "/mortal")
    client.tell("send 100000")
    client.wait_event("feedback", LONG)
    server.process.kill()
    done = client.wait_event("done", LONG)
    assert done["state"] == "ABORTED"


@pytest.mark.parametrize("kind", KINDS)
def test_a_client_of_ros2_uses_a_server_of_ros1(hall: Hall, kind: str) -> None:
    action = f"/count1_{kind}"
    server = hall.robot.ros.node(kind, "action_server", "--action", action, name=f"server_{kind}")
    client = end(hall, action)
    client.do("client")
    eventually(lambda: client.ask("send", "accepted", goal=5)["ok"], LONG, what="a server of actions", every=0.2)
    done = client.process.wait_event("ended", LONG, where=lambda event: event["status"] != -1)
    assert (done["status"], done["result"]) == (4, 5)
    since = client.process.mark_events()
    assert client.ask("send", "accepted", goal=-1)["ok"], "SimpleActionServer accepts, and aborts"
    assert client.process.wait_event("ended", LONG, since=since)["status"] == 6
    since = client.process.mark_events()
    assert client.ask("send", "accepted", goal=100000)["ok"]
    client.process.wait_event("feedback", LONG, since=since)
    assert client.ask("cancel", "cancelling")["code"] == 0
    assert client.process.wait_event("ended", LONG, since=since)["status"] == 5
    assert client.ask("send", "accepted", goal=100000)["ok"]
    since = client.process.mark_events()
    server.kill()
    assert client.process.wait_event("ended", LONG, since=since)["status"] == 6
