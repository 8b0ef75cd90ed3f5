"""A controller that keeps a distance by what a sonar sees, and asks it for as much as it needs at the moment.

rmpa run examples/resources/keeper.py
"""

from collections import deque
from typing import Any

from rmpa.resource import Resource, at_least, at_most

keeper = Resource("keeper", role="controlling", physical=False, description="keeps a distance to what the sonar sees")
ranges = keeper.input("/sonar/ranges", "sensor_msgs/Range")
speed = keeper.output("/cmd_vel", "geometry_msgs/Twist")
distance = keeper.parameter("distance", 1.0, low=0.3, high=3.0, unit="m")
gain = keeper.parameter("gain", 0.8, low=0.0, high=2.0)
closeness = keeper.attribute("closeness", better="min", unit="m", category="spatial")
sonar = keeper.asks("sonar", rate=at_least("15 Hz", hard=True))
last: deque[float] = deque(maxlen=2)


@keeper.profile(offers={"rate": "20 Hz", "closeness": "20 cm"}, cost=1, best_effort=True)
def follow() -> None:
    """Keep the distance roughly."""
    sonar.ask(rate=at_least("15 Hz", hard=True), accuracy=at_most("10 cm"))


@keeper.profile(offers={"rate": "20 Hz", "closeness": "2 cm"}, cost=4)
def dock() -> None:
    """Keep it exactly: the sonar must be better for that."""
    sonar.ask(rate=at_least("15 Hz", hard=True), accuracy=at_most("1 cm", hard=True))


@keeper.task(on=ranges)
def control(seen: Any) -> None:
    """Drive towards the distance, half a metre a second at the most."""
    wanted = gain.value * (seen.range - distance.value)
    speed.publish(linear={"x": max(-0.5, min(0.5, wanted))})
    last.append(seen.range)
    closeness.observe(max(last) - min(last))  # by as much as what it sees jumps about it cannot keep a distance
