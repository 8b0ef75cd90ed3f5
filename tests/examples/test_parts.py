"""Parts of the examples: a rate, the robot's model, a stick."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping import velocity_order
from rate import Rate
from rmpa.ros.types.messages import MessageType
from robot import Turtlebot, odometry
from stick import AXIS, BUTTON, EVENT, INIT, LinuxJoystick, Recording, StickState
from unicycle import Pose, wrapped

if TYPE_CHECKING:
    from pathlib import Path


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


async def test_ticks_are_due_at_absolute_times() -> None:
    time = Time()
    seen = []
    async for due in time.rate(10):
        seen.append(due)
        time.now += 0.03 * len(seen) % 0.09
        if len(seen) == 50:
            break
    assert seen == pytest.approx([100.0 + tick / 10 for tick in range(50)])


async def test_the_first_tick_is_at_once() -> None:
    time = Time()
    async for _ in time.rate(1):
        break
    assert time.slept == [0.0]


async def test_after_a_late_tick_the_next_is_on_time() -> None:
    time = Time()
    ticks = time.rate(10)
    await anext(ticks)
    time.now += 0.15
    assert await anext(ticks) == pytest.approx(100.1)
    assert await anext(ticks) == pytest.approx(100.2)
    assert ticks.missed == 0
    assert time.now == pytest.approx(100.2)


async def test_missed_periods_are_left_out() -> None:
    time = Time()
    ticks = time.rate(10)
    await anext(ticks)
    time.now += 1.05
    assert await anext(ticks) == pytest.approx(101.0)
    assert await anext(ticks) == pytest.approx(101.1)
    assert ticks.missed == 9


@pytest.mark.parametrize("hz", [0, -1, float("nan")])
def test_a_rate_is_above_zero(hz: float) -> None:
    with pytest.raises(ValueError, match="above 0 Hz"):
        Rate(hz)


def test_it_stands_until_it_is_told_to_drive() -> None:
    robot = Turtlebot()
    robot.step(10.0)
    robot.step(20.0)
    assert robot.pose == Pose()


def test_it_drives_from_the_moment_of_the_order() -> None:
    robot = Turtlebot()
    robot.step(10.0)
    robot.order(0.5, 0.0, 10.3)
    robot.step(10.5)
    assert robot.pose.x == pytest.approx(0.1)


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


def test_a_slower_profile_keeps_it_slow_and_takes_less_power() -> None:
    robot = Turtlebot()
    robot.order(0.65, 0.0, 1.0)
    fast = robot.power(50)
    robot.top_speed = 0.2
    robot.order(0.65, 0.0, 1.1)
    assert robot.speed == 0.2
    assert robot.power(10) < 6 < fast < 15


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


def test_straight_on() -> None:
    assert Pose(1.0, 2.0, 0.0).moved(0.5, 0.0, 2.0) == Pose(2.0, 2.0, 0.0)


def test_a_spin_stays_in_place() -> None:
    pose = Pose(1.0, 2.0, 0.0).moved(0.0, 1.0, math.pi / 2)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((1.0, 2.0, math.pi / 2))


def test_a_quarter_circle_to_the_left_is_exact_in_one_step() -> None:
    pose = Pose().moved(1.0, 1.0, math.pi / 2)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((1.0, 1.0, math.pi / 2))


def test_a_full_circle_comes_back() -> None:
    pose = Pose(0.3, -0.2, 1.0).moved(0.5, -0.5, 4 * math.pi)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((0.3, -0.2, 1.0))


finite = st.floats(-3, 3)


@given(finite, finite, st.floats(-3.1, 3.1), st.floats(0, 2), st.floats(0, 2))
def test_two_steps_are_one(speed: float, turn: float, heading: float, first: float, second: float) -> None:
    once = Pose(heading=heading).moved(speed, turn, first + second)
    twice = Pose(heading=heading).moved(speed, turn, first).moved(speed, turn, second)
    assert (once.x, once.y) == pytest.approx((twice.x, twice.y), abs=1e-6)
    assert math.cos(once.heading - twice.heading) == pytest.approx(1.0)


def test_headings_are_wrapped() -> None:
    assert wrapped(-math.pi) == math.pi
    assert wrapped(3 * math.pi) == pytest.approx(math.pi)
    assert wrapped(2 * math.pi + 0.1) == pytest.approx(0.1)


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


def test_the_most_negative_value_is_a_full_deflection() -> None:
    state = StickState()
    state.feed(EVENT.pack(0, -32768, AXIS | INIT, 0))
    assert state.deflections[0] == (1.0,)


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
