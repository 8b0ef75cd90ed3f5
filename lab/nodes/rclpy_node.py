"""The measuring nodes by rclpy, with ROS 2's Python: ``rclpy_node.py ROLE [TOPIC]...``.

* ``source TOPIC``, ``sink TOPIC``: as ``source.py`` and ``sink.py``, see ``node.serve_rounds`` and ``node.Notes``;
* ``relay FROM TO [FROM TO]...``: publishes on what it hears, as bytes: the least that a node of rclpy can do;
* ``crowd``: at each line ``NODES TOPICS PREFIX`` that many nodes, each with that many publishers; then ``made`` with
  the ns before the first of them;
* ``watch``: at each line ``TOPIC`` then ``there`` with the ns when its publisher and that one's node are known.

All are in the default executor, and their messages are std_msgs/msg/UInt8MultiArray, reliable, depth 100.
"""

import contextlib
import struct
import sys
import threading
import time
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import UInt8MultiArray

from node import Notes, Subscribers, commands, say, serve_rounds

DEPTH = 100
# CDR's head, no dimensions, no offset; then the length of the data.
LEAD = struct.Struct("<4sIII")
CDR = b"\0\1\0\0"


def source(node: Any, topic: str) -> None:
    """Publish rounds in a thread."""
    publisher = node.create_publisher(UInt8MultiArray, topic, DEPTH)
    subscribers = Subscribers()
    node.create_timer(0.05, lambda: subscribers.changed(publisher.get_subscription_count()))

    def publish(data: bytearray) -> None:
        publisher.publish(LEAD.pack(CDR, 0, 0, len(data)) + bytes(data))

    threading.Thread(target=serve_rounds, args=(publish, None, rclpy.ok), daemon=True).start()


def sink(node: Any, topic: str) -> None:
    """Note what comes."""
    notes = Notes([topic])
    node.create_subscription(
        UInt8MultiArray, topic, lambda data: notes.note(0, data, offset=LEAD.size), DEPTH, raw=True
    )
    threading.Thread(target=notes.serve, daemon=True).start()


def relay(node: Any, *topics: str) -> None:
    """Publish on what comes."""
    for come, go in zip(topics[::2], topics[1::2], strict=True):
        publisher = node.create_publisher(UInt8MultiArray, go, DEPTH)
        node.create_subscription(UInt8MultiArray, come, publisher.publish, DEPTH, raw=True)


def crowd() -> None:
    """Make many when asked to; this one's start is measured from before rclpy's."""
    kept = []
    for words in commands():
        begun = time.monotonic_ns()
        if not rclpy.ok():
            rclpy.init()
        for number in range(int(words[0])):
            node = rclpy.create_node(f"{words[2]}_{number}")
            kept.append(node)
            for topic in range(int(words[1])):
                node.create_publisher(UInt8MultiArray, f"/{words[2]}/t{number}_{topic}", DEPTH)
        say("made", ns=begun)


def watch(node: Any) -> None:
    """Say when topics are there."""
    for (topic,) in commands():
        while not any(each.node_name[0] != "_" for each in node.get_publishers_info_by_topic(topic)):
            time.sleep(0.005)
        say("there", topic=topic, ns=time.monotonic_ns())


def main() -> None:
    """Run until we are ended."""
    role, *topics = sys.argv[1:]
    roles: dict[str, Any] = {"source": source, "sink": sink, "relay": relay, "watch": watch}
    if role == "crowd":
        say("up")
        crowd()
        return
    rclpy.init()
    node = rclpy.create_node(f"{role}_{threading.get_native_id()}")
    say("up")
    roles[role](node, *topics)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
