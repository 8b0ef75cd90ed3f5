"""A ROS 2 node of rmw_zenoh by zenoh-ros2-sdk, an implementation that has nothing of ours.

Runs with RMPA's interpreter: ``ros2_end.py ROUTER``. Reads lines of JSON:

* ``{"do": "publish", "topic", "text", "count", "rate"}``: std_msgs/msg/String, each with its number behind the text;
* ``{"do": "subscribe", "topic", "latched"}``: then ``heard`` with ``data``;
* ``{"do": "serve", "service"}``: std_srvs/srv/SetBool; then ``asked`` with ``data``;
* ``{"do": "call", "service", "data"}``: likewise; then ``answered`` with ``success`` and ``message``, or ``error``;
* ``{"do": "list"}``: then ``graph`` with ``topics`` and ``services``, each a list of name and types.

Events beside: ``up``; ``done`` after each line.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import zenoh_ros2_sdk as ros2
from zenoh_ros2_sdk.qos import QosDurability, QosProfile

from node import say

STRING = {"msg_type": "std_msgs/msg/String", "msg_definition": "string data\n"}
SET_BOOL = {
    "srv_type": "std_srvs/srv/SetBool",
    "request_definition": "bool data",
    "response_definition": "bool success\nstring message",
}
# What was made, by kind and name: it lives until the process ends.
_kept: dict[str, Any] = {}


def _publish(told: dict[str, Any], router: dict[str, Any]) -> None:
    topic = told["topic"]
    publisher = _kept.get(f"publish {topic}")
    if publisher is None:
        qos = QosProfile(durability=QosDurability.TRANSIENT_LOCAL) if told.get("latched") else None
        publisher = ros2.ROS2Publisher(topic, node_name="talker2", qos=qos, **STRING, **router)
        _kept[f"publish {topic}"] = publisher
    for number in range(1, told.get("count", 1) + 1):
        publisher.publish(data=f"{told['text']} {number}")
        time.sleep(1 / told.get("rate", 1000))


def _subscribe(told: dict[str, Any], router: dict[str, Any]) -> None:
    topic = told["topic"]

    def take(message: Any) -> None:
        say("heard", topic=topic, data=message.data)

    qos = QosProfile(durability=QosDurability.TRANSIENT_LOCAL) if told.get("latched") else None
    _kept[f"subscribe {topic}"] = ros2.ROS2Subscriber(
        topic, callback=take, node_name="listener2", qos=qos, **STRING, **router
    )


def _serve(told: dict[str, Any], router: dict[str, Any]) -> None:
    def answer(request: Any) -> Any:
        say("asked", data=request.data)
        return server.response_msg_class(success=not request.data, message="from ROS 2")

    server = ros2.ROS2ServiceServer(told["service"], callback=answer, node_name="server2", **SET_BOOL, **router)
    _kept[f"serve {told['service']}"] = server


def _call(told: dict[str, Any], router: dict[str, Any]) -> None:
    client = ros2.ROS2ServiceClient(told["service"], node_name="client2", timeout=5.0, **SET_BOOL, **router)
    try:
        response = client.call(data=told["data"])
    except Exception as error:  # noqa: BLE001 - the library raises what it likes
        say("answered", error=str(error))
    else:
        if response is None:
            say("answered", error="no response")
        else:
            say("answered", success=response.success, message=response.message)
    client.close()


def _list(told: dict[str, Any], router: dict[str, Any]) -> None:
    topics = [[str(name), list(map(str, types))] for name, types in ros2.get_topic_names_and_types(**router)]
    services = [[str(name), list(map(str, types))] for name, types in ros2.get_service_names_and_types(**router)]
    say("graph", topics=topics, services=services)


DO = {"publish": _publish, "subscribe": _subscribe, "serve": _serve, "call": _call, "list": _list}


def main() -> None:
    router = {"router_ip": sys.argv[1]}
    ros2.ZenohSession.get_instance(**router)
    say("up")
    for line in sys.stdin:
        told = json.loads(line)
        DO[told["do"]](told, router)
        say("done", do=told["do"])
    ros2.ZenohSession.get_instance(**router).close()


if __name__ == "__main__":
    main()
