"""Serve ``std_srvs/SetBool`` at ``--service`` (rospy): answer each call, or fail with the text of ``--fail``.

Events: ``up``; ``call`` with ``data`` for each.
"""

import sys

import rospy
from payload import parser, say
from std_srvs.srv import SetBool, SetBoolRequest, SetBoolResponse


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--service", default="/switch")
    options.add_argument("--fail", default="", help="the text of an error for each call")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "switch", anonymous=not args.name)

    def switch(request: SetBoolRequest) -> SetBoolResponse:
        say("call", data=request.data)
        if args.fail:
            raise rospy.ServiceException(args.fail)
        return SetBoolResponse(success=True, message="on" if request.data else "off")

    service = rospy.Service(args.service, SetBool, switch)
    say("up", node=rospy.get_name(), uri=service.uri)
    rospy.spin()


if __name__ == "__main__":
    main()
