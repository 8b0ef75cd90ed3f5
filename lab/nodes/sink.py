"""Note when each measured message comes (rospy); see ``node.Notes``.

Events: ``up``; ``noted`` with the round and the count; ``first`` with the topic when its first message came;
``again`` with the gap when the first after a pause did.
"""

import sys
import threading
from functools import partial
from typing import Any

import rospy

from node import Notes, say, sink_options
from rospy_ends import listen


def main() -> None:
    """Run until ROS ends us."""
    args = sink_options(__doc__).parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "sink", anonymous=not args.name)
    notes = Notes(args.topics)

    def take(topic: int, message: Any) -> None:
        notes.note(topic, message.data)

    for index, topic in enumerate(args.topics):
        listen(topic, partial(take, index), args.queue, nodelay=args.nodelay)
    threading.Thread(target=notes.serve, daemon=True).start()
    say("up")
    rospy.spin()


if __name__ == "__main__":
    main()
