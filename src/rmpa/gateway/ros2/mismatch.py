"""Two endpoints of one name that do not hear each other, as their keys differ: ROS 2 itself says nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway.ros2.tokens import NO_HASH, EntityKind

if TYPE_CHECKING:
    from rmpa.gateway.ros2.tokens import Ros2Endpoint


def mismatch(own: Ros2Endpoint, other: Ros2Endpoint, distribution: str) -> str:
    """Why a ROS 2 endpoint does not hear a publisher of ours of the same name; empty if it does.

    Args:
        own: Our publisher.
        other: The ROS 2 node's publisher or subscription.
        distribution: ``gateway.ros2.distribution``.
    """
    does = "subscribes to" if other.kind is EntityKind.SUBSCRIPTION else "publishes"
    if other.type != own.type:
        return (
            f"the node {does} {other.type}; {own.node.name} publishes {own.type}: messages cannot pass between them. "
            "Rename one of the topics, or map the ROS 1 type to the other one (gateway.ros2.mapping)"
        )
    if other.type_hash == own.type_hash:
        return ""
    head = f"the node {does} {other.type} with the type hash {other.type_hash}, {own.node.name} has {own.type_hash}"
    if NO_HASH in (other.type_hash, own.type_hash):
        older = "it" if other.type_hash == NO_HASH else "the gateway"
        return (
            f"{head}: {older} speaks as ROS 2 Humble or older. Messages cannot pass; gateway.ros2.distribution is "
            f"{distribution!r}"
        )
    return (
        f"{head}: their definitions differ, so messages cannot pass. Use the same definition on both sides; for "
        f"types of ROS 2 itself set gateway.ros2.distribution, which is {distribution!r}"
    )
