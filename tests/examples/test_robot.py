from __future__ import annotations

import math

import pytest

from rmpa.ros.types.messages import MessageType
from robot import Turtlebot, odometry
from unicycle import Pose


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
