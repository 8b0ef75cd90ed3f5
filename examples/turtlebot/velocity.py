"""The module *velocity*: computes the Velocity Order from each Command Information.

rmpa run velocity.py
"""

import time
from typing import Any

from mapping import Ramp, velocity_order
from rmpa.resource import Resource

velocity = Resource("velocity", role="controlling", description="from the stick to the wheels")
command = velocity.input("/command_information", "sensor_msgs/Joy", deadline="300 ms")
order = velocity.output("/velocity_order", "geometry_msgs/Twist", deadline="300 ms")
acceleration = velocity.attribute("acceleration", better="min", unit="m/s²")
delay = velocity.attribute("delay", better="min", unit="s")
ramp = Ramp()


@velocity.profile(offers={"acceleration": "6.5 m/s²", "delay": "10 ms"}, cost=1)
def direct() -> None:
    """What the stick says, at once."""
    ramp.limit = 0.0


@velocity.profile(offers={"acceleration": "1 m/s²", "delay": "650 ms"}, cost=2)
def gentle() -> None:
    """For a robot that carries a full glass: it gathers speed slowly. It brakes as hard as ever."""
    ramp.limit = 1.0


@velocity.task(on=command)
async def answer(seen: Any) -> None:
    """Answer a command with an order."""
    wanted, turn = velocity_order(seen.axes, seen.buttons)
    speed = ramp.speed(wanted, time.monotonic())
    order.publish(linear={"x": speed}, angular={"z": turn})
    acceleration.observe(ramp.acceleration)
    delay.observe(ramp.delay(wanted))
