"""The module *velocity*: computes the Velocity Order from each Command Information.

rmpa up --name velocity &
python velocity.py
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mapping import velocity_order
from module import arguments, joined, run

if TYPE_CHECKING:
    from rmpa.ros.aio.node import Received


async def velocity(master_uri: str) -> None:
    """Answer each ``sensor_msgs/Joy`` with a ``geometry_msgs/Twist`` on ``/velocity_order``, at once."""
    async with joined("velocity", master_uri, "sensor_msgs/Joy", "geometry_msgs/Twist") as node:
        publisher = await node.advertise("/velocity_order", "geometry_msgs/Twist")

        def command(received: Received) -> None:
            speed, turn = velocity_order(received.message.axes, received.message.buttons)
            publisher.publish(publisher.make({"linear": {"x": speed}, "angular": {"z": turn}}))

        await node.subscribe("/command_information", "sensor_msgs/Joy", command)
        await node.stopped.wait()


if __name__ == "__main__":
    run(velocity(arguments(__doc__).parse_args().master))
