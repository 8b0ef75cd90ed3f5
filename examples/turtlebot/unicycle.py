"""How a Turtlebot moves: the unicycle model, integrated exactly along arcs (REP 103: metres, radians, x forward)."""

from __future__ import annotations

import math
from dataclasses import dataclass

STRAIGHT = 1e-6
"""Radians turned in one step below which the arc is a straight line to double precision."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the robot is, in the frame ``odom``: metres, and radians in (-pi, pi] counter-clockwise from x."""

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0

    def moved(self, speed: float, turn: float, seconds: float) -> Pose:
        """The pose after driving with constant ``speed`` (m/s) and ``turn`` (rad/s) for ``seconds``.

        The path is an arc of the radius ``speed / turn``. Its chord has the length ``speed * seconds * sin(h) / h``,
        h being half of the angle turned, and points halfway between the old heading and the new one.
        """
        half = turn * seconds / 2
        chord = speed * seconds * (1.0 if abs(half) < STRAIGHT else math.sin(half) / half)
        return Pose(
            self.x + chord * math.cos(self.heading + half),
            self.y + chord * math.sin(self.heading + half),
            wrapped(self.heading + 2 * half),
        )


def wrapped(angle: float) -> float:
    """The same angle in (-pi, pi]."""
    angle = math.remainder(angle, math.tau)
    return math.pi if angle <= -math.pi else angle
