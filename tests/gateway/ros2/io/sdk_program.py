"""A program of ROS 2 made with zenoh-ros2-sdk, an implementation of rmw_zenoh's format that is not ours.

Lines of JSON in, lines of JSON out: ``{"do": "listen", "topic": …}``, ``talk``, ``list``, ``nodes``, ``end``.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_topic_info, get_topic_names_and_types
from zenoh_ros2_sdk.qos import QosDurability, QosProfile

DEFINITIONS = {"std_msgs/msg/String": "string data\n", "arm_msgs/msg/Grip": "float64 width\nstring[] fingers\n"}


def say(**fields: Any) -> None:
    sys.stdout.write(json.dumps(fields) + "\n")  # in one piece: print would write the end of the line by itself
    sys.stdout.flush()


def heard(topic: str, message: Any) -> None:
    say(heard=topic, message={key: value for key, value in vars(message).items() if not key.startswith("_")})


def main() -> None:
    port = int(sys.argv[1])
    ends: list[Any] = []
    publishers: dict[str, Any] = {}
    say(ready=True)
    for line in sys.stdin:
        order = json.loads(line)
        topic, kind = order.get("topic", ""), order.get("type", "std_msgs/msg/String")
        qos = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1) if order.get("latched") else None
        more: dict[str, Any] = {"msg_definition": DEFINITIONS[kind], "router_port": port, "domain_id": 0, "qos": qos}
        match order["do"]:
            case "listen":
                ends.append(ROS2Subscriber(topic, kind, lambda message, on=topic: heard(on, message), **more))
                say(listens=topic)
            case "talk":
                if topic not in publishers:
                    publishers[topic] = ROS2Publisher(topic, kind, node_name=order["node"], **more)
                for message in order["messages"]:
                    publishers[topic].publish(**message)
                say(talks=topic)
            case "list":
                say(topics=dict(get_topic_names_and_types(domain_id=0, router_port=port)))
            case "info":
                info = get_topic_info(topic, domain_id=0, router_port=port, verbose=True)
                say(info=repr(info))
            case "end":
                break
    for end in (*ends, *publishers.values()):
        end.close()


if __name__ == "__main__":
    main()
