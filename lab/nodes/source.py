"""Publish rounds of measured messages on an absolute schedule (rospy); see ``node.serve_rounds``.

Events: ``up``; ``connected`` with the number of subscribers; ``sent`` with the round, the count, and when the first
was due.
"""

import sys
import threading

import rospy
from std_msgs.msg import UInt8MultiArray

from node import Subscribers, say, serve_rounds, source_options
from rospy_ends import Counted


def main() -> None:
    """Run until ROS ends us."""
    args = source_options(__doc__).parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "source", anonymous=not args.name)
    publisher = rospy.Publisher(args.topic, UInt8MultiArray, Counted(Subscribers()), queue_size=args.queue)
    message = UInt8MultiArray()

    def publish(data: bytearray) -> None:
        message.data = data
        publisher.publish(message)

    say("up")
    # Not in the main thread: that one hears of the end, the other waits for commands.
    threading.Thread(
        target=serve_rounds, args=(publish, args.phase, lambda: not rospy.is_shutdown()), daemon=True
    ).start()
    rospy.spin()


if __name__ == "__main__":
    main()
