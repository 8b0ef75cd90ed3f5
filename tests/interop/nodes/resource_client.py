"""A client of a Smart Resource by ``rmpa_ros``: asks, counts what arrives, and says what it hears (rospy).

Reads lines of JSON, which it asks: ``{"rate": ">= 10 Hz hard"}``. Events: ``up``, ``response``, ``alarm``,
``profile``. ``--say ATTRIBUTE`` and ``--value``: also says that attribute twice a second, as a node of the resource.
"""

import json
import os
import sys
import threading
from pathlib import Path

import rospy
from payload import parser, say
from std_msgs.msg import Header

sys.path.insert(0, str(Path(__file__).parents[3] / "packaging/ros/rmpa_ros/src"))

import rmpa_ros


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--resource", default="camera")
    options.add_argument("--frames", default="/camera/frames")
    options.add_argument("--say")
    options.add_argument("--value", type=float, default=0.0)
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "client", anonymous=not args.name)
    camera = rmpa_ros.Resource(args.resource)

    def tell(kind: str, status: rmpa_ros.Status) -> None:
        say(kind, level=status.level, message=status.message, values=dict(status.values))

    camera.on_response(lambda answer: tell("response", answer))
    camera.on_alarm(lambda alarm: tell("alarm", alarm))
    camera.on_profile(lambda name: say("profile", name=name))
    rospy.Subscriber(args.frames, rospy.AnyMsg, lambda _: camera.arrived(Header()))
    if args.say:
        rospy.Timer(rospy.Duration(0.5), lambda _: camera.say(**{args.say: args.value}))

    def obey() -> None:
        for line in sys.stdin:
            camera.ask(**json.loads(line))

    say("up", node=rospy.get_name())
    threading.Thread(target=obey, daemon=True).start()
    rospy.spin()
    os._exit(0)  # the thread that reads would hold the interpreter's end up


if __name__ == "__main__":
    main()
