"""A ROS 2 node of rclpy. Runs with ROS 2's Python: ``rclpy_end.py NAME [ACTION]``. Reads lines of JSON.

* ``{"do": "publish", "topic", "text", "count", "rate", "latched"}``: std_msgs/msg/String, each with its number;
* ``{"do": "subscribe", "topic", "latched"}``: then ``heard`` with ``data``; ``follow``: at a high rate;
* ``{"do": "serve", "service", "delay"}``: std_srvs/srv/SetBool; then ``asked`` with ``data``;
* ``{"do": "call", "service", "data"}``: likewise; then ``answered`` with ``success`` and ``message``, or ``error``;
* ``{"do": "unpublish", "topic"}``, ``{"do": "unserve", "service"}``: take it back;
* ``{"do": "list"}``: then ``graph`` with ``topics`` and ``services``, each a list of name and types, and ``nodes``;
* ``{"do": "action_serve"}``: rclpy's action server of test_msgs/action/Fibonacci, which rejects orders below 0;
* ``{"do": "send", "goal"}``: by rclpy's action client; then ``accepted`` with ``ok``, ``feedback`` with ``value``,
  ``ended`` with ``status`` and ``result``;
* ``{"do": "cancel"}``: the goal that was sent last; then ``cancelling`` with ``code``;
* ``{"do": "sensor", "topic"}``: publish std_msgs/msg/String with best effort, 20 a second;
* ``{"do": "strict", "topic"}``: subscribe reliably and transient local;
* ``{"do": "tell", "topic", "kind", "fields", "rate", "size"}``: publish any type, once or for good;
  ``size``: so many bytes in ``data``. ``{"do": "untell", "topic"}`` ends it;
* ``{"do": "hear", "topic", "kind", "qos", "delay"}``: subscribe to any type; then ``heard`` with ``data``, the
  message as text, its ``size``, and ``number``. ``{"do": "unhear", "topic"}`` ends it;
* ``{"do": "declare", "name", "value"}``: a parameter; ``{"do": "value", "name"}``: then ``value`` with ``value``;
* ``{"do": "log", "text"}``: to /rosout, for good;
* ``{"do": "now"}``: then ``now`` with ``seconds``, by the node's clock.

Events beside: ``up``; ``goal`` and ``cancel`` of the server; ``done`` after each line.
"""

import contextlib
import importlib
import itertools
import json
import sys
import threading
import time
from array import array
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

from node import say

STEP = 0.05
InvalidHandle = rclpy_implementation.InvalidHandle
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# A subscription of depth 1 loses what one publisher keeps to what another one does (as tf2_ros, which has 100).
LATE = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def load(name: str) -> Any:
    package, kind, base = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), base)


def filled(message: Any, fields: dict[str, Any]) -> Any:
    for name, value in fields.items():
        if isinstance(value, dict):
            filled(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


class End:
    """The node, and what was made of it."""

    def __init__(self, name: str, action: str) -> None:
        self.node = rclpy.create_node(name)
        self.action = action
        self.kept: dict[str, Any] = {}
        self.group = ReentrantCallbackGroup()
        self.goal: Any = None
        self.client: Any = None

    def publish(self, topic: str, text: str, count: int = 1, rate: float = 1000, latched: bool = False) -> None:
        publisher = self.kept.get("publish " + topic)
        if publisher is None:
            publisher = self.kept["publish " + topic] = self.node.create_publisher(
                String, topic, LATCHED if latched else QoSProfile(depth=1000)
            )
        for number in range(1, count + 1):
            publisher.publish(String(data=f"{text} {number}"))
            time.sleep(1 / rate)

    def unpublish(self, topic: str) -> None:
        self.node.destroy_publisher(self.kept.pop("publish " + topic))

    def subscribe(self, topic: str, latched: bool = False) -> None:
        def take(message: Any) -> None:
            say("heard", topic=topic, data=message.data)

        qos = LATE if latched else QoSProfile(depth=1000)
        self.kept["subscribe " + topic] = self.node.create_subscription(String, topic, take, qos)

    def follow(self, topic: str) -> None:
        """As ``subscribe``, by an executor of one thread: that of four takes 330 messages a second at the most."""
        node = rclpy.create_node("fast_" + self.node.get_name())

        def take(message: Any) -> None:
            say("heard", topic=topic, data=message.data)

        self.kept["follow " + topic] = node, node.create_subscription(String, topic, take, QoSProfile(depth=1000))
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        threading.Thread(target=executor.spin, daemon=True).start()

    def sensor(self, topic: str) -> None:
        qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        publisher = self.node.create_publisher(String, topic, qos)
        self.kept["sensor " + topic] = self.node.create_timer(0.05, lambda: publisher.publish(String(data="seen")))

    def strict(self, topic: str) -> None:
        self.subscribe(topic, latched=True)

    def tell(self, topic: str, kind: str, fields: Any, rate: float = 0, size: int = 0) -> None:
        message = filled(load(kind)(), fields)
        if size:
            message.data = array("B", b"x" * size)
        publisher = self.node.create_publisher(load(kind), topic, QoSProfile(depth=10))
        self.kept["tell " + topic] = publisher
        if rate:
            timer = self.node.create_timer(1 / rate, lambda: publisher.publish(message), clock=Clock())
            self.kept["timer " + topic] = timer
        else:
            publisher.publish(message)

    def untell(self, topic: str) -> None:
        timer = self.kept.pop("timer " + topic, None)
        if timer is not None:
            self.node.destroy_timer(timer)
        self.node.destroy_publisher(self.kept.pop("tell " + topic))

    def hear(self, topic: str, kind: str, qos: str = "", delay: float = 0.0) -> None:
        count = itertools.count(1)

        def take(message: Any) -> None:
            data = getattr(message, "data", ())
            data = data if hasattr(data, "__len__") else ()
            text = str(message) if len(data) < 1000 else ""
            say("heard", topic=topic, data=text, size=len(data), number=next(count))
            time.sleep(delay)

        best = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        terms = best if qos == "best" else QoSProfile(depth=10)
        self.kept["hear " + topic] = self.node.create_subscription(load(kind), topic, take, terms)

    def unhear(self, topic: str) -> None:
        self.node.destroy_subscription(self.kept.pop("hear " + topic))

    def declare(self, name: str, value: Any) -> None:
        self.node.declare_parameter(name, value)

    def value(self, name: str) -> None:
        value = self.node.get_parameter(name).value
        say("value", value=value.tolist() if isinstance(value, array) else value)

    def log(self, text: str) -> None:
        logger = self.node.get_logger()
        self.kept["log"] = self.node.create_timer(0.2, lambda: logger.info(text), clock=Clock())

    def now(self) -> None:
        say("now", seconds=self.node.get_clock().now().nanoseconds / 1e9)

    def serve(self, service: str, delay: float = 0.0) -> None:
        def answer(request: Any, response: Any) -> Any:
            say("asked", data=request.data)
            time.sleep(delay)
            response.success, response.message = not request.data, "from ROS 2"
            return response

        self.kept["serve " + service] = self.node.create_service(SetBool, service, answer, callback_group=self.group)

    def unserve(self, service: str) -> None:
        self.node.destroy_service(self.kept.pop("serve " + service))

    def call(self, service: str, data: bool, within: float = 5.0) -> None:
        client = self.node.create_client(SetBool, service)
        try:
            if not client.wait_for_service(within):
                say("answered", error="no server")
                return
            future = client.call_async(SetBool.Request(data=data))
            over = time.monotonic() + within
            while not future.done() and time.monotonic() < over:
                time.sleep(0.01)
            if future.done():
                say("answered", success=future.result().success, message=future.result().message)
            else:
                say("answered", error="no response")
        finally:
            self.node.destroy_client(client)

    def list(self) -> None:
        say(
            "graph",
            topics=[[name, types] for name, types in self.node.get_topic_names_and_types()],
            services=[[name, types] for name, types in self.node.get_service_names_and_types()],
            nodes=[space.rstrip("/") + "/" + name for name, space in self.node.get_node_names_and_namespaces()],
        )

    def action_serve(self) -> None:
        def accept(request: Any) -> Any:
            say("goal", goal=request.order)
            return GoalResponse.ACCEPT if request.order >= 0 else GoalResponse.REJECT

        def cancel(_goal: Any) -> Any:
            say("cancel")
            return CancelResponse.ACCEPT

        def execute(goal: Any) -> Any:
            sequence: list[int] = []
            while len(sequence) < goal.request.order:
                if goal.is_cancel_requested:
                    goal.canceled()
                    return Fibonacci.Result(sequence=sequence)
                sequence.append(len(sequence))
                goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
                time.sleep(STEP)
            goal.succeed()
            return Fibonacci.Result(sequence=sequence)

        self.kept["action"] = ActionServer(
            self.node,
            Fibonacci,
            self.action,
            execute,
            goal_callback=accept,
            cancel_callback=cancel,
            callback_group=self.group,
        )

    def send(self, goal: int) -> None:
        if self.client is None:
            self.client = ActionClient(self.node, Fibonacci, self.action)
        if not self.client.wait_for_server(5.0):
            say("accepted", ok=False)
            return

        def feedback(message: Any) -> None:
            say("feedback", value=len(message.feedback.sequence))

        def accepted(future: Any) -> None:
            self.goal = future.result()
            say("accepted", ok=self.goal.accepted)
            if self.goal.accepted:
                self.goal.get_result_async().add_done_callback(ended)

        def ended(future: Any) -> None:
            answer = future.result()
            say("ended", status=answer.status, result=len(answer.result.sequence))

        self.client.send_goal_async(Fibonacci.Goal(order=goal), feedback).add_done_callback(accepted)

    def cancel(self) -> None:
        self.goal.cancel_goal_async().add_done_callback(lambda f: say("cancelling", code=f.result().return_code))


def main() -> None:
    rclpy.init(args=sys.argv)
    words = remove_ros_args(sys.argv)
    end = End(words[1], words[2] if len(words) > 2 else "/count")
    executor = MultiThreadedExecutor(4)
    executor.add_node(end.node)

    def spin() -> None:
        while rclpy.ok():
            with contextlib.suppress(InvalidHandle):  # of what the other thread destroyed in this moment
                executor.spin()

    threading.Thread(target=spin, daemon=True).start()
    say("up")
    for line in sys.stdin:
        told = json.loads(line)
        do = told.pop("do")
        getattr(end, do)(**told)
        say("done", do=do)


if __name__ == "__main__":
    main()
