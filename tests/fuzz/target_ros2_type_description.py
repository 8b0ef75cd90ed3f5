"""Fuzz target: what a ROS 2 node says of its types, up to the conversion that is made of it."""

from __future__ import annotations

from rosbags.typesys.base import TypesysError

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.mapping import TypeMapping
from rmpa.gateway.ros2.pairs import Ros2Pairs
from rmpa.gateway.ros2.type_description import parse_type_response
from rmpa.gateway.ros2.types import Ros2Types
from rmpa.ros.types.messages import MessageType
from tests.gateway.ros2.type_descriptions import respond, response

_JAZZY = Ros2Types("jazzy")
_WHEELS = "base_msgs/msg/Wheels"
_NESTED = {_WHEELS: [("x", 49, 3, 0, "a/msg/B"), ("y", 22, 0, 5, "")], "a/msg/B": [("z", 145, 0, 0, _WHEELS)]}
_BOUNDED = {_WHEELS: [("x", 97 + 5, 7, 0, ""), ("y", 21, 0, 9, ""), ("z", 48 + 17, 2, 0, "")]}

SEEDS: list[bytes] = [
    b"",
    response(_JAZZY, "std_msgs/msg/String"),
    response(_JAZZY, "geometry_msgs/msg/PoseStamped"),
    respond(_NESTED),
    respond(_BOUNDED),
    respond({_WHEELS: []}, ok=False, why="unknown"),
]


def fuzz(data: bytes) -> None:
    """A description is refused, or its type has a hash, and messages can be made of it or the reason is told."""
    try:
        fields = parse_type_response(data)
    except RemoteProtocolError:
        return
    name = next(iter(fields))
    try:
        type_hash = _JAZZY.variant(fields).type_hash(name)
    except (KeyError, RecursionError, TypesysError):
        type_hash = "RIHS01_" + "0" * 64  # an embedded type is missing: ``described`` must say so
    pairs = Ros2Pairs(_JAZZY.variant({}), TypeMapping(), MessageType)
    try:
        pairs.described(name, type_hash, fields)
        conversion = pairs.incoming(name, type_hash)
    except NoConversion:
        return
    if conversion is None:
        raise AssertionError(f"{name} was described, and is not known")
    try:
        conversion.to_ros1(b"\0\1\0\0" + bytes(64))
    except RmpaError:
        return
