"""Conversion of messages between ROS 1 and ROS 2: each pair there and back, and what does not fit."""

from __future__ import annotations

import hashlib
import math
import random
from typing import Any

import pytest

from rmpa.gateway.ros2.conversion import Conversion, ConversionError, NoConversion
from rmpa.gateway.ros2.pairs import ServicePair, TypeMapping
from rmpa.gateway.ros2.types import Ros2Types, TypePair
from rmpa.ros.types.definitions import Field, known_types
from rmpa.ros.types.find import find_service_type
from rmpa.ros.types.messages import MessageType

JAZZY = Ros2Types("jazzy")
MAPPING = TypeMapping()
INTEGERS = {
    **{f"int{bits}": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
    "byte": (-128, 127),
    "char": (0, 255),
}
PAIRS = {name: pair for name in known_types() if (pair := MAPPING.message(name, JAZZY)) is not None}


def convert(name: str) -> Conversion:
    pair = PAIRS[name]
    return Conversion(MessageType(name), pair.name, JAZZY, pair.fields)


def values(kind: MessageType, name: str, rng: random.Random, depth: int = 0) -> dict[str, Any]:
    """Random values of a type; ``seq`` of headers is 0, for ROS 2 has none."""
    made = {field.name: one(kind, field, rng, depth) for field in kind.specifications[name].fields}
    if name == "std_msgs/Header":
        made["seq"] = 0
    if name == "shape_msgs/SolidPrimitive":
        made["dimensions"] = made["dimensions"][:3]
    return made


def one(kind: MessageType, field: Field, rng: random.Random, depth: int) -> Any:
    count = field.size or rng.randint(0, max(0, 4 - depth))
    if field.array:
        return [scalar(kind, field.type, rng, depth) for _ in range(count)]
    return scalar(kind, field.type, rng, depth)


def scalar(kind: MessageType, name: str, rng: random.Random, depth: int) -> Any:
    if name in INTEGERS:
        low, high = INTEGERS[name]
        return rng.choice((low, high, 0, rng.randint(low, high)))
    if name in ("float32", "float64"):
        return rng.choice((0.0, -0.0, 1.5, -(2.0**-20), math.inf, float(rng.randint(-1000, 1000))))
    if name == "bool":
        return rng.random() < 0.5
    if name == "string":
        return "".join(rng.choice("aZ/ _é世🤖") for _ in range(rng.randint(0, 9)))
    if name in ("time", "duration"):
        low, high = INTEGERS["uint32" if name == "time" else "int32"]
        return {"secs": rng.randint(low, high), "nsecs": rng.randint(0, 10**9 - 1)}
    return values(kind, name, rng, depth + 1)


@pytest.mark.parametrize("name", sorted(PAIRS))
def test_each_type_goes_there_and_back_by_bytes_and_by_values(name: str) -> None:
    conversion, by_values = convert(name), convert(name)
    by_values.transcoder = None  # what other orders of fields need
    kind, rng, raw, cdr = conversion.ros1, random.Random(name), b"", b""
    for value in [None, *(values(kind, name, rng) for _ in range(12))]:
        raw = kind.serialize(kind.make(value))
        cdr = conversion.to_ros2(raw)
        message = JAZZY.store.deserialize_cdr(cdr, conversion.ros2)
        assert bytes(JAZZY.store.serialize_cdr(message, conversion.ros2)) == cdr, value
        if PAIRS[name].fields is not None:  # some fields are lost on the way: the second round loses no more
            raw = conversion.to_ros1(cdr)
        assert conversion.to_ros1(cdr) == raw, value
        assert by_values.to_ros2(raw) == cdr, value
        assert by_values.to_ros1(cdr) == raw, value
    for change, good in ((conversion.to_ros2, raw), (conversion.to_ros1, cdr)):
        for bad in (good[: len(good) // 2], good + bytes(8)):
            if len(good) > 8:
                with pytest.raises(ConversionError):
                    change(bad)


def test_all_pairs_but_one_are_converted_by_bytes_and_their_cdr_stays_as_it_was() -> None:
    assert {name for name in PAIRS if convert(name).transcoder is None} == {"rosgraph_msgs/Log"}, "a rule has fields"
    digest = hashlib.sha256()
    for name in sorted(PAIRS):
        conversion = convert(name)
        rng = random.Random(name)
        for value in [None, *(values(conversion.ros1, name, rng) for _ in range(6))]:
            digest.update(conversion.to_ros2(conversion.ros1.serialize(conversion.ros1.make(value))))
    assert digest.hexdigest() == "139ed1c62b725159194ce34fafa03579d34c2045e19894ffa738a9f199ee9558"


def test_a_big_endian_message_of_ros2_is_read_too() -> None:
    conversion = convert("std_msgs/Int32")
    message = JAZZY.store.types["std_msgs/msg/Int32"](258)
    raw = bytes(JAZZY.store.serialize_cdr(message, "std_msgs/msg/Int32", little_endian=False))
    assert conversion.to_ros1(raw) == (258).to_bytes(4, "little")


def test_an_array_beyond_ros2s_bound_is_refused_with_the_field() -> None:
    conversion = convert("shape_msgs/SolidPrimitive")
    kind = conversion.ros1
    with pytest.raises(ConversionError, match="dimensions has 4 elements; ROS 2 allows 3"):
        conversion.to_ros2(kind.serialize(kind.make({"type": 1, "dimensions": [1.0, 2.0, 3.0, 4.0]})))


def test_a_rule_with_paths_says_what_goes_where() -> None:
    kind = MessageType.learn("robot_msgs/Sonar", "Header header\nfloat32 distance\n" + header_definition())
    fields = {"header.stamp": "header.stamp", "distance": "range"}
    conversion = Conversion(kind, "sensor_msgs/msg/Range", JAZZY, fields)
    value = {"header": {"stamp": {"secs": 9, "nsecs": 1}, "frame_id": "lost"}, "distance": 2.5}
    cdr = conversion.to_ros2(kind.serialize(kind.make(value)))
    read: Any = JAZZY.store.deserialize_cdr(cdr, "sensor_msgs/msg/Range")
    assert (read.header.stamp.sec, read.header.frame_id, read.range) == (9, "", 2.5)
    back = kind.to_plain(kind.deserialize(conversion.to_ros1(cdr)))
    assert back["distance"] == 2.5


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("std_msgs/Byte", {"data": -56}),
        ("std_msgs/ByteMultiArray", {"data": [-128, -56, 127]}),
        ("std_msgs/Header", {"stamp": {"secs": 2**32 - 1, "nsecs": 5}}),
    ],
)
def test_bytes_and_late_times_keep_their_bits_by_values_too(name: str, values: dict[str, Any]) -> None:
    kind = MessageType(name)
    conversion = Conversion(kind, name.replace("/", "/msg/"), JAZZY, {field: field for field in values})
    assert conversion.transcoder is None
    raw = kind.serialize(kind.make(values))
    assert conversion.to_ros1(conversion.to_ros2(raw)) == raw


def test_a_path_to_a_field_that_is_not_there_is_refused() -> None:
    kind = MessageType("std_msgs/String")
    for fields in ({"nothing": "data"}, {"data": "nothing"}, {"data.more": "data"}, {"": "data"}):
        with pytest.raises(NoConversion, match="has no field"):
            Conversion(kind, "std_msgs/msg/String", JAZZY, fields)


def test_fields_of_other_kinds_are_no_pair() -> None:
    kind = MessageType("std_msgs/Float32MultiArray")
    with pytest.raises(NoConversion):
        Conversion(kind, "std_msgs/msg/String", JAZZY)


def header_definition() -> str:
    """The definition of the header behind a line of ``=``, as a publisher sends it."""
    text = MessageType("std_msgs/Header").definition
    return "=" * 80 + "\nMSG: std_msgs/Header\n" + text


HEADER = {"stamp": {"secs": 5, "nsecs": 6}, "frame_id": "odom"}
STAMP = {"secs": 1, "nsecs": 7}
VALUES = [{"key": "t", "value": "90"}, {"key": "", "value": ""}]
CDR_OF_CYCLONEDDS: dict[str, tuple[dict[str, Any], str]] = {
    "sensor_msgs/Range": (
        {
            "header": HEADER,
            "radiation_type": 1,
            "field_of_view": 0.5,
            "min_range": 0.25,
            "max_range": 4,
            "range": 1.5,
        },
        "000100000500000006000000050000006f646f6d000100000000003f0000803e000080400000c03f00000000",
    ),
    "sensor_msgs/JointState": (
        {"header": HEADER, "name": ["a", "elbow"], "position": [1.0, -2.0], "effort": [0.5]},
        (
            "000100000500000006000000050000006f646f6d0000000002000000020000006100000006000000656c626f7700000002000000"
            "000000000000f03f00000000000000c00000000001000000000000000000e03f"
        ),
    ),
    "tf2_msgs/TFMessage": (
        {
            "transforms": [
                {
                    "header": HEADER,
                    "child_frame_id": "base",
                    "transform": {"translation": {"x": 1, "y": 2, "z": 3}, "rotation": {"w": 1}},
                },
                {"header": {"stamp": STAMP}, "child_frame_id": "arm1", "transform": {"rotation": {"w": 1}}},
            ]
        },
        (
            "00010000020000000500000006000000050000006f646f6d0000000005000000626173650000000000000000000000000000"
            "f03f00000000000000400000000000000840000000000000000000000000000000000000000000000000000000000000f03f"
            "010000000700000001000000000000000500000061726d310000000000000000000000000000000000000000000000000000"
            "000000000000000000000000000000000000000000000000000000000000000000000000f03f"
        ),
    ),
    "diagnostic_msgs/DiagnosticArray": (
        {"header": HEADER, "status": [{"level": 2, "name": "lidar", "message": "hot", "values": VALUES}]},
        (
            "000100000500000006000000050000006f646f6d000000000100000002000000060000006c6964617200000004000000686f7400"
            "0100000000000000020000000200000074000000030000003930000001000000000000000100000000"
        ),
    ),
}
"""What cyclonedds 11.0.1 serializes (XCDR1): strings, gaps before doubles, empty arrays."""


@pytest.mark.parametrize("name", sorted(CDR_OF_CYCLONEDDS))
def test_the_cdr_is_that_of_cyclonedds(name: str) -> None:
    value, golden = CDR_OF_CYCLONEDDS[name]
    conversion = convert(name)
    raw = conversion.ros1.serialize(conversion.ros1.make(value))
    assert conversion.to_ros2(raw).hex() == golden
    assert conversion.to_ros1(bytes.fromhex(golden)) == raw


def test_fields_in_another_order_go_by_name() -> None:
    kind = MessageType.learn("swap_msgs/Pair", "uint16 b\nfloat64 a\nstring c\n")
    JAZZY.learn(MessageType.learn("swap_msgs/Other", "string c\nuint16 b\nfloat64 a\n").specifications)
    JAZZY.take({"swap_msgs/msg/Pair": JAZZY.store.fielddefs["swap_msgs/msg/Other"]})
    conversion = Conversion(kind, "swap_msgs/msg/Pair", JAZZY)
    assert conversion.transcoder is None
    raw = kind.serialize(kind.make({"a": 0.5, "b": 7, "c": "x"}))
    read: Any = JAZZY.store.deserialize_cdr(conversion.to_ros2(raw), "swap_msgs/msg/Pair")
    assert (read.a, read.b, read.c) == (0.5, 7, "x")
    assert conversion.to_ros1(conversion.to_ros2(raw)) == raw


def test_an_empty_string_without_its_null_is_read_and_a_string_without_end_is_not() -> None:
    conversion = convert("std_msgs/String")
    assert conversion.to_ros1(b"\0\1\0\0" + bytes(4)) == bytes(4)
    with pytest.raises(ConversionError, match="no end"):
        conversion.to_ros1(b"\0\1\0\0" + b"\2\0\0\0ab\0\0")


def test_a_response_may_have_garbage_behind_it_as_that_of_rclpy_has() -> None:
    """rclpy's serializer takes too much room for empty sequences of numbers of 8 bytes."""
    kind = find_service_type("std_srvs/SetBool")
    pair = ServicePair(kind, TypePair("std_srvs/srv/SetBool"), Ros2Types("jazzy"))
    response = pair.response.to_ros1(pair.response.to_ros2(b"\1\1\0\0\0x") + bytes(range(20)))
    assert response == b"\1\1\0\0\0x"
