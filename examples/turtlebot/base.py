"""The module *base*: a simulated Turtlebot that drives as the Velocity Order says and tells its odometry.

rmpa run base.py
"""

import time
from typing import Any

from mapping import MAX_SPEED
from rmpa.resource import Resource, at_most
from robot import Turtlebot, odometry

base = Resource("base", role="acting", physical=False, description="a simulated Turtlebot")
orders = base.input("/velocity_order", "geometry_msgs/Twist")
odom = base.output("/odom", "nav_msgs/Odometry", deadline="300 ms")
rate = base.parameter("rate", 50.0, low=1.0, high=100.0, unit="Hz", description="of the odometry; profiles set it")
power = base.attribute("power", better="min", unit="W")
robot = Turtlebot()


@base.profile(offers={"rate": "50 Hz", "power": "15 W"})
def full() -> None:
    """As fast as a Turtlebot is."""
    rate.value, robot.top_speed = 50.0, MAX_SPEED


@base.profile(offers={"rate": "10 Hz", "power": "6 W"}, best_effort=True)
def saving() -> None:
    """Slow, and seldom heard: what the battery lasts longest with."""
    rate.value, robot.top_speed = 10.0, 0.2


base.context("low_battery", requires={"power": at_most("6 W")}, profiles=["saving"])


@base.task(on=orders)
async def follow(order: Any) -> None:
    """Drive as the order says, from now on."""
    robot.order(order.linear.x, order.angular.z, time.monotonic())


@base.task(rate=rate)
async def drive() -> None:
    """Tell where the wheels have brought it (REP 105: the pose in ``odom``, the speed in ``base_link``)."""
    robot.step(time.monotonic())
    odom.publish(**odometry(robot, time.time_ns()))
    power.observe(robot.power(rate.value))
