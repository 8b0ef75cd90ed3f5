"""``rmpa topic`` against our own core."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
from typing import TYPE_CHECKING

import msgspec
import pytest

from rmpa.cli.topic import route_line
from rmpa.observe.snapshot import RouteInfo
from rmpa.ros.node.node import Node
from rmpa.ros.types.messages import MessageType
from tests.cli.conftest import Background, Place, with_core
from tests.ros.types.workspaces import package

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from rmpa.ros.core.embedded import RosCore
    from rmpa.ros.node.endpoints import Publisher

TWIST = "{linear: {x: 0.5}, angular: {z: -1}}"


@pytest.fixture
def talking(place: Place, core: RosCore) -> Iterator[subprocess.Popen[str]]:
    """``rmpa topic pub`` at 50 Hz on /cmd."""
    place.environ["ROS_MASTER_URI"] = core.uri
    with place.start(
        "topic", "pub", "-r", "50", "/cmd", "sensor_msgs/Joy", "{header: auto, axes: [0.5, 0]}"
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "publishing on /cmd at 50 Hz; Ctrl-C to end\n"
        try:
            yield process
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0
        finally:
            process.kill()
    assert core.state().publishers.get("/cmd") is None


def test_list_and_info(place: Place, talking: subprocess.Popen[str], core: RosCore) -> None:
    # What a bridge would register for peer joystick; it listens, or the core takes it for dead.
    stands = socket.create_server(("127.0.0.1", 0))
    api = f"http://127.0.0.1:{stands.getsockname()[1]}/"
    reply = core.call("registerPublisher", "/rmpa/joystick/joy", "/cmd", "sensor_msgs/Joy", api)
    assert reply.code == 1
    code, out, _ = place.run("topic", "list")
    assert code == 0
    assert out.splitlines()[0] == "/cmd  [joystick]"
    assert "/cmd [sensor_msgs/Joy] 2 publishers  [joystick]" in place.run("topic", "list", "-v")[1]
    assert place.run("topic", "list", "joystick:/")[1] == "/cmd  [joystick]\n"
    assert place.run("topic", "list", "/nothing")[1] == ""
    code, out, _ = place.run("topic", "info", "/cmd")
    assert out.startswith("Type: sensor_msgs/Joy\n\nPublishers:\n")
    assert " * /joy of peer joystick, by its proxy /rmpa/joystick/joy" in out
    assert out.endswith("Subscribers: none\n")
    (info,) = place.json("topic", "info", "/cmd", "--json")
    assert info["peers"] == ["joystick"]
    assert place.run("topic", "type", "/cmd") == (0, "sensor_msgs/Joy\n", "")
    assert place.run("topic", "find", "sensor_msgs/Joy")[1] == "/cmd  [joystick]\n"
    assert place.run("topic", "info", "/cdm") == (1, "", "rmpa: no topic /cdm; did you mean /cmd? [unknown-name]\n")
    core.call("unregisterPublisher", "/rmpa/joystick/joy", "/cmd", api)
    stands.close()


def test_echo(place: Place, talking: subprocess.Popen[str]) -> None:
    code, out, err = place.run("topic", "echo", "/cmd", "-n", "2")
    assert (code, err) == (0, "")
    assert out.count("axes: [0.5, 0.0]\nbuttons: []\n---\n") == 2
    assert place.run("topic", "echo", "/cmd/axes[0]", "-n", "1")[1] == "0.5\n---\n"
    assert "axes: <array length: 2>" in place.run("topic", "echo", "/cmd", "-n", "1", "--noarr", "--nostr")[1]
    head, row = place.run("topic", "echo", "/cmd", "-n", "1", "-p")[1].splitlines()
    assert head == "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.axes0,field.axes1"
    assert row.endswith(",0.5,0.0")
    (line,) = place.json("topic", "echo", "/cmd", "-n", "1", "--json")
    assert line["topic"] == "/cmd"
    assert isinstance(line["message"], dict)
    assert line["message"]["axes"] == [0.5, 0.0]
    code, _, err = place.run("topic", "echo", "/cmd/axis")
    assert (code, err) == (1, "rmpa: no field 'axis' in the message; it has header, axes, buttons [invalid-value]\n")


@pytest.mark.parametrize(("command", "figure"), [("hz", "rate"), ("bw", "bandwidth"), ("delay", "delay")])
def test_figures(place: Place, talking: subprocess.Popen[str], command: str, figure: str) -> None:
    lines = place.json("topic", command, "/cmd", "-n", "20", "--json")
    value = lines[-1][figure]
    assert isinstance(value, float)
    assert value > 0
    assert lines[-1]["window"] == 20
    code, out, _ = place.run("topic", command, "/cmd", "-n", "10")
    assert code == 0
    assert out.startswith("subscribed to [/cmd]\naverage")
    assert "window: 10\n" in out


@pytest.mark.parametrize(
    ("command", "line"),
    [
        ("hz", "at the agent, from joystick /joy_node: 10.000 Hz, period 100 ms (sd 310 µs, min 98.80 ms, "),
        ("bw", "at the agent, from joystick /joy_node: 1.00 kB/s, 100 B a message"),
        ("delay", "by the link's clock, from joystick /joy_node: p50 412 µs, p99 790 µs, max 1.20 ms, last 390 µs; "),
    ],
)
def test_the_agents_figures_of_a_remote_source_stand_behind(
    place: Place,
    talking: subprocess.Popen[str],
    agent: Callable[..., None],
    core: RosCore,
    command: str,
    line: str,
) -> None:
    agent(snapshot=with_core(core.uri))
    code, out, _ = place.run("topic", command, "/cmd", "-n", "10")
    assert code == 0
    assert f"\n\t{line}" in out
    (*_, last) = place.json("topic", command, "/cmd", "-n", "10", "--json")
    assert last["source"] == ("header" if command == "delay" else "subscriber")
    assert last["window"] == 10
    assert isinstance(last["routes"], list)
    assert last["routes"][0]["latency"]["error"] == 0.000216


@pytest.fixture
def proxy(background: Background, core: RosCore) -> Iterator[None]:
    """A node that stands for one of peer joystick: texts on /cmd at 50 Hz."""
    node = Node("/rmpa/joystick/joy_node", master_uri=core.uri)
    tasks: list[asyncio.Task[None]] = []

    async def talk(publisher: Publisher) -> None:
        while True:
            publisher.publish(publisher.make({"data": "hello"}))
            await asyncio.sleep(0.02)

    async def start() -> None:
        await node.__aenter__()
        tasks.append(asyncio.create_task(talk(await node.advertise("/cmd", "std_msgs/String"))))

    async def stop() -> None:
        tasks[0].cancel()
        await node.close()

    background.do(start())
    yield
    background.do(stop())


@pytest.mark.usefixtures("proxy")
def test_over_the_mesh_a_delay_needs_no_header(place: Place, agent: Callable[..., None], core: RosCore) -> None:
    agent(snapshot=with_core(core.uri))
    code, out, err = place.run("topic", "delay", "joystick:/cmd", "-n", "5")
    assert (code, err) == (0, "")
    assert "no header, so no stamp to measure the whole age by\n\tby the link's clock, from joystick" in out
    (*_, last) = place.json("topic", "delay", "/cmd", "-n", "5", "--json")
    assert (last["source"], last["delay"], last["error"]) == ("link", 0.00044, 0.000216)


@pytest.mark.usefixtures("proxy")
def test_without_the_agent_nobody_knows_the_links_clock(place: Place, core: RosCore) -> None:
    code, _, err = place.run("topic", "delay", "/cmd", "--master", core.uri)
    assert (code, err) == (
        1,
        "rmpa: std_msgs/String has no header, so it has no stamp to measure its age by [invalid-value]\n",
    )


def test_ctrl_c_is_quiet_and_leaves_nothing(place: Place, talking: subprocess.Popen[str], core: RosCore) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        with place.start("topic", "echo", "/cmd", "--json") as process:
            assert process.stdout is not None
            assert json.loads(process.stdout.readline())["topic"] == "/cmd"
            process.send_signal(number)
            _, err = process.communicate(timeout=30)
        assert (process.returncode, err) == (0, "")
        assert core.state().subscribers.get("/cmd") is None


def test_another_peers_messages_are_left_out(place: Place, talking: subprocess.Popen[str], core: RosCore) -> None:
    # What a bridge would register for another topic of peer joystick.
    with socket.create_server(("127.0.0.1", 0)) as stands:
        api = f"http://127.0.0.1:{stands.getsockname()[1]}/"
        assert core.call("registerPublisher", "/rmpa/joystick/joy", "/joy", "sensor_msgs/Joy", api).code == 1
        _hear_nothing_of_joystick(place)
        core.call("unregisterPublisher", "/rmpa/joystick/joy", "/joy", api)


def _hear_nothing_of_joystick(place: Place) -> None:
    with place.start("topic", "hz", "joystick:/cmd") as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "subscribed to [joystick:/cmd]\n"
        assert process.stdout.readline() == "no new messages\n"
        process.send_signal(signal.SIGINT)
        process.wait(30)
        assert process.stderr is not None
        assert process.stderr.read() == "! joystick:/cmd is not published yet; waiting [no-publisher]\n"


def test_delay_needs_a_header(place: Place, core: RosCore) -> None:
    place.environ["ROS_MASTER_URI"] = core.uri
    with place.start("topic", "pub", "/text", "std_msgs/String", "hello") as process:
        assert process.stdout is not None
        process.stdout.readline()
        code, _, err = place.run("topic", "delay", "/text")
        assert (code, err) == (
            1,
            "rmpa: std_msgs/String has no header, so it has no stamp to measure its age by [invalid-value]\n",
        )
        assert place.run("topic", "echo", "/text", "-n", "1")[1] == 'data: "hello"\n---\n'
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0


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
    place: Place, core: RosCore, background: Background, tmp_path: Path
) -> None:
    place.environ |= {"ROS_MASTER_URI": core.uri, "ROS_PACKAGE_PATH": str(tmp_path)}
    package(
        tmp_path / "stack" / "my_msgs", msg_Path="Header header\nPose[] poses\n", msg_Pose="float64 x\nfloat64 y\n"
    )
    assert published(place, "/path", "my_msgs/Path", "{header: auto, poses: [{x: 1}]}") == ""
    code, _, err = place.run("topic", "pub", "-1", "/path", "my_msgs/Path", "{z: 1}")
    assert (code, err) == (1, "rmpa: my_msgs/Path has no field 'z'; it has header, poses [invalid-message]\n")
    node = Node("/rmpa/base/camera", master_uri=core.uri)

    async def start() -> None:
        await node.__aenter__()
        await node.advertise("/size", MessageType.learn("far_msgs/Size", "int32 width\n"))
        await node.advertise("/pose", MessageType.learn("my_msgs/Pose", "int32 angle\n"))

    background.do(start())
    try:
        # Learnt from a topic of another name, at a peer.
        assert published(place, "/other", "far_msgs/Size", "width: 7") == ""
        code, _, err = place.run("topic", "pub", "-1", "/other", "far_msgs/Size", "{widht: 7}")
        assert (code, err) == (1, "rmpa: far_msgs/Size has no field 'widht'; it has width [invalid-message]\n")
        code, _, err = place.run("topic", "pub", "-1", "/other", "far_msgs/Sice")
        assert (code, f"; no publisher at {core.uri} tells it; source the workspace" in err) == (1, True)
        # Of one's own type the version that the topic has already.
        err = published(place, "/pose", "my_msgs/Pose", "angle: 7")
        assert "! /rmpa/base/camera publishes /pose with another version of my_msgs/Pose (md5 " in err
        assert f" than {tmp_path}/stack/my_msgs/msg/Pose.msg has (" in err
        assert published(place, "/pose2", "my_msgs/Pose", "x: 7") == ""
    finally:
        background.do(node.close())


def test_no_master(place: Place) -> None:
    place.environ["ROS_MASTER_URI"] = "http://127.0.0.1:1"
    for command in (("list",), ("echo", "/x"), ("hz", "/x"), ("pub", "-1", "/x", "std_msgs/Empty")):
        code, _, err = place.run("topic", *command)
        assert code == 1
        assert err == (
            "rmpa: no ROS master answers at http://127.0.0.1:1 (ROS_MASTER_URI); "
            "start one with `rmpa up` or `rmpa core`, or name it with --master [master-unreachable]\n"
        )
    assert place.run("topic", "list", "--master", "x")[0] == 2


def test_a_route_without_a_subscriber_does_not_say_that_its_publisher_sends_nothing() -> None:
    idle = RouteInfo(peer="a", node="/joy", direction="in", state="idle", type="sensor_msgs/Joy")
    assert route_line(idle) == " * from a: /joy idle: no node here subscribes, so its messages are not counted"
    assert route_line(msgspec.structs.replace(idle, state="open")) == " * from a: /joy open, 0 messages"


def test_the_agents_core_is_asked(place: Place, agent: Callable[..., None], core: RosCore) -> None:
    agent(snapshot=with_core(core.uri))
    place.environ.pop("ROS_MASTER_URI", None)
    assert "/rosout" in place.run("topic", "list")[1]
    place.environ["ROS_MASTER_URI"] = "http://127.0.0.1:1"
    assert "not the core of base: unset it, or say --agent" in place.run("topic", "list")[2]
    assert "/rosout" in place.run("topic", "list", "--agent", "base")[1]
    with socket.create_server(("127.0.0.1", 0)) as stands:  # or the core takes the node for dead
        api = f"http://127.0.0.1:{stands.getsockname()[1]}/"
        core.call("registerPublisher", "/n", "/cmd", "sensor_msgs/Joy", api)
        code, out, _ = place.run("topic", "info", "/cmd", "--agent", "base")
        other = place.run("topic", "info", "other:/cmd", "--agent", "base")[1]
    assert code == 0
    assert "MD5: 5a9ea5f83505693b71e785041e67a8bb" in out
    assert out.splitlines()[-13:] == [
        " * from joystick: /joy_node open, 600 messages, last 50.00 ms ago",
        "     there      /stick/cmd",
        "     transport  relayed for /velocity (5.0 s): the contract asks for a deadline (condition contract)",
        "     lane       express",
        "     rate       10.000 Hz, period 100 ms (sd 310 µs, min 98.80 ms, max 101 ms, p99 101 ms), jitter 820 µs",
        "     latency    p50 412 µs, p99 790 µs, max 1.20 ms, last 390 µs; each ± 216 µs",
        "     bandwidth  1.00 kB/s, 100 B a message",
        "     missing    3 lost, 2 late, 4 expired, 1 dropped here",
        "     too long   2 left out by the agent of joystick, the last of 270 MB; at most 268 MB cross: send parts",
        "     contract   reliability reliable, deadline 200 ms",
        "     events     deadline_missed 3, messages_lost 3",
        "                1 min 2 s ago: messages_lost: 3 messages lost",
        "                4.2 s ago: deadline_missed: no message for 610 ms; deadline 200 ms",
    ]
    assert "latency" not in other
