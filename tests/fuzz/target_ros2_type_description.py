"""Fuzz target: what a ROS 2 node says of its types, up to the conversion that is made of it."""

from __future__ import annotations

from typing import Any

from rosbags.typesys.base import TypesysError

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway.ros2.asking import parse_type_response
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.pairs import Ros2Pairs, ServicePair, TypeMapping, derive_service, described_types
from rmpa.gateway.ros2.types import Ros2Types, TypePair
from rmpa.ros.types.definitions import known_text
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from tests.gateway.ros2.type_descriptions import respond, response


def _find(name: str) -> str | None:
    return "float32 x\n" if name == "odd_msgs/Finger" else known_text(name)


_JAZZY = Ros2Types("jazzy")
_SERVICE = "odd_msgs/srv/Grip"
_JAZZY.service_hash(ServiceType("odd_msgs/Grip", "Header header\nodd_msgs/Finger[] all\n---\nbool ok\n", _find))
_WHEELS = "base_msgs/msg/Wheels"
_NESTED = {_WHEELS: [("x", 49, 3, 0, "a/msg/B"), ("y", 22, 0, 5, "")], "a/msg/B": [("z", 145, 0, 0, _WHEELS)]}
_BOUNDED = {_WHEELS: [("x", 97 + 5, 7, 0, ""), ("y", 21, 0, 9, ""), ("z", 48 + 17, 2, 0, "")]}

SEEDS: list[bytes] = [
    b"",
    response(_JAZZY, "std_msgs/msg/String"),
    response(_JAZZY, "geometry_msgs/msg/PoseStamped"),
    response(_JAZZY, _SERVICE),
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
    _fuzz_service(name, type_hash, fields)
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


def _fuzz_service(name: str, type_hash: str, fields: dict[str, Any]) -> None:
    """A service type that is described has a form in ROS 1, or the reason is told."""
    if f"{name}_Request" not in fields:
        return
    try:
        types = described_types(_JAZZY, name, type_hash, fields)
        kind = derive_service(types.store, name, "odd_msgs/Grip", TypeMapping().ros1_type)
        ServicePair(kind, TypePair(name), types)
    except (RmpaError, KeyError):
        return
