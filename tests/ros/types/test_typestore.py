from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from rosbags.typesys import Stores, get_typestore

from rmpa.ros.types.messages import MessageType
from rmpa.ros.types.typestore import Ros1Store

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

NAMES = (
    "diagnostic_msgs/DiagnosticArray", "nav_msgs/OccupancyGrid", "nav_msgs/Odometry", "sensor_msgs/CameraInfo",
    "sensor_msgs/Joy", "sensor_msgs/PointCloud2", "std_msgs/Empty",
    "trajectory_msgs/JointTrajectory",
)  # fmt: skip


@pytest.fixture(scope="module")
def rosbags_own() -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC)


@pytest.mark.parametrize("name", NAMES)
def test_bytes_are_those_of_rosbags_own_store(name: str, rosbags_own: Typestore) -> None:
    kind, inner = MessageType(name), name.replace("/", "/msg/")
    values = {"header": {"seq": 7, "stamp": {"secs": 3, "nsecs": 4}, "frame_id": "map"}}
    message = kind.make(values if any(field.name == "header" for field in kind.fields) else None)
    raw = kind.serialize(message)
    assert raw == bytes(rosbags_own.serialize_ros1(message, inner))
    assert repr(kind.deserialize(raw)) == repr(rosbags_own.deserialize_ros1(raw, inner))


def test_it_is_ros_1_alone() -> None:
    store = Ros1Store(Stores.ROS1_NOETIC)
    empty = store.types["std_msgs/msg/String"](data="")
    with pytest.raises(NotImplementedError, match="ROS 1 alone"):
        store.serialize_cdr(empty, "std_msgs/msg/String")
    with pytest.raises(KeyError):
        store.get_msgdef("nobody_msgs/msg/Nothing")


def test_what_one_store_learns_another_does_not_know() -> None:
    one, other = Ros1Store(Stores.EMPTY), Ros1Store(Stores.EMPTY)
    one.types["x/msg/Y"] = object  # type: ignore[assignment] # any will do
    assert "x/msg/Y" not in other.types
