"""The simulated Turtlebot: pose, command and odometry. No I/O; ``now`` is an argument."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mapping import MAX_SPEED, MAX_TURN, limited
from unicycle import Pose

if TYPE_CHECKING:
    from rmpa.ros.types.messages import Plain

ORDER_TIMEOUT = 0.5
"""Seconds: without a command for so long the robot stops."""
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
        self.top_speed = MAX_SPEED
        """m/s; no order makes it faster."""
        self._ordered = -math.inf
        self._moved = -math.inf

    def order(self, speed: float, turn: float, now: float) -> None:
        """Follow an order (m/s, rad/s) from ``now`` on, within what the robot can do."""
        self.step(now)
        self.speed, self.turn = limited(speed, self.top_speed), limited(turn, MAX_TURN)
        self._ordered = now

    def step(self, now: float) -> None:
        """Drive until ``now`` (seconds); stop where the last order is too old."""
        end = min(now, self._ordered + ORDER_TIMEOUT)
        if end > self._moved and math.isfinite(self._moved):
            self.pose = self.pose.moved(self.speed, self.turn, end - self._moved)
        self._moved = now
        if now >= self._ordered + ORDER_TIMEOUT:
            self.speed = self.turn = 0.0

    def power(self, rate: float) -> float:
        """What it takes, in W: its computer the more, the more often (Hz) it tells its odometry, and its motors."""
        return 2.5 + 0.08 * rate + 12.0 * abs(self.speed)


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
