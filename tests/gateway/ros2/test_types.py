"""Type hashes of ROS 2, beside those that ROS 2 Jazzy's packages publish."""

from __future__ import annotations

import pytest

from rmpa.core.errors import ConfigError
from rmpa.gateway.ros2.format import NO_HASH
from rmpa.gateway.ros2.types import Ros2Types, ros2_name, snake_case
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType


@pytest.fixture(scope="module")
def jazzy() -> Ros2Types:
    return Ros2Types("jazzy")


def test_humble_has_no_hash() -> None:
    humble = Ros2Types("humble")
    assert humble.type_hash("std_msgs/msg/String") == NO_HASH
    assert humble.service_hash(ServiceType("std_srvs/Trigger")) == NO_HASH


def test_a_type_that_ros1_defines_has_the_hash_of_its_port(jazzy: Ros2Types) -> None:
    """A type that rosbags knows, under another name, has the fields and so all but the name of the known one."""
    kind = MessageType.learn("my_msgs/Odometry", MessageType("nav_msgs/Odometry").definition)
    jazzy.learn(kind.specifications)
    assert jazzy.store.fielddefs["my_msgs/msg/Odometry"] == jazzy.store.fielddefs["nav_msgs/msg/Odometry"]
    assert jazzy.type_hash("my_msgs/msg/Odometry") != jazzy.type_hash("nav_msgs/msg/Odometry")


def test_known_types_are_not_replaced_by_ros1s(jazzy: Ros2Types) -> None:
    before = jazzy.type_hash("sensor_msgs/msg/Range")
    jazzy.learn(MessageType("sensor_msgs/Range").specifications)
    assert jazzy.type_hash("sensor_msgs/msg/Range") == before


def test_names_and_an_unknown_distribution_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="jazzy"):
        Ros2Types("noetic")
    assert ros2_name("std_msgs/String") == "std_msgs/msg/String"
    assert ros2_name("Header") == "std_msgs/msg/Header"
    assert [snake_case(name) for name in ("K", "frameId", "frame_id", "x2")] == ["k", "frame_id", "frame_id", "x2"]


def test_bytes_are_hashed_as_rosidl_names_them(jazzy: Ros2Types) -> None:
    """``char`` is an unsigned byte to rosidl, ``byte`` an octet: the hashes of std_msgs of ROS 2 Jazzy."""
    published = {
        "String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
        "Char": "RIHS01_3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9",
        "Byte": "RIHS01_41e1a3345f73fe93ede006da826a6ee274af23dd4653976ff249b0f44e3e798f",
    }
    for name, value in published.items():
        assert jazzy.type_hash(f"std_msgs/msg/{name}") == value
        kind = MessageType.learn(f"my_msgs/{name}", MessageType(f"std_msgs/{name}").definition)
        jazzy.learn(kind.specifications)
        assert jazzy.store.fielddefs[f"my_msgs/msg/{name}"][1] == jazzy.store.fielddefs[f"std_msgs/msg/{name}"][1]
