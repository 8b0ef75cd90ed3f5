"""A camera driver with Debian's dynamic_reconfigure (rospy): ``/NAME/image`` at ``int_`` Hz, stamped.

Events: ``up``; ``config`` with ``int_`` and ``double_`` for each change.
"""

import sys
import time
from typing import Any

import rospy
from dynamic_reconfigure.cfg import TestConfig
from dynamic_reconfigure.server import Server
from payload import parser, say
from sensor_msgs.msg import CompressedImage


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--size", type=int, default=100, help="bytes of an image")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "tunable")
    rate = [1]

    def changed(config: dict[str, Any], _level: int) -> dict[str, Any]:
        rate[0] = config["int_"]
        say("config", int_=config["int_"], double_=config["double_"])
        return config

    Server(TestConfig, changed)
    images = rospy.Publisher("~image", CompressedImage, queue_size=10)
    say("up", node=rospy.get_name())
    message = CompressedImage(data=bytes(args.size))
    while not rospy.is_shutdown():
        message.header.stamp = rospy.Time.now()
        images.publish(message)
        time.sleep(1 / max(rate[0], 1))


main()
