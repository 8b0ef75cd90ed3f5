"""Tell what time it is for a node (rospy), and sleep by it.

Events: ``up``; then again and again ``time`` with the time, and how long 0.5 s of it took by the wall's clock.
"""

import sys
import time

import rospy
from payload import parser, say


def main() -> None:
    args = parser(__doc__).parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "sleeper", anonymous=not args.name)
    say("up", node=rospy.get_name())
    while not rospy.is_shutdown():
        begin = time.monotonic()
        rospy.sleep(0.5)
        say("time", now=rospy.get_time(), took=time.monotonic() - begin)


if __name__ == "__main__":
    main()
