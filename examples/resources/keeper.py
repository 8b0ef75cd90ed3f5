"""A controller that keeps a distance by what a sonar sees: rmpa run examples/resources/keeper.py."""

from typing import Any

from rmpa.resource import Resource

keeper = Resource("keeper", role="controlling", description="keeps a distance to what the sonar sees")
ranges = keeper.input("/sonar/ranges", "sensor_msgs/Range")
speed = keeper.output("/cmd_vel", "geometry_msgs/Twist")
distance = keeper.parameter("distance", 1.0, low=0.3, high=3.0, unit="m")
gain = keeper.parameter("gain", 0.8, low=0.0, high=2.0)


@keeper.profile(offers={"rate": "20 Hz"})
def follow() -> None:
    """One order for each measurement."""


@keeper.task(on=ranges)
def control(seen: Any) -> None:
    """Drive towards the distance, half a metre a second at the most."""
    wanted = gain.value * (seen.range - distance.value)
    speed.publish(linear={"x": max(-0.5, min(0.5, wanted))})
