"""``rmpa topic`` against our own core."""

from __future__ import annotations

import json
import signal
from typing import TYPE_CHECKING

import pytest

from tests.cli.conftest import Place, with_core

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Callable, Iterator

    from rmpa.ros.aio.core import RosCore

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
        yield process
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    assert core.state().publishers.get("/cmd") is None


def test_list_and_info(place: Place, talking: subprocess.Popen[str], core: RosCore) -> None:
    # What a bridge would register for peer joystick.
    reply = core.call("registerPublisher", "/rmpa/joystick/joy", "/cmd", "sensor_msgs/Joy", "http://127.0.0.1:9/")
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
    assert place.run("topic", "info", "/cdm") == (1, "", "rmpa: no topic /cdm; did you mean /cmd?\n")
    core.call("unregisterPublisher", "/rmpa/joystick/joy", "/cmd", "http://127.0.0.1:9/")


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
    assert (code, err) == (1, "rmpa: no field 'axis' in the message; it has header, axes, buttons\n")


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


def test_ctrl_c_is_quiet_and_leaves_nothing(place: Place, talking: subprocess.Popen[str], core: RosCore) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        with place.start("topic", "echo", "/cmd", "--json") as process:
            assert process.stdout is not None
            assert json.loads(process.stdout.readline())["topic"] == "/cmd"
            process.send_signal(number)
            _, err = process.communicate(timeout=30)
        assert (process.returncode, err) == (0, "")
        assert core.state().subscribers.get("/cmd") is None


def test_another_peers_messages_are_left_out(place: Place, talking: subprocess.Popen[str]) -> None:
    with place.start("topic", "hz", "joystick:/cmd") as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "subscribed to [joystick:/cmd]\n"
        assert process.stdout.readline() == "no new messages\n"
        process.send_signal(signal.SIGINT)
        process.wait(30)


def test_delay_needs_a_header(place: Place, core: RosCore) -> None:
    place.environ["ROS_MASTER_URI"] = core.uri
    with place.start("topic", "pub", "/text", "std_msgs/String", "hello") as process:
        assert process.stdout is not None
        process.stdout.readline()
        code, _, err = place.run("topic", "delay", "/text")
        assert (code, err) == (1, "rmpa: std_msgs/String has no header, and so no stamp to tell its age by\n")
        assert place.run("topic", "echo", "/text", "-n", "1")[1] == 'data: "hello"\n---\n'
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("/x", "std_msgs/String", "{dta: 1}"), 1, "std_msgs/String has no field 'dta'; it has data"),
        (("/x", "std_msgs/String", "{data: ["), 2, "VALUES: not YAML: "),
        (("/x", "no_msgs/None"), 1, "no_msgs/None"),
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


def test_no_master(place: Place) -> None:
    place.environ["ROS_MASTER_URI"] = "http://127.0.0.1:1"
    for command in (("list",), ("echo", "/x"), ("hz", "/x"), ("pub", "-1", "/x", "std_msgs/Empty")):
        code, _, err = place.run("topic", *command)
        assert code == 1
        assert err == (
            "rmpa: no ROS master answers at http://127.0.0.1:1 (ROS_MASTER_URI); "
            "start one with `rmpa up` or `rmpa core`, or name it with --master\n"
        )
    assert place.run("topic", "list", "--master", "x")[0] == 2


def test_the_agents_core_is_asked(place: Place, agent: Callable[..., None], core: RosCore) -> None:
    agent(snapshot=with_core(core.uri))
    place.environ.pop("ROS_MASTER_URI", None)
    assert "/rosout" in place.run("topic", "list")[1]
    place.environ["ROS_MASTER_URI"] = "http://127.0.0.1:1"
    assert "not the core of base: unset it, or say --agent" in place.run("topic", "list")[2]
    assert "/rosout" in place.run("topic", "list", "--agent", "base")[1]
    core.call("registerPublisher", "/n", "/cmd", "sensor_msgs/Joy", "http://127.0.0.1:9/")
    code, out, _ = place.run("topic", "info", "/cmd", "--agent", "base")
    assert code == 0
    assert "MD5: 5a9ea5f83505693b71e785041e67a8bb" in out
    assert out.splitlines()[-10:] == [
        " * from joystick: /joy_node open, 600 messages, last 50.00 ms ago",
        "     lane       express",
        "     rate       10.000 Hz, period 100 ms (sd 310 µs, min 98.80 ms, max 101 ms, p99 101 ms), jitter 820 µs",
        "     latency    p50 412 µs, p99 790 µs, max 1.20 ms, last 390 µs; each ± 216 µs",
        "     bandwidth  1.00 kB/s, 100 B a message",
        "     missing    3 lost, 2 late, 4 expired, 1 dropped here",
        "     contract   reliability reliable, deadline 200 ms",
        "     events     deadline_missed 3, messages_lost 3",
        "                1 min 2 s ago: messages_lost: 3 messages lost",
        "                4.2 s ago: deadline_missed: no message for 610 ms; deadline 200 ms",
    ]
    assert "latency" not in place.run("topic", "info", "other:/cmd", "--agent", "base")[1]
