"""Publish numbered, checksummed payloads at a steady rate (rospy).

Events: ``up``; ``connected`` with the first subscriber; ``done`` with ``sent``. Stays until it is ended.
"""

import sys
import time

import rospy
from payload import Pattern, of_another_release, parser, say
from std_msgs.msg import String, UInt8MultiArray


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--rate", type=float, default=10.0, help="messages a second; 0: as fast as possible")
    options.add_argument("--size", type=int, default=64, help="bytes of payload")
    options.add_argument("--count", type=int, default=0, help="messages; 0: without end")
    options.add_argument("--source", type=int, default=1, help="this sender's number")
    options.add_argument("--latch", action="store_true")
    options.add_argument("--wait", type=int, default=0, help="subscribers to wait for before the first message")
    options.add_argument("--queue", type=int, default=10000, help="below 0: none, so that publish() writes itself")
    options.add_argument("--type", choices=["UInt8MultiArray", "String"], default="UInt8MultiArray")
    options.add_argument("--another-md5", action="store_true", help="the same name, not the same fields")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "talker", anonymous=not args.name, disable_signals=False)
    kind = String if args.type == "String" else UInt8MultiArray
    kind = of_another_release(kind) if args.another_md5 else kind
    queue = args.queue if args.queue >= 0 else None
    publisher = rospy.Publisher(args.topic, kind, queue_size=queue, latch=args.latch, tcp_nodelay=args.nodelay)
    say("up", node=rospy.get_name())
    while publisher.get_num_connections() < args.wait and not rospy.is_shutdown():
        time.sleep(0.01)
    say("connected", subscribers=publisher.get_num_connections())
    pattern = Pattern(args.size)
    message = kind()
    sequence = 0
    due = time.monotonic()
    while not rospy.is_shutdown() and (not args.count or sequence < args.count):
        sequence += 1
        if kind is String:
            message.data = f"message {sequence}"
        else:
            message.data = pattern.payload(args.source, sequence)
        try:
            publisher.publish(message)
        except rospy.ROSException:
            break
        if args.rate:
            due += 1 / args.rate
            time.sleep(max(0.0, due - time.monotonic()))
    say("done", sent=sequence)
    rospy.spin()


if __name__ == "__main__":
    main()
