"""A stand-in for usb_cam (rospy), with Debian's dynamic_reconfigure: ``/NAME/image_raw`` at ``frame_rate`` Hz."""

import sys
import time
from types import SimpleNamespace
from typing import Any

import rospy
from dynamic_reconfigure.server import Server
from payload import parser, say
from sensor_msgs.msg import Image

# What generate_dynamic_reconfigure_options makes of a .cfg file.
CONFIG = SimpleNamespace(
    min={"frame_rate": 1, "gain": 0.0},
    max={"frame_rate": 60, "gain": 4.0},
    defaults={"frame_rate": 30, "gain": 1.0},
    level={"frame_rate": 0, "gain": 0},
    all_level=0,
    config_description={
        "name": "Default",
        "type": "",
        "state": True,
        "cstate": "true",
        "id": 0,
        "parent": 0,
        "parameters": [
            {"name": name, "type": kind, "level": 0, "description": text, "edit_method": ""}
            for name, kind, text in (("frame_rate", "int", "Images a second"), ("gain", "double", "Of the sensor"))
        ],
        "groups": [],
    },
)


def main() -> None:
    options = parser(__doc__)
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "usb_cam")
    rate = [30]

    def changed(config: dict[str, Any], _level: int) -> dict[str, Any]:
        rate[0] = config["frame_rate"]
        return config

    Server(CONFIG, changed)
    images = rospy.Publisher("~image_raw", Image, queue_size=2)
    say("up", node=rospy.get_name())
    image = Image(width=160, height=120, encoding="rgb8", step=480, data=bytes(480 * 120))
    while not rospy.is_shutdown():
        image.header.stamp = rospy.Time.now()
        images.publish(image)
        time.sleep(1 / rate[0])


main()
