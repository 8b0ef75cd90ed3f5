"""Receive what a talker sends, check it and count it (rospy).

Events: ``up``; ``first`` with the first message; ``report`` five times a second while something arrives; ``done``
with the report at ``--count`` messages. Stays until it is ended.
"""

import sys
import threading
import time

import rospy
from payload import Tally, parser, say
from std_msgs.msg import String, UInt8MultiArray


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--count", type=int, default=0, help="messages after which to say done")
    options.add_argument("--each", action="store_true", help="a report with every message")
    options.add_argument("--type", choices=["UInt8MultiArray", "String"], default="UInt8MultiArray")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "listener", anonymous=not args.name)
    tally = Tally()
    lock = threading.Lock()

    def take(message: UInt8MultiArray) -> None:
        with lock:
            tally.take(message.data)
            count = tally.count
            if count == 1:
                say("first", stamp_ns=time.time_ns(), **tally.report())
            if args.each:
                say("report", **tally.report())
            if count == args.count:
                say("done", **tally.report())

    def take_text(message: String) -> None:
        tally.count += 1
        say("text", data=message.data, count=tally.count)

    if args.type == "String":
        rospy.Subscriber(args.topic, String, take_text, tcp_nodelay=args.nodelay)
    else:
        rospy.Subscriber(args.topic, UInt8MultiArray, take, tcp_nodelay=args.nodelay, buff_size=1 << 21)
    say("up", node=rospy.get_name())
    reported = 0
    while not rospy.is_shutdown():
        rospy.rostime.wallsleep(0.2)
        with lock:
            if args.type != "String" and tally.count != reported:
                reported = tally.count
                say("report", **tally.report())


if __name__ == "__main__":
    main()
