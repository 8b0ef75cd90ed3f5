"""The module *base*: a simulated Turtlebot that drives as the Velocity Order says and tells its odometry.

rmpa up --name base &
python base.py
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from mapping import MAX_SPEED, MAX_TURN, limited
from module import arguments, joined, run
from rate import Rate
from unicycle import Pose

if TYPE_CHECKING:
    from rmpa.ros.aio.node import Received
    from rmpa.ros.messages import Plain

RATE = 50
"""Hz; a Turtlebot's."""
ORDER_TIMEOUT = 0.5
"""Seconds: a robot that hears no order for this long stops."""
SURE, UNKNOWN = 1e-4, 1e6
"""Variances: of what wheels measure, and of what a robot on the floor cannot know (height, roll, pitch)."""
COVARIANCE: list[Plain] = [
    variance if row == column else 0.0
    for row, variance in enumerate([SURE, SURE, UNKNOWN, UNKNOWN, UNKNOWN, SURE])
    for column in range(6)
]


class Turtlebot:
    """The simulated robot: its pose, and the order that it follows."""

    def __init__(self) -> None:
        self.pose = Pose()
        self.speed = 0.0
        self.turn = 0.0
        self._ordered = -math.inf
        self._moved = -math.inf

    def order(self, speed: float, turn: float, now: float) -> None:
        """Follow an order (m/s, rad/s) from ``now`` on, within what the robot can do."""
        self.step(now)
        self.speed, self.turn = limited(speed, MAX_SPEED), limited(turn, MAX_TURN)
        self._ordered = now

    def step(self, now: float) -> None:
        """Drive until ``now`` (seconds); stop where the last order is too old."""
        end = min(now, self._ordered + ORDER_TIMEOUT)
        if end > self._moved and math.isfinite(self._moved):
            self.pose = self.pose.moved(self.speed, self.turn, end - self._moved)
        self._moved = now
        if now >= self._ordered + ORDER_TIMEOUT:
            self.speed = self.turn = 0.0


async def base(master_uri: str) -> None:
    """Publish ``nav_msgs/Odometry`` on ``/odom``: the pose in ``odom``, the speed in ``base_link`` (REP 105)."""
    robot = Turtlebot()

    def order(received: Received) -> None:
        robot.order(received.message.linear.x, received.message.angular.z, time.monotonic())

    async with joined("base", master_uri, "nav_msgs/Odometry", "geometry_msgs/Twist") as node:
        publisher = await node.advertise("/odom", "nav_msgs/Odometry")
        await node.subscribe("/velocity_order", "geometry_msgs/Twist", order)
        async for _ in Rate(RATE):
            robot.step(time.monotonic())
            publisher.publish(publisher.make(odometry(robot, time.time_ns())))


def odometry(robot: Turtlebot, stamp: int) -> dict[str, Plain]:
    """The message's fields; ``stamp`` in nanoseconds since the epoch."""
    pose = robot.pose
    return {
        "header": {"stamp": {"secs": stamp // 10**9, "nsecs": stamp % 10**9}, "frame_id": "odom"},
        "child_frame_id": "base_link",
        "pose": {
            "pose": {
                "position": {"x": pose.x, "y": pose.y},
                "orientation": {"z": math.sin(pose.heading / 2), "w": math.cos(pose.heading / 2)},
            },
            "covariance": COVARIANCE,
        },
        "twist": {
            "twist": {"linear": {"x": robot.speed}, "angular": {"z": robot.turn}},
            "covariance": COVARIANCE,
        },
    }


if __name__ == "__main__":
    run(base(arguments(__doc__).parse_args().master))
