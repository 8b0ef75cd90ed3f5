"""Receive what talkers send on many topics of one node (rospy); options and events as of many_listener.cpp."""

import sys
import threading

import rospy
from payload import Tally, parser, say
from std_msgs.msg import UInt8MultiArray


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--topics", type=lambda text: text.split(","), default=["/chatter"])
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "many_listener", anonymous=not args.name)
    tallies = {topic: Tally() for topic in args.topics}
    lock = threading.Lock()

    def take(message: UInt8MultiArray, topic: str) -> None:
        with lock:
            tallies[topic].take(message.data)

    for topic in args.topics:
        rospy.Subscriber(topic, UInt8MultiArray, take, topic, buff_size=1 << 21)
    say("up", node=rospy.get_name())
    while not rospy.is_shutdown():
        rospy.rostime.wallsleep(0.2)
        with lock:
            say("report", topics={topic: tally.report() for topic, tally in tallies.items() if tally.count})


if __name__ == "__main__":
    main()
