"""The module *joystick*: publishes the Command Information, ten times a second, or more often on request.

rmpa run joystick.py --set device=/dev/input/js0
"""

import sys
import time

from rmpa.resource import Resource
from stick import LinuxJoystick, Recording, Stick

joystick = Resource("joystick", role="sensing", description="the stick that steers")
command = joystick.output("/command_information", "sensor_msgs/Joy", deadline="300 ms")
device = joystick.parameter("device", "", description="such as /dev/input/js0; empty: a recorded drive")
rate = joystick.parameter("rate", 10.0, low=1.0, high=50.0, unit="Hz", description="profiles set it")
sticks: dict[str, Stick] = {}


@joystick.profile(offers={"rate": "10 Hz"}, cost=1, best_effort=True)
def steady() -> None:
    """The paper's."""
    rate.value = 10.0


@joystick.profile(offers={"rate": "25 Hz"}, cost=3)
def brisk() -> None:
    """For a fast robot."""
    rate.value = 25.0


@joystick.task(rate=rate)
def read() -> None:
    """Send the stick's present state. A device may block: this is a thread of its own."""
    stamp = time.time_ns()
    axes, buttons = stick().read()
    command.publish(
        header={"stamp": {"secs": stamp // 10**9, "nsecs": stamp % 10**9}, "frame_id": "joystick"},
        axes=list(axes),
        buttons=list(buttons),
    )


def stick() -> Stick:
    """What is read from; another one once the parameter is another."""
    name = device.value
    if name not in sticks:
        sticks[name] = LinuxJoystick(name, say) if name else Recording()
    return sticks[name]


def say(text: str) -> None:
    """Tell the user."""
    print(text, file=sys.stderr, flush=True)
