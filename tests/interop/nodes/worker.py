"""Serve ``rmpa_test/Work`` (rospy): do what each request says.

``op`` is ``echo`` (the data comes back), ``sleep`` (the same after ``seconds``), ``fail`` (an error with a text) or
``die`` (the process ends within the call). Events: ``up``; ``call`` with each request's ``op`` and ``size``.
"""

import os
import sys
import time
from typing import Any

import rospy
from payload import parser, say
from work import Work, of_another_release


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--service", default="/work")
    options.add_argument("--quiet", action="store_true", help="no event for each call")
    options.add_argument("--other-release", action="store_true", help="serve another version of the type")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "worker", anonymous=not args.name)

    def work(request: Any) -> Any:
        if not args.quiet:
            say("call", op=request.op, size=len(request.data))
        if request.op == "die":
            os._exit(1)
        if request.op == "fail":
            raise rospy.ServiceException("the gripper is jammed")
        if request.op == "sleep":
            time.sleep(request.seconds)
        return Work._response_class(text=request.op, data=request.data)

    kind = of_another_release() if args.other_release else Work
    service = rospy.Service(args.service, kind, work)
    say("up", node=rospy.get_name(), uri=service.uri)
    rospy.spin()


if __name__ == "__main__":
    main()
