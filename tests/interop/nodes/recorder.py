"""Note each message of a talker or teller and when it came (rospy).

Reads paths: the file gets what came since the last one, for each message source, sequence, when it was sent and when
it came (ns of the wall clock), size, and whether its bytes are wrong, as ``recordings.ROW`` has it. With ``--save``
the data of each message is written to ``FOLDER/SOURCE-SEQUENCE``.
Events: ``up``; ``report`` ten times a second while something arrives, as a listener's; ``noted`` with the count.
"""

import struct
import sys
import threading
import time
import zlib
from pathlib import Path

import rospy
from payload import HEADER, Tally, parser, say
from std_msgs.msg import UInt8MultiArray

ROW = struct.Struct("<IIQQII")


def row(data: bytes, came: int) -> bytes:
    """What is noted of one message."""
    if len(data) < HEADER.size:
        return ROW.pack(0, 0, 0, came, len(data), 1)
    source, sequence, sent, crc = HEADER.unpack_from(data)
    bad = zlib.crc32(memoryview(data)[HEADER.size :]) != crc
    return ROW.pack(source, sequence, sent, came, len(data), bad)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--save", type=Path, help="a folder for the data of each message")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "recorder", anonymous=not args.name)
    tally = Tally()
    rows: list[bytes] = []
    lock = threading.Lock()

    def take(message: UInt8MultiArray) -> None:
        noted = row(message.data, time.time_ns())
        if args.save:
            source, sequence = ROW.unpack(noted)[:2]
            part = args.save / f"{source}-{sequence}.part"
            part.write_bytes(message.data)
            part.rename(part.with_suffix(""))
        with lock:
            tally.take(message.data)
            rows.append(noted)

    def report() -> None:
        reported = 0
        while not rospy.is_shutdown():
            rospy.rostime.wallsleep(0.1)
            with lock:
                if tally.count != reported:
                    reported = tally.count
                    say("report", **tally.report())

    def obey() -> None:
        for line in sys.stdin:
            with lock:
                Path(line.strip()).write_bytes(b"".join(rows))
                say("noted", count=len(rows))
                rows.clear()

    rospy.Subscriber(args.topic, UInt8MultiArray, take, tcp_nodelay=args.nodelay, buff_size=1 << 21)
    for task in (report, obey):  # a read of standard input would outlast SIGTERM
        threading.Thread(target=task, daemon=True).start()
    say("up", node=rospy.get_name())
    rospy.spin()


if __name__ == "__main__":
    main()
