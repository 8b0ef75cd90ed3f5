"""Log and publish the texts that it is told (rospy).

Reads lines of JSON: ``{"log": TEXT}`` is logged as a warning, ``{"data": TEXT}`` is published as std_msgs/String.
Event: ``up`` with the ``uri`` of its slave API.
"""

import json
import os
import sys
import threading

import rospy
from payload import parser, say
from std_msgs.msg import String


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--latch", action="store_true")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "text_teller", anonymous=not args.name)
    publisher = rospy.Publisher(args.topic, String, queue_size=10, latch=args.latch)

    def obey() -> None:
        for line in sys.stdin:
            told = json.loads(line)
            if "log" in told:
                rospy.logwarn("%s", told["log"])
            if "data" in told:
                publisher.publish(String(told["data"]))

    threading.Thread(target=obey, daemon=True).start()
    say("up", node=rospy.get_name(), uri=rospy.get_node_uri())
    rospy.spin()
    os._exit(0)  # the thread that reads would hold the interpreter's end up


if __name__ == "__main__":
    main()
