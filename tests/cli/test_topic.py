"""``rmpa topic`` against our own core."""

from __future__ import annotations

import asyncio
import json
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from rmpa.cli.topic import route_line
from rmpa.core.facts import RouteInfo
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.endpoints import Publisher
from rmpa.ros.node.node import Node
from rmpa.ros.types.messages import MessageType
from tests.cli.conftest import Background, Place, Rmpa, compare, settled, with_core
from tests.ros.types.workspaces import package

GROUP = ("topic",)
NO_HEADER = "rmpa: std_msgs/String has no header, so it has no stamp to measure its age by [invalid-value]\n"


@pytest.fixture
def talk(node: Callable[..., Node], background: Background) -> Iterator[Callable[..., None]]:
    """Makes a node publish at 50 Hz, a Joy on /cmd unless something else is said."""
    tasks: list[asyncio.Task[None]] = []

    async def publish(publisher: Publisher, values: dict[str, Any]) -> None:
        while True:
            publisher.publish(publisher.make(values))
            await asyncio.sleep(0.02)

    async def start(one: Node, kind: str, values: dict[str, Any]) -> None:
        tasks.append(asyncio.create_task(publish(await one.advertise("/cmd", kind), values)))

    async def stop() -> None:
        for task in tasks:
            task.cancel()

    def talk(name: str = "/talker", kind: str = "sensor_msgs/Joy", **values: Any) -> None:
        background.do(start(node(name), kind, values or {"axes": [0.5, 0]}))

    yield talk
    background.do(stop())


def test_list_and_info(rmpa: Rmpa, talk: Callable[..., None], place: Place, core: RosCore, listening: str) -> None:
    talk()
    # What a bridge would register for peer joystick.
    assert core.call("registerPublisher", "/rmpa/joystick/joy", "/cmd", "sensor_msgs/Joy", listening).code == 1
    said = place.transcript(
        "list", "list -v", "list joystick:/", "list /nothing", "info /cmd", "info /cmd --json", "info /cdm",
        "type /cmd", "find sensor_msgs/Joy",
        group="topic",
    )  # fmt: skip
    compare("topic", settled(said))
    core.call("unregisterPublisher", "/rmpa/joystick/joy", "/cmd", listening)


def test_echo(rmpa: Rmpa, talk: Callable[..., None], place: Place) -> None:
    talk()
    said = place.transcript(
        "echo /cmd -n 2", "echo /cmd/axes[0] -n 1", "echo /cmd -n 1 --noarr --nostr", "echo /cmd -n 1 -p",
        "echo /cmd -n 1 --json", "echo /cmd/axis",
        group="topic",
    )  # fmt: skip
    said = re.sub(r'("time":)[\d.]+', r"\1TIME", re.sub(r"^\d{19},", "TIME,", said, flags=re.MULTILINE))
    compare("topic_echo", re.sub(r'(seq"?:\s?|^TIME,)\d+', r"\1N", said, flags=re.MULTILINE))


@pytest.mark.parametrize(
    ("command", "figure", "line"),
    [
        ("hz", "rate", "at the agent, from joystick /joy_node: 10.000 Hz, period 100 ms (sd 310 µs, min 98.80 ms, "),
        ("bw", "bandwidth", "at the agent, from joystick /joy_node: 1.00 kB/s, 100 B a message"),
        (
            "delay", "delay",
            "by the link's clock, from joystick /joy_node: p50 412 µs, p99 790 µs, max 1.20 ms, last 390 µs; ",
        ),
    ],
)  # fmt: skip
def test_figures_and_behind_them_the_agents_of_a_remote_source(
    rmpa: Rmpa,
    talk: Callable[..., None],
    agent: Callable[..., None],
    core: RosCore,
    command: str,
    figure: str,
    line: str,
) -> None:
    talk(header={"stamp": {"secs": 1}})
    last = json.loads(rmpa(command, "/cmd", "-n", "20", "--json")[1].splitlines()[-1])
    assert (last[figure] > 0, last["window"]) == (True, 20)
    agent(snapshot=with_core(core.uri))
    code, out, _ = rmpa(command, "/cmd", "-n", "10")
    assert (code, out.startswith("subscribed to [/cmd]\naverage"), "window: 10\n" in out) == (0, True, True)
    assert f"\n\t{line}" in out
    last = json.loads(rmpa(command, "/cmd", "-n", "10", "--json")[1].splitlines()[-1])
    assert (last["source"], last["window"]) == ("header" if command == "delay" else "subscriber", 10)
    assert last["routes"][0]["latency"]["error"] == 0.000216


def test_over_the_mesh_a_delay_needs_no_header(
    rmpa: Rmpa, talk: Callable[..., None], agent: Callable[..., None], core: RosCore
) -> None:
    talk("/rmpa/joystick/joy_node", "std_msgs/String", data="hello")
    code, _, err = rmpa("delay", "/cmd")
    assert (code, err) == (1, NO_HEADER), "without the agent the link's clock is not known"
    agent(snapshot=with_core(core.uri))
    code, out, err = rmpa("delay", "joystick:/cmd", "-n", "5")
    assert (code, err) == (0, "")
    assert "no header, so no stamp to measure the whole age by\n\tby the link's clock, from joystick" in out
    last = json.loads(rmpa("delay", "/cmd", "-n", "5", "--json")[1].splitlines()[-1])
    assert (last["source"], last["delay"], last["error"]) == ("link", 0.00044, 0.000216)


def test_pub_and_echo_end_quietly_and_leave_nothing(rmpa: Rmpa, place: Place, core: RosCore) -> None:
    joy = ("/cmd", "sensor_msgs/Joy", "{header: auto, axes: [0.5, 0]}")
    with place.start("topic", "pub", "-r", "50", *joy) as talking:
        assert talking.stdout is not None
        assert talking.stdout.readline() == "publishing on /cmd at 50 Hz; Ctrl-C to end\n"
        for number in (signal.SIGINT, signal.SIGTERM):
            with place.start("topic", "echo", "/cmd", "--json") as process:
                assert process.stdout is not None
                assert json.loads(process.stdout.readline())["message"]["axes"] == [0.5, 0.0]
                process.send_signal(number)
                _, err = process.communicate(timeout=30)
            assert (process.returncode, err) == (0, "")
            assert core.state().subscribers.get("/cmd") is None
        talking.send_signal(signal.SIGINT)
        assert talking.wait(30) == 0
    assert core.state().publishers.get("/cmd") is None


def test_another_peers_messages_are_left_out(
    rmpa: Rmpa, talk: Callable[..., None], place: Place, core: RosCore, listening: str
) -> None:
    talk()
    # What a bridge would register for another topic of peer joystick.
    assert core.call("registerPublisher", "/rmpa/joystick/joy", "/joy", "sensor_msgs/Joy", listening).code == 1
    with place.start("topic", "hz", "joystick:/cmd") as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "subscribed to [joystick:/cmd]\n"
        assert process.stdout.readline() == "no new messages\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    assert err == "! joystick:/cmd is not published yet; waiting [no-publisher]\n"
    core.call("unregisterPublisher", "/rmpa/joystick/joy", "/joy", listening)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("/x", "std_msgs/String", "{dta: 1}"), 1, "std_msgs/String has no field 'dta'; it has data"),
        (("/x", "std_msgs/String", "{data: ["), 2, "VALUES: not YAML: "),
        (("/x", "no_msgs/None"), 1, "message type no_msgs/None: is not known here; looked in ROS_PACKAGE_PATH (not "),
        (("/x", "no_msgs/None"), 1, "; no ROS master answers at http://localhost:11311 (no agent runs); start one"),
        (("/x", "std_msgs/Strin"), 1, "did you mean std_msgs/String?"),
        (("base:/x", "std_msgs/String"), 2, "TOPIC: 'base:/x' names a peer; publish on /x: it crosses to every peer"),
        (("-1", "-r", "5", "/x", "std_msgs/String"), 2, "--once: does not go with --rate"),
    ],
)
def test_mistakes_are_told_before_anything_is_registered(
    place: Place, arguments: tuple[str, ...], code: int, message: str
) -> None:
    found, out, err = place.run("topic", "pub", *arguments)
    assert (found, out) == (code, "")
    assert message in err


def published(place: Place, *arguments: str) -> str:
    """Publish one message and end; return the text on stderr."""
    with place.start("topic", "pub", *arguments) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("published on ")
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
        assert process.returncode == 0
    return err


def test_types_of_a_workspace_and_of_live_publishers(
    rmpa: Rmpa, place: Place, core: RosCore, node: Callable[..., Node], background: Background, tmp_path: Path
) -> None:
    place.environ["ROS_PACKAGE_PATH"] = str(tmp_path)
    package(
        tmp_path / "stack" / "my_msgs", msg_Path="Header header\nPose[] poses\n", msg_Pose="float64 x\nfloat64 y\n"
    )
    assert published(place, "/path", "my_msgs/Path", "{header: auto, poses: [{x: 1}]}") == ""
    error = "rmpa: my_msgs/Path has no field 'z'; it has header, poses [invalid-message]\n"
    assert rmpa("pub", "-1", "/path", "my_msgs/Path", "{z: 1}") == (1, "", error)
    camera = node("/rmpa/base/camera")
    background.do(camera.advertise("/size", MessageType.learn("far_msgs/Size", "int32 width\n")))
    background.do(camera.advertise("/pose", MessageType.learn("my_msgs/Pose", "int32 angle\n")))
    # Learnt from a topic of another name, at a peer.
    assert published(place, "/other", "far_msgs/Size", "width: 7") == ""
    error = "rmpa: far_msgs/Size has no field 'widht'; it has width [invalid-message]\n"
    assert rmpa("pub", "-1", "/other", "far_msgs/Size", "{widht: 7}") == (1, "", error)
    code, _, err = rmpa("pub", "-1", "/other", "far_msgs/Sice")
    assert (code, f"; no publisher at {core.uri} tells it; source the workspace" in err) == (1, True)
    # Of one's own type the version that the topic has already.
    err = published(place, "/pose", "my_msgs/Pose", "angle: 7")
    assert "! /rmpa/base/camera publishes /pose with another version of my_msgs/Pose (md5 " in err
    assert f" than {tmp_path}/stack/my_msgs/msg/Pose.msg has (" in err
    assert published(place, "/pose2", "my_msgs/Pose", "x: 7") == ""


def test_no_master(place: Place) -> None:
    place.environ["ROS_MASTER_URI"] = "http://127.0.0.1:1"
    lines = ("list", "echo /x", "hz /x", "pub -1 /x std_msgs/Empty", "list --master x")
    compare("topic_no_master", place.transcript(*lines, group="topic"))


def test_a_route_without_a_subscriber_does_not_say_that_its_publisher_sends_nothing() -> None:
    idle = RouteInfo(peer="a", node="/joy", direction="in", state="idle", type="sensor_msgs/Joy")
    assert route_line(idle) == " * from a: /joy idle: no node here subscribes, so its messages are not counted"
    assert route_line(msgspec.structs.replace(idle, state="open")) == " * from a: /joy open, 0 messages"


def test_the_agents_core_is_asked(place: Place, agent: Callable[..., None], core: RosCore, listening: str) -> None:
    agent(snapshot=with_core(core.uri))
    assert "/rosout" in place.run("topic", "list")[1]
    place.environ["ROS_MASTER_URI"] = "http://127.0.0.1:1"
    assert "not the core of base: unset it, or say --agent" in place.run("topic", "list")[2]
    core.call("registerPublisher", "/n", "/cmd", "sensor_msgs/Joy", listening)
    lines = ("list --agent base", "info /cmd --agent base", "info other:/cmd --agent base")
    compare("topic_of_an_agent", place.transcript(*lines, group="topic"))
