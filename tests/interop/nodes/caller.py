"""Call ``rmpa_test/Work`` (rospy) as it is told.

Reads lines ``OP SECONDS SIZE COUNT HOW``, where HOW is ``once`` (a connection for each call), ``persistent``, or
``parallel`` (all at once, one thread each). Events: ``up``; ``there`` once the service answers (``--wait``); for
each line ``done`` with ``ok``, ``same`` (replies with the data that was sent), ``errors`` (their texts), ``took``.
"""

import os
import sys
import threading
import time

import rospy
from payload import Pattern, parser, say
from work import Work, of_another_release


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--service", default="/work")
    options.add_argument("--wait", action="store_true", help="wait until the service is there")
    options.add_argument("--other-release", action="store_true", help="call another version of the type")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "caller", anonymous=not args.name)
    kind = of_another_release() if args.other_release else Work
    say("up", node=rospy.get_name())
    if args.wait:
        rospy.wait_for_service(args.service)
        say("there")

    def obey() -> None:
        for line in sys.stdin:
            op, seconds, size, count, how = line.split()
            proxies = [rospy.ServiceProxy(args.service, kind, persistent=how == "persistent")]
            if how == "parallel":
                proxies = [rospy.ServiceProxy(args.service, kind) for _ in range(int(count))]
            result = Result()
            began = time.monotonic()
            if how == "parallel":
                threads = [
                    threading.Thread(target=result.call, args=(proxy, op, float(seconds), int(size), number))
                    for number, proxy in enumerate(proxies)
                ]
                for thread in threads:
                    thread.start()
                for thread in threads:
                    thread.join()
            else:
                for number in range(int(count)):
                    result.call(proxies[0], op, float(seconds), int(size), number)
            for proxy in proxies:
                proxy.close()
            say("done", ok=result.ok, same=result.same, errors=sorted(result.errors), took=time.monotonic() - began)

    threading.Thread(target=obey, daemon=True).start()
    rospy.spin()
    os._exit(0)  # the thread that reads would hold the interpreter's end up


class Result:
    """What came of the calls of one line."""

    def __init__(self) -> None:
        self.ok = 0
        self.same = 0
        self.errors: set[str] = set()
        self._lock = threading.Lock()

    def call(self, proxy: rospy.ServiceProxy, op: str, seconds: float, size: int, number: int) -> None:
        """One call."""
        data = Pattern(size).payload(1, number)
        try:
            response = proxy(op, seconds, data)
        except (rospy.ServiceException, rospy.ROSException) as error:
            with self._lock:
                self.errors.add(str(error))
            return
        with self._lock:
            self.ok += 1
            self.same += bytes(response.data) == data and response.text == op


if __name__ == "__main__":
    main()
