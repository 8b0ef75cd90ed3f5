"""Say when nodes come into the graph and go out of it (rospy).

Asks the master each ``--period`` seconds. Events: ``up``; ``there`` and ``gone`` at each change, with ``node`` and
``ns`` of the steady clock; ``there`` also for the nodes that are there at first.
"""

import sys
import time

import rospy
from payload import parser, say


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--period", type=float, default=0.02)
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "watcher", anonymous=not args.name)
    master = rospy.get_master()
    known: set[str] = set()
    say("up")
    while not rospy.is_shutdown():
        now = {node for part in master.getSystemState()[2] for _, nodes in part for node in nodes}
        ns = time.monotonic_ns()
        for node in sorted(now - known):
            say("there", node=node, ns=ns)
        for node in sorted(known - now):
            say("gone", node=node, ns=ns)
        known = now
        time.sleep(args.period)


if __name__ == "__main__":
    main()
