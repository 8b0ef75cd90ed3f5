"""Send back, on ``--reply``, whatever comes on ``--topic`` (rospy). Event: ``up``."""

import sys

import rospy
from payload import parser, say
from std_msgs.msg import UInt8MultiArray


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--reply", default="/reply")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "echo", anonymous=not args.name)
    publisher = rospy.Publisher(args.reply, UInt8MultiArray, queue_size=100, tcp_nodelay=args.nodelay)
    rospy.Subscriber(
        args.topic, UInt8MultiArray, publisher.publish, tcp_nodelay=args.nodelay, queue_size=100, buff_size=1 << 21
    )
    say("up", node=rospy.get_name())
    rospy.spin()


if __name__ == "__main__":
    main()
