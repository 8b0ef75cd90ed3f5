"""Fuzz target: messages of ROS 1 and CDR of ROS 2, converted both ways by bytes and by objects."""

from __future__ import annotations

from rmpa.gateway.ros2.conversion import Conversion, ConversionError
from rmpa.gateway.ros2.pairs import TypeMapping
from rmpa.gateway.ros2.types import Ros2Types
from rmpa.ros.types.messages import MessageType

_JAZZY = Ros2Types("jazzy")


def _conversion(name: str) -> Conversion:
    pair = TypeMapping().message(name, _JAZZY)
    if pair is None:
        raise AssertionError(f"{name} has no pair")
    return Conversion(MessageType(name), pair.name, _JAZZY, pair.fields)


_NAMES = (
    "std_msgs/String", "std_msgs/Empty", "nav_msgs/Odometry", "sensor_msgs/CameraInfo", "sensor_msgs/JointState",
    "tf2_msgs/TFMessage", "diagnostic_msgs/DiagnosticArray", "visualization_msgs/MarkerArray",
    "shape_msgs/SolidPrimitive", "rosgraph_msgs/Log", "std_msgs/Float64MultiArray", "trajectory_msgs/JointTrajectory",
)  # fmt: skip
_CONVERSIONS = [_conversion(name) for name in _NAMES]
_VALUES: dict[str, dict[str, object]] = {
    "std_msgs/String": {"data": "hello"},
    "sensor_msgs/JointState": {"name": ["a", "b"], "position": [1.0], "effort": [0.5, 2.0]},
    "tf2_msgs/TFMessage": {"transforms": [{"child_frame_id": "x"}, {}]},
    "visualization_msgs/MarkerArray": {"markers": [{"ns": "m", "points": [{"x": 1.0}]}, {}]},
    "shape_msgs/SolidPrimitive": {"dimensions": [1.0, 2.0]},
    "std_msgs/Float64MultiArray": {"data": [1.0, 2.0], "layout": {"dim": [{"label": "x"}]}},
    "trajectory_msgs/JointTrajectory": {"points": [{"positions": [1.0], "time_from_start": {"secs": 1, "nsecs": 2}}]},
}


def _seeds() -> list[bytes]:
    made = [b"", b"\0", b"\1\0\1\0\0"]
    for number, conversion in enumerate(_CONVERSIONS):
        kind = conversion.ros1
        raw = kind.serialize(kind.make(_VALUES.get(kind.name)))
        made += [bytes((number,)) + raw, bytes((number,)) + conversion.to_ros2(raw)]
    return made


SEEDS: list[bytes] = _seeds()


def fuzz(data: bytes) -> None:
    """What is converted stays the same from then on; all else is a ConversionError."""
    if not data:
        return
    conversion, raw = _CONVERSIONS[data[0] % len(_CONVERSIONS)], data[1:]
    for first, back in ((conversion.to_ros2, conversion.to_ros1), (conversion.to_ros1, conversion.to_ros2)):
        try:
            other = first(raw)
        except ConversionError:
            continue
        if len(other) > 32 * len(raw) + 4096:
            raise AssertionError("a short message became a long one")
        try:
            again = back(other)
        except ConversionError:
            continue  # a text that is not UTF-8 is not a message to the objects
        if first(again) != other:
            raise AssertionError(f"{conversion.ros2}: the second round differs from the first")
