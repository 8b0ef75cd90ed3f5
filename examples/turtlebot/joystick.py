"""The module *joystick*: publishes the Command Information, ten times a second.

rmpa up --name joystick &
python joystick.py --device /dev/input/js0
"""

from __future__ import annotations

import sys
import time

from module import arguments, joined, run
from rate import Rate
from stick import LinuxJoystick, Recording, Stick

RATE = 10
"""Hz; the paper's."""


async def joystick(master_uri: str, stick: Stick) -> None:
    """Publish the stick's state as ``sensor_msgs/Joy`` on ``/command_information``."""
    async with joined("joystick", master_uri, "sensor_msgs/Joy") as node:
        publisher = await node.advertise("/command_information", "sensor_msgs/Joy")
        async for _ in Rate(RATE):
            axes, buttons = stick.read()
            stamp = time.time_ns()
            message = publisher.make({"axes": list(axes), "buttons": list(buttons)})
            message.header.frame_id = "joystick"
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
            publisher.publish(message)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--device", help="a Linux joystick such as /dev/input/js0 [default: a recorded drive]")
    options = parser.parse_args()
    run(joystick(options.master, LinuxJoystick(options.device, _say) if options.device else Recording()))
