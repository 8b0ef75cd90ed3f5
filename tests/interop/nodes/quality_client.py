"""Ask a Smart Resource for a quality with plain topics (rospy), observe what arrives, and say what it answers.

Reads lines of JSON: ``{"rate": ">= 15 Hz hard"}`` asks, ``{}`` releases. Events: ``up``; ``response`` (own:
whether it is ours), ``alarm`` and ``diagnostics`` with ``level``, ``name``, ``message``, ``values``; ``profile``.
"""

import json
import os
import sys
import threading

import rospy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from payload import parser, say
from std_msgs.msg import String


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--resource", default="/camera")
    options.add_argument("--observe", help="a std_msgs/String topic whose rate to report")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "client", anonymous=not args.name)
    asking = rospy.Publisher(f"{args.resource}/requirements", DiagnosticArray, queue_size=1, latch=True)
    observing = rospy.Publisher(f"{args.resource}/observed", DiagnosticArray, queue_size=1)
    count = [0]

    def array(values: dict[str, str]) -> DiagnosticArray:
        message = DiagnosticArray()
        message.header.stamp = rospy.Time.now()
        message.status = [DiagnosticStatus(values=[KeyValue(k, v) for k, v in values.items()])]
        return message

    def heard(kind: str, message: DiagnosticArray) -> None:
        if kind == "response":
            say("clients", names=[status.name for status in message.status])
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            level = status.level if isinstance(status.level, int) else ord(status.level)
            own = status.name == rospy.get_name() or status.name.endswith(rospy.get_name())
            say(kind, level=level, name=status.name, message=status.message, values=values, own=own)

    def subscribe(topic: str, kind: str) -> None:
        rospy.Subscriber(topic, DiagnosticArray, lambda message: heard(kind, message))

    subscribe(f"{args.resource}/responses", "response")
    subscribe(f"{args.resource}/alarms", "alarm")
    subscribe("/diagnostics", "diagnostics")
    rospy.Subscriber(f"{args.resource}/profile", String, lambda message: say("profile", name=message.data))

    def obey() -> None:
        for line in sys.stdin:
            asking.publish(array(json.loads(line)))

    def came(_message: String) -> None:
        count[0] += 1

    def report(_event: object) -> None:
        rate, count[0] = count[0] / 0.5, 0
        observing.publish(array({"rate": f"{rate} Hz"}))

    if args.observe:
        rospy.Subscriber(args.observe, String, came, tcp_nodelay=True)
        rospy.Timer(rospy.Duration(0.5), report)
    say("up", node=rospy.get_name())
    threading.Thread(target=obey, daemon=True).start()
    rospy.spin()
    os._exit(0)  # the thread that reads would hold the interpreter's end up


if __name__ == "__main__":
    main()
