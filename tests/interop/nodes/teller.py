"""Publish what it is told to (rospy).

Reads ``SIZE[,SIZE...] COUNT RATE`` lines: COUNT numbered, checksummed payloads, of these sizes in turn, at RATE Hz
(0: as fast as it can). With ``--save`` the data of each message is written to ``FOLDER/SOURCE-SEQUENCE`` first.
Events: ``up``; ``connected`` once ``--wait`` subscribers are there; ``told`` with the number sent in all.
"""

import sys
import threading
import time
from pathlib import Path

import rospy
from payload import Pattern, parser, say
from std_msgs.msg import UInt8MultiArray


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--source", type=int, default=1, help="this sender's number")
    options.add_argument("--latch", action="store_true")
    options.add_argument("--wait", type=int, default=0, help="subscribers to wait for before the first message")
    options.add_argument("--queue", type=int, default=10000)
    options.add_argument("--save", type=Path, help="a folder for the data of each message")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "teller", anonymous=not args.name)
    publisher = rospy.Publisher(
        args.topic, UInt8MultiArray, queue_size=args.queue, latch=args.latch, tcp_nodelay=args.nodelay
    )
    say("up", node=rospy.get_name())
    while publisher.get_num_connections() < args.wait and not rospy.is_shutdown():
        time.sleep(0.01)
    say("connected")

    def obey() -> None:
        patterns: dict[int, Pattern] = {}
        sequence = 0
        for line in sys.stdin:
            words, count, rate = line.split()
            sizes = [int(word) for word in words.split(",")]
            due = time.monotonic()
            for number in range(int(count)):
                sequence += 1
                size = sizes[number % len(sizes)]
                if size not in patterns:
                    patterns[size] = Pattern(size)
                data = patterns[size].payload(args.source, sequence)
                if args.save:
                    (args.save / f"{args.source}-{sequence}").write_bytes(data)
                publisher.publish(UInt8MultiArray(data=data))
                if float(rate):
                    due += 1 / float(rate)
                    time.sleep(max(0.0, due - time.monotonic()))
            say("told", sent=sequence)

    threading.Thread(target=obey, daemon=True).start()  # a read of standard input would outlast SIGTERM
    rospy.spin()


if __name__ == "__main__":
    main()
