"""Publish numbered payloads of source 1, and one of source 2 to each new subscriber alone (rospy).

Events: ``up``; ``greeted`` with the count of new subscribers. ``--greeting`` is the size of what those get.
"""

from __future__ import annotations

import sys
import threading
from typing import TYPE_CHECKING

import rospy
from payload import Pattern, parser, say
from std_msgs.msg import UInt8MultiArray

if TYPE_CHECKING:
    from collections.abc import Callable

# rospy writes each message into one buffer of its topic, whichever thread publishes it.
_LOCK = threading.Lock()


class Greeter(rospy.SubscribeListener):  # type: ignore[misc] # rospy is untyped
    """Greets each new subscriber."""

    def __init__(self, size: int) -> None:
        self._pattern = Pattern(size)
        self._count = 0

    def peer_subscribe(self, _topic: str, _publish: object, peer_publish: Callable[[UInt8MultiArray], None]) -> None:
        with _LOCK:
            self._count += 1
            peer_publish(UInt8MultiArray(data=self._pattern.payload(2, self._count)))
        say("greeted", count=self._count)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--size", type=int, default=64)
    options.add_argument("--greeting", type=int, default=1000)
    options.add_argument("--rate", type=float, default=20)
    options.add_argument("--latch", action="store_true")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "greeter", anonymous=not args.name)
    publisher = rospy.Publisher(
        args.topic, UInt8MultiArray, Greeter(args.greeting), queue_size=1000, latch=args.latch
    )
    say("up", node=rospy.get_name())
    pattern = Pattern(args.size)
    sequence = 0
    rate = rospy.Rate(args.rate)
    while not rospy.is_shutdown():
        sequence += 1
        with _LOCK:
            publisher.publish(UInt8MultiArray(data=pattern.payload(1, sequence)))
        rate.sleep()


if __name__ == "__main__":
    main()
