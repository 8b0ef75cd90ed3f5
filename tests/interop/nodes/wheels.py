"""Say which speeds a robot's wheels are commanded by ``geometry_msgs/Twist`` on ``--topic`` (rospy).

Events: ``up``; ``speed`` with ``linear`` (m/s), ``angular`` (rad/s) and ``at`` (wall clock, ns) for each message.
"""

import sys
import time

import rospy
from geometry_msgs.msg import Twist
from payload import parser, say


def main() -> None:
    args = parser(__doc__).parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "wheels", anonymous=not args.name)

    def turn(message: Twist) -> None:
        say("speed", linear=message.linear.x, angular=message.angular.z, at=time.time_ns())

    rospy.Subscriber(args.topic, Twist, turn, tcp_nodelay=True)
    say("up", node=rospy.get_name())
    rospy.spin()


if __name__ == "__main__":
    main()
