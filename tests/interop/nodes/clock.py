"""A simulator as far as time goes (rospy): publishes /clock at 100 Hz, from ``--start`` on, ``--speed`` fast.

Events: ``up``.
"""

import sys
import time

import rospy
from payload import parser, say
from rosgraph_msgs.msg import Clock


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--start", type=float, default=1000.0, help="the first time")
    options.add_argument("--speed", type=float, default=1.0, help="seconds of it in a second")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "simulator", anonymous=not args.name)
    publisher = rospy.Publisher("/clock", Clock, queue_size=10)
    say("up", node=rospy.get_name())
    begin = time.monotonic()
    while not rospy.is_shutdown():
        now = args.start + (time.monotonic() - begin) * args.speed
        publisher.publish(Clock(clock=rospy.Time.from_sec(now)))
        time.sleep(0.01)


if __name__ == "__main__":
    main()
