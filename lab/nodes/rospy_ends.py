"""Shared by the rospy nodes: counting subscribers, and subscribing."""

from collections.abc import Callable
from typing import Any

import rospy
from std_msgs.msg import UInt8MultiArray

from node import Subscribers

# Bytes: rospy's own 64 KiB make it slow with large messages.
_READ_AT_ONCE = 1 << 21


class Counted(rospy.SubscribeListener):  # type: ignore[misc]  # rospy has no types
    """Tells how many subscribers a topic has.

    Args:
        subscribers: Is notified of each change.
    """

    def __init__(self, subscribers: Subscribers) -> None:
        super().__init__()
        self._subscribers = subscribers
        self._count = 0

    def peer_subscribe(self, topic_name: str, topic_publish: object, peer_publish: object) -> None:  # noqa: ARG002
        """One more."""
        self._count += 1
        self._subscribers.changed(self._count)

    def peer_unsubscribe(self, topic_name: str, num_peers: int) -> None:  # noqa: ARG002 - rospy's words
        """One less."""
        self._count = num_peers
        self._subscribers.changed(self._count)


def listen(topic: str, take: Callable[[Any], None], queue: int, *, nodelay: bool) -> None:
    """Subscribe with the best settings that rospy has."""
    rospy.Subscriber(topic, UInt8MultiArray, take, queue_size=queue, buff_size=_READ_AT_ONCE, tcp_nodelay=nodelay)
