"""Round trips from --topic to --reply (rospy); lines, files and events as of ``ping.cpp``."""

import array
import struct
import sys
import threading
import time
from pathlib import Path

import rospy
from std_msgs.msg import UInt8MultiArray

from node import parser, say


class Ping:
    def __init__(self, topic: str, reply: str, *, nodelay: bool) -> None:
        self._returned = 0
        self._sequence = 0
        self._came = threading.Event()
        self._publisher = rospy.Publisher(topic, UInt8MultiArray, queue_size=None, tcp_nodelay=nodelay)
        rospy.Subscriber(reply, UInt8MultiArray, self._take, tcp_nodelay=nodelay, buff_size=1 << 21)
        self._message = UInt8MultiArray()

    def size(self, size: int) -> None:
        self._rest = bytes(size - 8)

    def trip(self, timeout: float) -> bool:
        self._sequence += 1
        self._came.clear()
        self._message.data = struct.pack("<Q", self._sequence) + self._rest
        self._publisher.publish(self._message)
        return self._came.wait(timeout)

    def _take(self, message: UInt8MultiArray) -> None:
        if struct.unpack_from("<Q", message.data)[0] == self._sequence:
            self._came.set()


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--topic", default="/ping")
    options.add_argument("--reply", default="/pong")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "ping", anonymous=not args.name)
    ping = Ping(args.topic, args.reply, nodelay=args.nodelay)
    say("up")
    ping.size(64)
    while not ping.trip(0.1):
        pass
    say("ready")
    for line in sys.stdin:
        size, count, path = line.split()
        ping.size(int(size))
        samples = array.array("Q")
        for _ in range(int(count)):
            start = time.perf_counter_ns()
            if ping.trip(1.0):
                samples.append(time.perf_counter_ns() - start)
        Path(path).write_bytes(samples.tobytes())
        say("round", lost=int(count) - len(samples))


if __name__ == "__main__":
    main()
