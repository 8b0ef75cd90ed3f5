"""ROS 1 nodes beside those of other worlds, by one gateway: ROS 2 of rmw_zenoh and Zenoh programs.

The other ends are ``zenoh-ros2-sdk`` and plain eclipse-zenoh: they have no code of ours. Those of actions speak
rmw_zenoh's format, to actionlib's unmodified clients and servers.
"""

from __future__ import annotations

import json
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

from lab.bed.gateways import ROUTER_PORT, python_of
from lab.bed.processes import Event, Process, eventually
from rmpa.gateway.ros2.pairs import ActionPair
from rmpa.gateway.ros2.types import Ros2Types, TypePair
from rmpa.ros.types.messages import MessageType
from tests.interop.ros import lacks
from tests.interop.ros2_hall import LONG, ZENOH, Hall, OtherEnd, running_hall

if TYPE_CHECKING:
    from collections.abc import Iterator

pytest.importorskip("zenoh", reason="the extra rmpa[zenoh] is not installed")
pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]
needs_actionlib = pytest.mark.skipif(bool(lacks("actionlib")), reason=lacks("actionlib"))


class World(NamedTuple):
    """A hall, and a ROS 2 node in it."""

    hall: Hall
    node: OtherEnd


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    """The gateway is a Zenoh router, on the robot's own host."""
    with running_hall(tmp_path_factory.mktemp("hall")) as hall:
        yield hall


@pytest.fixture(scope="module", params=[ZENOH, "jazzy", pytest.param("kilted", marks=pytest.mark.long)])
def ros2(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """A ROS 2 node, and the hall that it is in: each way to ROS 2 has the same behaviour."""
    if request.param == ZENOH:
        if find_spec("zenoh_ros2_sdk") is None:
            pytest.skip("zenoh-ros2-sdk is not installed")
        hall = request.getfixturevalue("hall")
        yield World(hall, hall.node("talker2"))
        return
    if not python_of(request.param).exists():
        pytest.skip(f"ROS 2 {request.param} is not there: scripts/install-ros2")
    with running_hall(tmp_path_factory.mktemp(request.param), way=request.param) as hall:
        yield World(hall, hall.node("talker2"))


@pytest.fixture(scope="module")
def plain(hall: Hall) -> OtherEnd:
    """A Zenoh program."""
    return hall.end("zenoh_end", f"tcp/{hall.robot.host.address}:{ROUTER_PORT}")


def text_of(data: str) -> str:
    """A std_msgs/String as ROS 1 serializes it, hexadecimal."""
    raw = data.encode()
    return (len(raw).to_bytes(4, "little") + raw).hex()


def listed(ros2: OtherEnd, kind: str, name: str, type_name: str) -> None:
    """Wait until ROS 2 lists a topic or service with this type alone."""

    def there() -> bool:
        found: Any = ros2.ask("list", "graph")[kind]
        return dict(found).get(name) == [type_name]

    eventually(there, LONG, what=f"{name} in the {kind} of ROS 2", every=0.1)


def hears_all(listener: Process, ros2: OtherEnd, text: str) -> None:
    """Fail unless a listener on /from2 hears each message of ROS 2 once, in order, after the first one."""

    def told() -> bool:
        ros2.do("publish", topic="/from2", text="first", count=1)  # ROS 2 keeps nothing for a late subscriber
        return bool(listener.events("text"))

    eventually(told, what="a message of ROS 2", every=0.2)
    ros2.do("publish", topic="/from2", text=text, count=50, rate=200)
    listener.wait_event("text", where=lambda e: e["data"] == f"{text} 50")
    heard = [e["data"] for e in listener.events("text") if str(e["data"]).startswith(text)]
    assert heard == [f"{text} {number}" for number in range(1, 51)]


def test_ros2_lists_and_hears_a_rospy_talker(ros2: World) -> None:
    hall, node = ros2
    with hall.robot.ros.rospy("talker", "__name:=talker", topic="/hello", type="String", rate=50, wait=1):
        listed(node, "topics", "/hello", "std_msgs/msg/String")
        node.do("subscribe", topic="/hello")
        node.process.wait_event("heard", where=lambda e: e["data"] == "message 21")
        heard = [e["data"] for e in node.process.events("heard") if e["topic"] == "/hello"]
        assert heard[:21] == [f"message {number}" for number in range(1, 22)]


def test_ros1_lists_and_hears_a_ros2_talker(ros2: World) -> None:
    hall, node = ros2
    node.do("publish", topic="/from2", text="early", count=1)
    hall.robot.wait_topic("/from2")
    assert "/rmpa/ros2/talker2" in hall.robot.ros.tool("rosnode", "list").split()
    assert "std_msgs/String" in hall.robot.ros.tool("rostopic", "info", "/from2")
    for number in range(2):
        with hall.robot.ros.rospy("listener", topic="/from2", type="String", name=f"l_{number}") as listener:
            hears_all(listener, node, f"turn{number}")
            _, text = hall.robot.agent.rmpa("why", "ros2:/from2")
            assert "std_msgs/msg/String of ROS 2 is std_msgs/String here" in text, text
    code, text = hall.robot.agent.rmpa("site", "info", "ros2")
    assert code == 0, text
    assert "/from2" in text


def test_latched_is_transient_local_both_ways(ros2: World) -> None:
    hall, node = ros2
    with hall.robot.ros.rospy("text_teller", topic="/map1", latch=True, commands=True) as teller:
        teller.wait_event("up")
        teller.tell(json.dumps({"data": "kept by ROS 1"}))
        listed(node, "topics", "/map1", "std_msgs/msg/String")
        node.do("subscribe", topic="/map1", latched=True)
        node.process.wait_event("heard", where=lambda e: e["data"] == "kept by ROS 1")


def test_services_are_called_both_ways(ros2: World) -> None:
    hall, node = ros2
    with hall.robot.ros.rospy("switch", service="/lamp") as switch:
        switch.wait_event("up")
        listed(node, "services", "/lamp", "std_srvs/srv/SetBool")
        answer = node.ask("call", "answered", service="/lamp", data=True)
        assert (answer.get("success"), answer.get("message")) == (True, "on"), answer
        assert switch.events("call")[-1]["data"] is True
    node.do("serve", service="/gate2")
    eventually(lambda: "/gate2" in hall.robot.ros.tool("rosservice", "list").split(), what="/gate2 in ROS 1")
    assert hall.robot.ros.tool("rosservice", "type", "/gate2").strip() == "std_srvs/SetBool"
    output = hall.robot.ros.tool("rosservice", "call", "/gate2", "false")
    assert "success: True" in output
    assert "from ROS 2" in output


def test_a_zenoh_program_hears_a_topic_and_finds_its_module(hall: Hall, plain: OtherEnd) -> None:
    """The keys and payloads are simple on purpose: what the page on sites says is enough."""
    key = "rmpa/1/hall/robot/t/std_msgs%String/plain"
    with hall.robot.ros.rospy("talker", topic="/plain", type="String", rate=50, wait=1) as talker:
        talker.wait_event("up")
        plain.do("subscribe", key=key)
        sample = plain.process.wait_event("sample", LONG, where=lambda e: e["key"] == key)
        assert bytes.fromhex(str(sample["payload"]))[4:].startswith(b"message ")
        tokens = plain.ask("tokens", "tokens", key="rmpa/1/hall/robot/up/*")
        assert len(tokens["keys"]) == 1  # type: ignore[arg-type]
        header = plain.ask("get", "replies", key="rmpa/1/hall/robot/d/t/plain")
        assert '"std_msgs/String"' in bytes.fromhex(header["ok"][0]).decode()  # type: ignore[index]


def test_a_zenoh_program_calls_a_service(hall: Hall, plain: OtherEnd) -> None:
    with hall.robot.ros.rospy("switch", service="/simple") as switch:
        switch.wait_event("up")
        key = "rmpa/1/hall/robot/s/*/simple"

        def answered() -> bool:
            replies = plain.ask("get", "replies", key=key, payload="01")
            return replies["ok"] == ["01" + text_of("on")]

        eventually(answered, what="the service's answer", every=0.3)


# --- actions -----------------------------------------------------------------------------------------------------


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


@needs_actionlib
def test_a_client_of_ros1_uses_a_server_of_ros2(hall: Hall) -> None:
    end(hall, "/count2").do("serve")
    client = client_of_ros1(hall, "roscpp", "/count2")
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


@needs_actionlib
def test_a_server_of_ros2_that_is_killed_aborts_the_goal(hall: Hall) -> None:
    server = end(hall, "/mortal")
    server.do("serve")
    client = client_of_ros1(hall, "rospy", "/mortal")
    client.tell("send 100000")
    client.wait_event("feedback", LONG)
    server.process.kill()
    done = client.wait_event("done", LONG)
    assert done["state"] == "ABORTED"


@needs_actionlib
@pytest.mark.parametrize("kind", ["rospy", pytest.param("roscpp", marks=pytest.mark.long)])
def test_a_client_of_ros2_uses_a_server_of_ros1(hall: Hall, kind: str) -> None:
    action = f"/count1_{kind}"
    server = hall.robot.ros.node(kind, "action_server", "--action", action, name=f"server_{kind}")
    client = end(hall, action)
    client.do("client")
    eventually(lambda: client.ask("send", "accepted", goal=5)["ok"], LONG, what="a server of actions", every=0.2)
    # Goals before that were not accepted: their result is unknown, or there was none to ask.
    done = client.process.wait_event("ended", LONG, where=lambda event: event["status"] not in {-1, 0})
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


def has_rclpy(world: World) -> Hall:
    """The hall, for what zenoh-ros2-sdk cannot do."""
    if world.hall.way == ZENOH:
        pytest.skip("only rclpy has it")
    return world.hall


def done(client: Process, line: str) -> Event:
    """What becomes of a goal that a client of ROS 1 sends, or of what it does else."""
    since = client.mark_events()
    client.tell(line)
    return client.wait_event("done", LONG, since=since)


@needs_actionlib
def test_a_client_of_ros1_uses_a_server_of_rclpy(ros2: World) -> None:
    hall = has_rclpy(ros2)
    server = hall.node("counter2", "/fibonacci2")
    server.do("action_serve")
    client = hall.robot.ros.rospy("fibonacci_end", "client", action="/fibonacci2", commands=True)
    client.wait_event("up", LONG)
    client.tell("server 20")
    assert client.wait_event("server", LONG)["found"]
    ended = done(client, "send 5")
    assert (ended["state"], ended["result"]) == ("SUCCEEDED", 5)
    assert client.events("feedback")[-1]["value"] == 5
    assert done(client, "send -1")["state"] == "REJECTED"
    since = client.mark_events()
    client.tell("send 100000")
    client.wait_event("feedback", LONG, since=since)
    assert done(client, "cancel")["state"] == "PREEMPTED"


@needs_actionlib
def test_a_client_of_rclpy_uses_a_server_of_ros1(ros2: World) -> None:
    hall = has_rclpy(ros2)
    hall.robot.ros.rospy("fibonacci_end", "server", action="/fibonacci1").wait_event("up", LONG)
    client = hall.node("client2", "/fibonacci1")
    eventually(lambda: client.ask("send", "accepted", goal=5)["ok"], LONG, what="a server of actions", every=0.2)
    ended = client.process.wait_event("ended", LONG)
    assert (ended["status"], ended["result"]) == (4, 5)
    since = client.process.mark_events()
    assert client.ask("send", "accepted", goal=100000)["ok"]
    client.process.wait_event("feedback", LONG, since=since)
    assert client.ask("cancel", "cancelling")["code"] == 0
    assert client.process.wait_event("ended", LONG, since=since)["status"] == 5
