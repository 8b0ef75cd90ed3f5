"""Three modules of ROS 1 and ROS 2 over DDS by rclpy, while parts of it are killed; and a second vendor's DDS.

Messages have numbers: what is heard is heard once.
"""

from __future__ import annotations

import os
import signal
from collections import Counter
from typing import TYPE_CHECKING

import pytest

from lab.bed.gateways import python_of
from lab.bed.processes import Process, eventually
from tests.interop.modules import Module, flows
from tests.interop.ros2_hall import LONG, Hall, OtherEnd, running_hall

if TYPE_CHECKING:
    from collections.abc import Iterator


pytestmark = [
    pytest.mark.ros,
    pytest.mark.netns,
    pytest.mark.timeout(300),
    pytest.mark.skipif(not python_of("jazzy").exists(), reason="ROS 2 jazzy is not there: scripts/install-ros2"),
]
# Seconds after which ROS 2 forgets a node that was killed, and some.
FORGOTTEN = 60.0
KEEP_ALL = """
[[contract]]
topics = ["/fast*"]
history = "keep_all"
"""


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    home = tmp_path_factory.mktemp("faults")
    with running_hall(home, way="jazzy", gateway_config=KEEP_ALL, more=("arm", "base")) as hall:
        yield hall


@pytest.fixture(scope="module")
def node(hall: Hall) -> OtherEnd:
    return hall.node("other2")


def modules(hall: Hall) -> tuple[Module, ...]:
    return (hall.robot, *hall.more)


def listener(module: Module, topic: str) -> Process:
    """A listener of texts that is up."""
    made = module.ros.rospy("listener", topic=topic, type="String")
    made.wait_event("up", LONG)
    return made


def texts(listener: Process) -> list[str]:
    return [str(event["data"]) for event in listener.events("text")]


def heard(node: OtherEnd, topic: str) -> list[str]:
    return [str(event["data"]) for event in node.process.events("heard") if event["topic"] == topic]


def once(found: list[str]) -> None:
    """Fail if something was heard twice."""
    assert not [text for text, count in Counter(found).items() if count > 1]


def reaches(end: OtherEnd, topic: str, listeners: list[Process], text: str) -> None:
    """Publish in ROS 2, each time another text, until each listener has heard one."""
    tries = 0

    def told() -> bool:
        nonlocal tries
        tries += 1
        end.do("publish", topic=topic, text=f"{text} try {tries}", count=1)
        return all(any(each.startswith(text) for each in texts(one)) for one in listeners)

    eventually(told, FORGOTTEN, what=f"{text} at each listener", every=0.2)


@pytest.mark.long
@pytest.mark.parametrize(("size", "rate", "count"), [(64, 100, 100), (1 << 20, 10, 20)])
def test_bytes_of_roscpp_go_to_ros2_and_back_to_three_modules(hall: Hall, size: int, rate: int, count: int) -> None:
    """#352, #218: each message once at each module, whichever library is there, and each byte right."""
    there, back = f"/there{size}", f"/back{size}"
    hall.relay(there, back)
    listeners = [
        hall.robot.ros.roscpp("listener", topic=back),
        hall.more[0].ros.rospy("listener", topic=back),
        hall.more[1].ros.roscpp("listener", topic=back),
    ]
    for module in modules(hall):
        module.wait_topic(back, LONG)
    with hall.more[0].ros.roscpp("talker", topic=there, rate=rate, size=size, queue=1000):
        for (
            each
        ) in listeners:  # ROS 2 keeps nothing for those that come later, but from its first one on each has all
            report = flows(each, count, FORGOTTEN)
            assert (report["bad"], report["doubled"]) == (0, 0), report
            assert size > 64 or not report["gaps"], report  # a machine that is too slow for clouds drops some
            each.end()


def test_each_module_has_what_ros2_has_once(hall: Hall, node: OtherEnd) -> None:
    listeners = [listener(module, "/all2") for module in modules(hall)]
    reaches(node, "/all2", listeners, "first")
    node.do("publish", topic="/all2", text="all", count=50, rate=200)
    for module, each in zip(modules(hall), listeners, strict=True):
        each.wait_event("text", LONG, where=lambda e: e["data"] == "all 50")
        assert [text for text in texts(each) if text.startswith("all ")] == [f"all {n}" for n in range(1, 51)]
        assert module.ros.tool("rostopic", "list").split().count("/all2") == 1
        assert module.ros.tool("rosnode", "list").split().count("/rmpa/ros2/other2") == 1
        each.end()


def test_ros2_hears_each_of_three_modules_once(hall: Hall, node: OtherEnd) -> None:
    node.do("subscribe", topic="/three")
    for module in modules(hall):
        module.ros.rospy("talker", topic="/three", type="String", rate=50, wait=1, count=40)
    eventually(lambda: len(heard(node, "/three")) >= 120, FORGOTTEN, what="the messages of three modules")
    assert Counter(heard(node, "/three")) == {f"message {number}": 3 for number in range(1, 41)}


def test_latched_topics_of_modules_and_of_ros2_are_kept_for_late_ones(hall: Hall, node: OtherEnd) -> None:
    node.do("publish", topic="/kept2", text="of two", count=1, latched=True)
    for module in modules(hall):
        late = listener(module, "/kept2")
        late.wait_event("text", LONG)
        assert texts(late) == ["of two 1"]
        late.end()
    for number, module in enumerate(hall.more):
        module.ros.start("rostopic", "pub", "-l", "/tf_kept", "std_msgs/String", f"data: of module {number}")
        module.wait_topic("/tf_kept", LONG)

    def latched() -> bool:
        code, text = hall.robot.agent.rmpa("why", "/tf_kept")
        return code == 0 and text.count("transient local") >= 2

    eventually(latched, LONG, what="both topics as transient local", every=0.5)
    node.do("subscribe", topic="/tf_kept", latched=True)
    eventually(lambda: len(heard(node, "/tf_kept")) >= 2, LONG, what="what two modules keep")
    assert sorted(heard(node, "/tf_kept")) == ["of module 0", "of module 1"]
    os.kill(hall.gateway.half(), signal.SIGKILL)
    again = hall.node("late2")
    again.do("subscribe", topic="/tf_kept", latched=True)
    eventually(lambda: len(heard(again, "/tf_kept")) >= 2, FORGOTTEN, what="it by the next half")
    assert sorted(heard(again, "/tf_kept")) == ["of module 0", "of module 1"]
    again.process.end()


def test_services_of_a_far_module_and_of_ros2(hall: Hall, node: OtherEnd) -> None:
    with hall.more[1].ros.rospy("switch", service="/far_lamp") as switch:
        switch.wait_event("up", LONG)

        def works() -> bool:
            return node.ask("call", "answered", service="/far_lamp", data=True).get("message") == "on"

        eventually(works, FORGOTTEN, what="an answer of the far module")
    node.do("serve", service="/gate2")
    for module in modules(hall):
        eventually(lambda m=module: "/gate2" in m.ros.tool("rosservice", "list").split(), LONG, what="/gate2")  # type: ignore[misc]
        assert "from ROS 2" in module.ros.tool("rosservice", "call", "/gate2", "false")
    node.do("unserve", service="/gate2")


@pytest.mark.parametrize("victim", ["gateway", pytest.param("agent", marks=pytest.mark.long)])
def test_both_ways_flow_again_after_a_kill(hall: Hall, node: OtherEnd, victim: str) -> None:
    """kill -9: of the gateway, whose half ends with it and stays in ROS 2's graph for a while, and of an agent."""
    on, back = f"/on_{victim}", f"/back_{victim}"
    killed = hall.gateway if victim == "gateway" else hall.robot.agent
    with hall.robot.ros.rospy("talker", topic=on, type="String", rate=20), listener(hall.robot, back) as here:
        node.do("subscribe", topic=on)
        for turn in range(2):
            eventually(lambda: heard(node, on), FORGOTTEN, what="a message of ROS 1")
            reaches(node, back, [here], f"turn {turn}")
            killed.kill()
            killed.restart()
            hall.robot.agent.wait_peer(hall.gateway.name)
            since = node.process.mark_events()
            node.process.wait_event("heard", FORGOTTEN, where=lambda e: e["topic"] == on, since=since)
            reaches(node, back, [here], f"after {turn}")
        once(heard(node, on))
        once(texts(here))


def test_a_node_of_ros2_that_is_killed_leaves_nothing(hall: Hall) -> None:
    """Its ghost stays in ROS 2's graph for 20 s: the next one of its name is heard once, and both go."""
    with listener(hall.robot, "/of_victim") as here:
        for turn in range(2):
            victim = hall.node("victim2")
            reaches(victim, "/of_victim", [here], f"life {turn}")
            victim.process.kill()
        once(texts(here))
    hall.robot.wait_no_topic("/of_victim", FORGOTTEN)
    assert "/rmpa/ros2/victim2" not in hall.robot.ros.tool("rosnode", "list").split()


@pytest.mark.long
def test_a_node_of_ros2_is_restarted_again_and_again(hall: Hall) -> None:
    with listener(hall.robot, "/restarted") as here:
        for turn in range(30):
            end = hall.node("restarted")
            reaches(end, "/restarted", [here], f"turn {turn} of it")
            end.process.end()
        once(texts(here))
    hall.robot.wait_no_topic("/restarted", FORGOTTEN)


@pytest.mark.parametrize("seconds", [4, pytest.param(60, marks=pytest.mark.long)])
def test_nothing_is_lost_at_500_hz(hall: Hall, node: OtherEnd, seconds: int) -> None:
    """#429: reliable and keep all, both ways; of what ROS 2 publishes nothing that another node of rclpy hears."""
    count, on, back = 500 * seconds, f"/fast{seconds}", f"/fast_back{seconds}"
    node.do("follow", topic=on)
    with hall.robot.ros.rospy("talker", topic=on, type="String", rate=500, wait=1, count=count):
        node.process.wait_event("heard", seconds + FORGOTTEN, where=lambda e: e["data"] == f"message {count}")
    assert heard(node, on) == [f"message {number}" for number in range(1, count + 1)]
    beside = hall.node("beside2")
    beside.do("follow", topic=back)
    with listener(hall.robot, back) as here:
        while not heard(beside, back):
            reaches(node, back, [here], f"turn {len(texts(here))}")
        for part in range(seconds):
            node.do("publish", topic=back, text=f"part {part}", count=500, rate=500)
        last = f"part {seconds - 1} 500"
        beside.process.wait_event("heard", LONG, where=lambda e: e["data"] == last)
        here.wait_event("text", LONG, where=lambda e: e["data"] == last)
        plain = [text for text in heard(beside, back) if text.startswith("part")]
        assert [text for text in texts(here) if text.startswith("part")] == plain
    beside.process.end()


@pytest.mark.skipif(not python_of("cyclonedds").exists(), reason="Cyclone DDS is not there: scripts/install-ros2")
@pytest.mark.long
def test_a_program_of_another_vendors_dds_is_heard_and_hears(hall: Hall) -> None:
    other = hall.end("cyclonedds_end", python=python_of("cyclonedds"))
    with listener(hall.robot, "/vendor2") as here:
        reaches(other, "/vendor2", [here], "of Cyclone")
        other.do("publish", topic="/vendor2", text="more", count=20, rate=100)
        here.wait_event("text", LONG, where=lambda e: e["data"] == "more 20")
        assert [text for text in texts(here) if text.startswith("more")] == [f"more {n}" for n in range(1, 21)]
    other.do("subscribe", topic="/vendor1")
    with hall.robot.ros.rospy("talker", topic="/vendor1", type="String", rate=20):
        other.process.wait_event("heard", FORGOTTEN, where=lambda e: e["topic"] == "/vendor1")
        eventually(lambda: len(heard(other, "/vendor1")) >= 20, LONG, what="twenty messages")
        once(heard(other, "/vendor1"))
