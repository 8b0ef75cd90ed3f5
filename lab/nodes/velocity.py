"""The velocity node of the paper's robot (rospy): each command that comes in leaves as a velocity, its head kept.

``--mode event``: at once; ``--mode polled``: at ``--rate`` Hz the newest command, if there is a new one.
Events: ``up``; ``connected`` with the number of subscribers of the velocity.
"""

import sys

import rospy
from std_msgs.msg import UInt8MultiArray

from node import Newest, Subscribers, say, serve_polls, velocity_options
from rospy_ends import Counted, listen


def main() -> None:
    """Run until ROS ends us."""
    args = velocity_options(__doc__).parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "velocity", anonymous=not args.name)
    publisher = rospy.Publisher(args.vel, UInt8MultiArray, Counted(Subscribers()), queue_size=args.queue)
    newest = Newest()
    listen(args.cmd, publisher.publish if args.mode == "event" else newest.put, args.queue, nodelay=args.nodelay)

    def poll() -> None:
        message = newest.take()
        if message is not None and not rospy.is_shutdown():
            publisher.publish(message)

    say("up")
    if args.mode == "polled":
        serve_polls(args.rate, poll, lambda: not rospy.is_shutdown())
    else:
        rospy.spin()


if __name__ == "__main__":
    main()
