"""The neighbour zenoh-bridge-ros1: robots of ROS 1 that Zenoh's own bridge joins."""

from rmpa.gateway.ros1_bridge.keys import (
    ANY_NAMESPACE,
    DISCOVERY,
    PRESENCE_PERIOD,
    BridgedKind,
    BridgedTopic,
    parse_key,
    parse_presence,
)

__all__ = [
    "ANY_NAMESPACE",
    "DISCOVERY",
    "PRESENCE_PERIOD",
    "BridgedKind",
    "BridgedTopic",
    "parse_key",
    "parse_presence",
]
