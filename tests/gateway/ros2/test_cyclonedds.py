"""The CDR that conversions make and read, against that of Eclipse Cyclone DDS, which ROS 2 itself serializes with."""

from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="the extra zenoh-peers is not installed")

from cyclonedds.idl import make_idl_struct, types

from rmpa.gateway.ros2.conversion import Conversion
from rmpa.gateway.ros2.types import Ros2Types
from rmpa.ros.types.messages import MessageType

JAZZY = Ros2Types("jazzy")


def idl(name: str, /, **fields: Any) -> Any:
    """A type of Cyclone DDS, as ROS 2 names it: ``std_msgs/String``."""
    package, _, base = name.partition("/")
    return make_idl_struct(base, f"{package}::msg::dds_::{base}_", fields, bases=())


String = idl("std_msgs/String", data=str)
Time = idl("builtin_interfaces/Time", sec=types.int32, nanosec=types.uint32)
Header = idl("std_msgs/Header", stamp=Time, frame_id=str)
JointState = idl(
    "sensor_msgs/JointState",
    header=Header,
    name=types.sequence[str],
    position=types.sequence[types.float64],
    velocity=types.sequence[types.float64],
    effort=types.sequence[types.float64],
)
Quaternion = idl("geometry_msgs/Quaternion", x=types.float64, y=types.float64, z=types.float64, w=types.float64)
Vector3 = idl("geometry_msgs/Vector3", x=types.float64, y=types.float64, z=types.float64)
Imu = idl(
    "sensor_msgs/Imu",
    header=Header,
    orientation=Quaternion,
    orientation_covariance=types.array[types.float64, 9],
    angular_velocity=Vector3,
    angular_velocity_covariance=types.array[types.float64, 9],
    linear_acceleration=Vector3,
    linear_acceleration_covariance=types.array[types.float64, 9],
)
Image = idl(
    "sensor_msgs/Image",
    header=Header,
    height=types.uint32,
    width=types.uint32,
    encoding=str,
    is_bigendian=types.uint8,
    step=types.uint32,
    data=types.sequence[types.uint8],
)
Range = idl(
    "sensor_msgs/Range",
    header=Header,
    radiation_type=types.uint8,
    field_of_view=types.float32,
    min_range=types.float32,
    max_range=types.float32,
    range=types.float32,
    variance=types.float32,
)

HEADER = Header(Time(5, 999_999_999), "odom")
PLAIN = {"seq": 0, "stamp": {"secs": 5, "nsecs": 999_999_999}, "frame_id": "odom"}
NINE = [float(number) for number in range(9)]
VECTOR, QUATERNION = {"x": 1.0, "y": -2.0, "z": 0.5}, {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "std_msgs/String": (String("héllo"), {"data": "héllo"}),
    "sensor_msgs/JointState": (
        JointState(HEADER, ["a", "", "lönger"], [1.5, -2.5], [], [3.0]),
        {"header": PLAIN, "name": ["a", "", "lönger"], "position": [1.5, -2.5], "velocity": [], "effort": [3.0]},
    ),
    "sensor_msgs/Imu": (
        Imu(HEADER, Quaternion(**QUATERNION), NINE, Vector3(**VECTOR), NINE, Vector3(**VECTOR), NINE),
        {
            "header": PLAIN,
            "orientation": QUATERNION,
            "orientation_covariance": NINE,
            "angular_velocity": VECTOR,
            "angular_velocity_covariance": NINE,
            "linear_acceleration": VECTOR,
            "linear_acceleration_covariance": NINE,
        },
    ),
    "sensor_msgs/Image": (
        Image(HEADER, 2, 1, "mono8", 0, 1, [7, 255]),
        {"header": PLAIN, "height": 2, "width": 1, "encoding": "mono8", "step": 1, "data": [7, 255]},
    ),
    "sensor_msgs/Range": (
        Range(HEADER, 1, 0.5, 0.25, 4.0, 2.0, 0.0),
        {
            "header": PLAIN,
            "radiation_type": 1,
            "field_of_view": 0.5,
            "min_range": 0.25,
            "max_range": 4.0,
            "range": 2.0,
        },
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_cyclonedds_writes_and_reads_the_same_bytes(name: str) -> None:
    theirs, plain = CASES[name]
    kind = MessageType(name)
    conversion = Conversion(kind, name.replace("/", "/msg/"), JAZZY)
    raw, cdr = kind.serialize(kind.make(plain)), bytes(theirs.serialize())
    made = conversion.to_ros2(raw)
    assert type(theirs).deserialize(made) == theirs
    # Behind the last field Cyclone DDS fills up to 4 bytes, and says in the head how many of them are padding.
    padding = cdr[3] & 3
    assert made[4:] == cdr[4 : len(cdr) - padding]
    assert conversion.to_ros1(cdr) == raw
