"""From the stick to the wheels: the Command Information's axes and buttons become a speed and a turn rate."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

MAX_SPEED = 0.65
"""m/s, of a Turtlebot 2."""
MAX_TURN = 3.14
"""rad/s, of a Turtlebot 2."""
DEAD_ZONE = 0.1
"""Of a stick's way; a worn one does not come back to 0."""
AXIS_LEFT, AXIS_FORWARD = 0, 1
"""Of the left stick; 1.0 is full left, full forward (the convention of ROS's joy node)."""
STEP_MIN, STEP_MAX = 0.02, 0.2
"""Seconds between two orders as the ramp counts them: a heap of late ones is no leap, nor is a silence."""
DEAD_MAN = 0
"""The button that must be held."""


def velocity_order(axes: Sequence[float], buttons: Sequence[int]) -> tuple[float, float]:
    """The speed (m/s) and turn rate (rad/s, counter-clockwise) that a stick asks for.

    Without the dead-man button, and from a joystick that lacks the axes or sends nonsense, it is a stop.
    """
    if len(buttons) <= DEAD_MAN or not buttons[DEAD_MAN] or len(axes) <= max(AXIS_LEFT, AXIS_FORWARD):
        return 0.0, 0.0
    forward, left = float(axes[AXIS_FORWARD]), float(axes[AXIS_LEFT])
    if not (math.isfinite(forward) and math.isfinite(left)):
        return 0.0, 0.0
    return MAX_SPEED * beyond_dead_zone(forward), MAX_TURN * beyond_dead_zone(left)


def beyond_dead_zone(deflection: float) -> float:
    """0 in the dead zone; from its edge on linear to ±1, so that the robot does not jump."""
    way = (min(1.0, abs(deflection)) - DEAD_ZONE) / (1 - DEAD_ZONE)
    return math.copysign(max(0.0, way), deflection) if way > 0 else 0.0


def limited(value: float, limit: float) -> float:
    """The value within ±limit; 0 for one that is not a number."""
    return max(-limit, min(limit, value)) if math.isfinite(value) else 0.0


class Ramp:
    """Lets a speed grow only so fast; it may fall at once, for a stop is a stop."""

    def __init__(self) -> None:
        self.limit = 0.0
        """m/s²; 0: as fast as you like."""
        self.acceleration = 0.0
        """m/s², of the last step; 0 where the speed fell."""
        self._speed = 0.0
        self._at = -math.inf

    def speed(self, wanted: float, now: float) -> float:
        """The speed (m/s) to have at ``now`` (seconds) on the way to the one that is wanted."""
        seconds = min(STEP_MAX, max(STEP_MIN, now - self._at))
        before = self._speed if wanted * self._speed > 0 else 0.0
        gain = max(0.0, abs(wanted) - abs(before))
        if self.limit:
            gain = min(gain, self.limit * seconds)
        self.acceleration = gain / seconds
        self._speed = math.copysign(min(abs(wanted), abs(before) + gain), wanted)
        self._at = now
        return self._speed

    def delay(self, wanted: float) -> float:
        """Seconds until the wanted speed will be reached."""
        return max(0.0, abs(wanted) - abs(self._speed)) / self.limit if self.limit else 0.0
