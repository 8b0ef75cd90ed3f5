"""Parts of the examples: a rate, the robot's model, a stick."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping import velocity_order
from rate import Rate
from rmpa.ros.types.messages import MessageType
from robot import Turtlebot, odometry
from stick import AXIS, BUTTON, EVENT, LinuxJoystick, Recording, StickState
from unicycle import Pose


class Time:
    """A clock that moves only by sleeping and by the body's work."""

    def __init__(self) -> None:
        self.now = 100.0
        self.slept: list[float] = []

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds

    def rate(self, hz: float) -> Rate:
        return Rate(hz, now=lambda: self.now, sleep=self.sleep)


async def test_missed_periods_are_left_out() -> None:
    time = Time()
    ticks = time.rate(10)
    await anext(ticks)
    time.now += 1.05
    assert await anext(ticks) == pytest.approx(101.0)
    assert await anext(ticks) == pytest.approx(101.1)
    assert ticks.missed == 9


def test_it_stops_half_a_second_after_the_last_order() -> None:
    robot = Turtlebot()
    robot.order(0.4, 0.0, 10.0)
    robot.step(13.0)
    assert robot.pose.x == pytest.approx(0.2)
    assert (robot.speed, robot.turn) == (0.0, 0.0)
    robot.step(14.0)
    assert robot.pose.x == pytest.approx(0.2)


def test_it_keeps_to_its_limits_and_stops_at_nonsense() -> None:
    robot = Turtlebot()
    robot.order(9.0, -9.0, 1.0)
    assert (robot.speed, robot.turn) == (0.65, -3.14)
    robot.order(math.nan, math.inf, 1.1)
    assert (robot.speed, robot.turn) == (0.0, 0.0)


def test_its_odometry_is_a_message_in_the_frames_of_rep_105() -> None:
    robot = Turtlebot()
    robot.order(0.5, 1.0, 0.0)
    robot.step(0.4)
    kind = MessageType("nav_msgs/Odometry")
    message = kind.deserialize(kind.serialize(kind.make(odometry(robot, 1_500_000_002))))
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_002)
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
    assert message.pose.pose.position.x == robot.pose.x
    orientation = message.pose.pose.orientation
    assert 2 * math.atan2(orientation.z, orientation.w) == pytest.approx(0.4)
    assert message.twist.twist.linear.x == 0.5
    assert len(message.pose.covariance) == 36


def test_a_quarter_circle_to_the_left_is_exact_in_one_step() -> None:
    pose = Pose().moved(1.0, 1.0, math.pi / 2)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((1.0, 1.0, math.pi / 2))


GOLDEN = bytes.fromhex(
    "10270000 0000 81 00"  # button 0 is up, told at opening
    "10270000 0000 82 01"  # axis 1 is in the middle, told at opening
    "20270000 0180 02 01"  # axis 1 goes to -32767: stick full forward
    "30270000 ff3f 02 00"  # axis 0 goes to 16383: half to the right
    "40270000 0100 01 00"  # button 0 is held
)


def test_golden_bytes() -> None:
    state = StickState()
    state.feed(GOLDEN)
    axes, buttons = state.deflections
    assert axes == pytest.approx((-0.5, 1.0), abs=1e-4)
    assert buttons == (1,)


def test_byte_by_byte() -> None:
    whole, pieces = StickState(), StickState()
    whole.feed(GOLDEN)
    for index in range(len(GOLDEN)):
        pieces.feed(GOLDEN[index : index + 1])
    assert pieces.deflections == whole.deflections


@given(st.binary(max_size=200))
def test_any_bytes_are_a_bounded_state(data: bytes) -> None:
    state = StickState()
    state.feed(data)
    axes, buttons = state.deflections
    assert all(-1 <= axis <= 1 for axis in axes)
    assert set(buttons) <= {0, 1}
    assert len(axes) <= 64
    assert len(buttons) <= 64


def test_a_joystick_is_unplugged_and_comes_back(tmp_path: Path) -> None:
    device = str(tmp_path / "js0")
    said: list[str] = []
    joystick = LinuxJoystick(device, said.append)
    assert joystick.read() == ((), ())
    assert "is gone (No such file or directory)" in said.pop()
    assert joystick.read() == ((), ())
    assert not said, "said once"

    os.mkfifo(device)
    keeper = os.open(device, os.O_RDWR)
    os.write(keeper, EVENT.pack(0, 1, BUTTON, 0) + EVENT.pack(0, -32767, AXIS, 1))
    assert joystick.read() == ((0.0, 1.0), (1,))
    assert "is there" in said.pop()
    assert joystick.read() == ((0.0, 1.0), (1,)), "what is held stays held"

    os.close(keeper)
    assert joystick.read() == ((), ()), "unplugged: everything is released"
    assert "the robot stops" in said.pop()
    assert joystick.read() == ((), ())
    assert not said, "it can be opened but says nothing: still gone, and said once"
    joystick.close()


def test_the_recorded_drive_is_a_closed_loop_of_a_minute() -> None:
    time = [7.0]
    recording = Recording(now=lambda: time[0])
    assert len(recording.rows) == 600
    pose, furthest = Pose(), 0.0
    for _ in range(600):
        pose = pose.moved(*velocity_order(*recording.read()), 0.1)
        time[0] += 0.1
        furthest = max(furthest, abs(pose.x), abs(pose.y))
    assert (pose.x, pose.y, pose.heading) == pytest.approx((0, 0, 0), abs=0.01)
    assert 1.0 < furthest < 5.0
    assert recording.read() == recording.rows[0], "it loops"
    time[0] += 1.63
    assert recording.read() == recording.rows[16], "however often it is read"


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("", "no recorded drive"),
        ("forward,left,dead_man\n", "no recorded drive"),
        ("forward,left\n0,0\n", "line 2: not forward,left,dead_man"),
        ("forward,left,dead_man\n0,0,1\n0,up,1\n", "line 3: not forward,left,dead_man"),
        ("forward,left,dead_man\n0,1.5,1\n", "line 2: a deflection beyond"),
        ("forward,left,dead_man\n0,nan,1\n", "line 2: a deflection beyond"),
        ("forward,left,dead_man\n0,0,7\n", "line 2: a deflection beyond"),
    ],
)
def test_a_bad_recording_is_refused_with_its_line(tmp_path: Path, text: str, wrong: str) -> None:
    path = tmp_path / "drive.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=wrong):
        Recording(path)
