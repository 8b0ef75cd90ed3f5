"""A driver whose statuses are published as diagnostic_updater does (rospy): ``NODE: task``, once a second.

Reads lines of JSON, ``{"level": 2, "message": "too hot"}``: what the battery says from then on. Event: ``up``.
"""

import json
import sys
import threading

import rospy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from payload import parser, say


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--hardware", default="SN 4711")
    args = options.parse_args(rospy.myargv(sys.argv)[1:])
    rospy.init_node(args.name or "driver", anonymous=not args.name)
    publisher = rospy.Publisher("/diagnostics", DiagnosticArray, queue_size=1)
    battery = {"level": DiagnosticStatus.OK, "message": "fine"}

    def read() -> None:
        for line in sys.stdin:
            battery.update(json.loads(line))

    threading.Thread(target=read, daemon=True).start()
    say("up", node=rospy.get_name())
    name = rospy.get_name().lstrip("/")
    rate = rospy.Rate(1)
    while not rospy.is_shutdown():
        message = DiagnosticArray()
        message.header.stamp = rospy.Time.now()
        values = [KeyValue("Voltage", "24.1 V"), KeyValue("Current", "nan")]
        message.status = [
            DiagnosticStatus(DiagnosticStatus.OK, f"{name}: Frequency Status", "met", args.hardware, []),
            DiagnosticStatus(battery["level"], f"{name}: Battery", battery["message"], args.hardware, values),
        ]
        publisher.publish(message)
        rate.sleep()


if __name__ == "__main__":
    main()
