"""Publish one latched message of a type that no package has (rospy). Event: ``up``."""

import sys

import rospy
from genpy.dynamic import generate_dynamic
from payload import parser, say

TYPE = "strange_msgs/Gripper"
_TEXT = """std_msgs/Header header
strange_msgs/Finger[] fingers
string[2] names
===
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
===
MSG: strange_msgs/Finger
float32 force
uint8 joints
"""


def main() -> None:
    options = parser(__doc__)
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "stranger", anonymous=not args.name)
    classes = generate_dynamic(TYPE, _TEXT.replace("===", "=" * 80))
    publisher = rospy.Publisher(args.topic, classes[TYPE], queue_size=1, latch=True)
    finger = classes["strange_msgs/Finger"]
    message = classes[TYPE](fingers=[finger(force=1.5, joints=3)], names=["left", "right"])
    message.header.frame_id = "wrist"
    publisher.publish(message)
    say("up")
    rospy.spin()


if __name__ == "__main__":
    main()
