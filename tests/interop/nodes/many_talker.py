"""Publish numbered, checksummed payloads on many topics of one node (rospy); all as in many_talker.cpp."""

import sys
import time

import rospy
from payload import Pattern, parser, say
from std_msgs.msg import UInt8MultiArray


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--topics", type=lambda text: text.split(","), default=["/chatter"])
    options.add_argument("--rate", type=float, default=10.0)
    options.add_argument("--size", type=int, default=64)
    options.add_argument("--source", type=int, default=1)
    options.add_argument("--latch", action="store_true")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "many_talker", anonymous=not args.name)
    publishers = [
        rospy.Publisher(topic, UInt8MultiArray, queue_size=10000, latch=args.latch) for topic in args.topics
    ]
    say("up", node=rospy.get_name())
    pattern = Pattern(args.size)
    sequence = 0
    while not rospy.is_shutdown() and not (args.latch and sequence):
        sequence += 1
        message = UInt8MultiArray(data=pattern.payload(args.source, sequence))
        for publisher in publishers:
            publisher.publish(message)
        time.sleep(1 / args.rate)
    say("done", sent=sequence)
    rospy.spin()


if __name__ == "__main__":
    main()
