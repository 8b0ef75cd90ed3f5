"""A loop of rospy.Rate that publishes a message each time; reads "COUNT FILE" lines, as ``rate.cpp`` does.

FILE gets for each of COUNT times when it was due and when it began, ns of the clock that the loop follows (8 bytes
each, native order). The clock is rospy's: the wall's. Events: up; connected; done.
"""

import array
import sys
import time
from pathlib import Path

import rospy
from std_msgs.msg import UInt8MultiArray

from node import parser, say


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--topic", default="/chatter")
    options.add_argument("--rate", type=float, default=100.0)
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "timed_loop", anonymous=not args.name)
    publisher = rospy.Publisher(args.topic, UInt8MultiArray, queue_size=100)
    message = UInt8MultiArray(data=bytes(64))
    say("up")
    while not publisher.get_num_connections():
        time.sleep(0.01)
    say("connected")
    for line in sys.stdin:
        count, path = line.split()
        noted = array.array("Q")
        rate = rospy.Rate(args.rate)
        for _ in range(int(count)):
            rate.sleep()
            began = time.time_ns()
            noted.append(rate.last_time.to_nsec())
            noted.append(began)
            publisher.publish(message)
        Path(path).write_bytes(noted.tobytes())
        say("done")


if __name__ == "__main__":
    main()
