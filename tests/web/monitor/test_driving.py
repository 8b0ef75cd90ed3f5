"""What a joystick publishes: a ramp upwards, stops at once, and a message of the topic's own type."""

from __future__ import annotations

from typing import Any

import pytest

from rmpa.core.errors import RmpaError
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.messages import MessageType
from rmpa.web.hub.hub import HubClient
from rmpa.web.monitor import limits
from rmpa.web.monitor.driving import TYPES, Command, Driver, type_driven
from tests.web.recorder import NOW_NS, Asked, FakeHub

FULL = Command(1.0, 0.0, 1.0, (0.5, -1.0), (True, False))
STAMP = {"secs": NOW_NS // 10**9, "nsecs": NOW_NS % 10**9}


class Wheels(HubClient):
    """A client whose publisher is written down."""

    def __init__(self) -> None:
        self.hub: Any = FakeHub()
        self.asked: list[Asked] = []

    def advertise(self, topic: str, type_: str, _failed: Any, *, latch: bool = False) -> Any:
        self.asked.append(Asked("advertise", topic=topic, type=type_, latch=latch))
        return self.asked[-1]

    def messages(self) -> list[Any]:
        """What was published, decoded."""
        (asked,) = self.asked
        codec = codec_for(MessageType(asked.type))
        return [codec.plain_values(memoryview(each)) for each in asked.published]


def driver(type_: str) -> tuple[Driver, Wheels]:
    wheels = Wheels()
    return Driver(wheels, "/cmd_vel", type_, lambda _: None), wheels


def test_a_jump_of_the_stick_is_a_ramp_and_a_stop_is_immediate() -> None:
    made, wheels = driver("geometry_msgs/Twist")
    made.command(Command(), 1.0, 10.0)
    for number in range(1, 31):
        made.command(Command(1.0, angular=-1.0), 1.0, 10.0 + number / 10)
    made.command(Command(0.5), 1.0, 13.1)
    made.command(Command(-1.0), 1.0, 13.2)
    made.stop()
    speeds = [each["linear"]["x"] for each in wheels.messages()]
    assert speeds[:4] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert speeds[20:31] == pytest.approx([limits.DRIVE_SPEED] * 11)
    assert speeds[31:] == pytest.approx([0.5 * limits.DRIVE_SPEED, -0.1, 0.0])
    assert wheels.messages()[1]["angular"]["z"] == pytest.approx(-0.05 * limits.DRIVE_TURN)


def test_a_pause_between_commands_is_no_leap() -> None:
    made, wheels = driver("geometry_msgs/Twist")
    made.command(Command(), 1.0, 10.0)
    made.command(Command(1.0), 1.0, 20.0)
    assert wheels.messages()[-1]["linear"]["x"] == pytest.approx(limits.DRIVE_TIMEOUT)


@pytest.mark.parametrize(
    ("type_", "values"),
    [
        ("geometry_msgs/Twist", lambda each: each),
        ("geometry_msgs/TwistStamped", lambda each: each["twist"]),
        ("ackermann_msgs/AckermannDrive", lambda each: each),
        ("ackermann_msgs/AckermannDriveStamped", lambda each: each["drive"]),
        ("sensor_msgs/Joy", lambda each: each),
    ],
)
def test_each_type_has_its_message_and_its_stop(type_: str, values: Any) -> None:
    made, wheels = driver(type_)
    made.command(FULL, 1.0, 0.0)
    for number in range(20):
        made.command(FULL, limits.DRIVE_ACCELERATION, number / 5)
    made.stop()
    *_, full, stopped = wheels.messages()
    if "header" in full:
        assert full["header"]["stamp"] == STAMP
        assert full["header"]["frame_id"] == ("" if type_ == "sensor_msgs/Joy" else "base_link")
    if type_ == "sensor_msgs/Joy":
        assert (full["axes"], full["buttons"]) == ([0.5, -1.0], [1, 0])
        assert (stopped["axes"], stopped["buttons"]) == ([0.0, 0.0], [0, 0])
    elif "ackermann" in type_:
        assert values(full)["speed"] == pytest.approx(limits.DRIVE_SPEED)
        assert values(full)["steering_angle"] == pytest.approx(limits.DRIVE_STEER)
        assert not any(values(stopped).values())
    else:
        assert values(full)["linear"]["x"] == pytest.approx(limits.DRIVE_SPEED)
        assert values(full)["angular"]["z"] == pytest.approx(limits.DRIVE_TURN)
        assert not any([*values(stopped)["linear"].values(), *values(stopped)["angular"].values()])


def test_a_topic_is_driven_by_its_own_type() -> None:
    graph: Any = FakeHub().graph
    assert type_driven(graph, "/cmd_vel", "sensor_msgs/Joy") == "sensor_msgs/Joy"
    graph.add_topic("/cmd_vel", "geometry_msgs/TwistStamped")
    with pytest.raises(RmpaError, match=r"/cmd_vel has the type geometry_msgs/TwistStamped, not geometry_msgs/Twist"):
        type_driven(graph, "/cmd_vel", "geometry_msgs/Twist")
    assert type_driven(graph, "/cmd_vel", "geometry_msgs/Twist", stops=True) == "geometry_msgs/TwistStamped"
    with pytest.raises(RmpaError, match="a joystick cannot drive 'std_msgs/String'"):
        type_driven(graph, "/chatter", "std_msgs/String")
    assert all(MessageType(each).md5sum for each in TYPES)
