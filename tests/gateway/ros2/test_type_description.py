"""Type descriptions of ROS 2 nodes: true ones are read, and what is hostile is refused before code is made of it."""

from __future__ import annotations

import pytest

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.pairs import Ros2Pairs, TypeMapping
from rmpa.gateway.ros2.types import Ros2Types, parse_type_response, type_request
from rmpa.ros.types.messages import MessageType
from tests.gateway.ros2.type_descriptions import respond, response

WHEELS = "base_msgs/msg/Wheels"


def theirs(definition: str) -> Ros2Types:
    types = Ros2Types("jazzy")
    types.learn(MessageType.learn("base_msgs/Wheels", definition).specifications)
    return types


def test_a_request_is_cdr_of_two_strings_and_a_flag() -> None:
    assert type_request("a/msg/B", "RIHS01_x") == (
        b"\0\1\0\0" + b"\x08\0\0\0a/msg/B\0" + b"\x09\0\0\0RIHS01_x\0" + b"\0"
    )


def test_a_described_type_has_the_hash_that_its_publisher_says() -> None:
    types = theirs("float64[4] speed\nstring[] names\ntime when\nbool on\nbyte raw")
    fields = parse_type_response(response(types, WHEELS))
    pairs = Ros2Pairs(Ros2Types("jazzy"), TypeMapping(), MessageType)
    pairs.described(WHEELS, types.type_hash(WHEELS), fields)
    conversion = pairs.incoming(WHEELS, types.type_hash(WHEELS))
    assert conversion is not None
    assert [f"{field} {field.name}" for field in conversion.ros1.fields] == [
        "float64[4] speed", "string[] names", "time when", "bool on", "byte raw",
    ]  # fmt: skip


def test_another_version_of_a_known_type_is_converted_by_its_own_fields() -> None:
    name = "std_msgs/msg/String"
    pairs = Ros2Pairs(Ros2Types("jazzy"), TypeMapping(), MessageType)
    fields = parse_type_response(respond({name: [("data", 17, 0, 0, ""), ("n", 6, 0, 0, "")]}))
    other = Ros2Types("jazzy").variant(fields)
    hashed = other.type_hash(name)
    assert pairs.incoming(name, hashed) is None
    pairs.described(name, hashed, fields)
    conversion = pairs.incoming(name, hashed)
    assert conversion is not None
    string = MessageType("std_msgs/String")
    raw = bytes(other.store.serialize_cdr(other.store.types[name]("hi", 5), name))
    assert conversion.to_ros1(raw) == string.serialize(string.make({"data": "hi"}))


HOSTILE: dict[str, dict[str, list[tuple[str, int, int, int, str]]]] = {
    "code in a field": {WHEELS: [("x = __import__('os')", 6, 0, 0, "")]},
    "code in a type": {"base_msgs/msg/Whe\nels": [("x", 6, 0, 0, "")]},
    "code in a nested type": {WHEELS: [("x", 1, 0, 0, "a/msg/B)]; exit(")]},
    "a line of code": {WHEELS: [("x\n    import os", 6, 0, 0, "")]},
    "no elements": {WHEELS: [("x", 48 + 6, 0, 0, "")]},
    "no fields": {WHEELS: []},
    "itself": {WHEELS: [("x", 1, 0, 0, WHEELS)]},
    "itself in an array": {WHEELS: [("x", 49, 1, 0, WHEELS)]},
    "each other": {WHEELS: [("x", 1, 0, 0, "a/msg/B")], "a/msg/B": [("y", 145, 0, 0, WHEELS)]},
    "a large array": {WHEELS: [("x", 48 + 6, limits.ROS2_ARRAY_MAX + 1, 0, "")]},
    "large arrays in arrays": {
        WHEELS: [("x", 49, 2000, 0, "a/msg/B")],
        "a/msg/B": [("y", 49, 2000, 0, "a/msg/C")],
        "a/msg/C": [("z", 6, 0, 0, "")],
    },
    "two fields of one name": {WHEELS: [("x", 6, 0, 0, ""), ("x", 17, 0, 0, "")]},
    "wide characters": {WHEELS: [("x", 18, 0, 0, "")]},
    "no such type": {WHEELS: [("x", 47, 0, 0, "")]},
    "a long name": {WHEELS: [("x" * 300, 6, 0, 0, "")]},
    "many fields": {WHEELS: [(f"x{number}", 6, 0, 0, "") for number in range(20_000)]},
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_description_is_refused(case: str) -> None:
    with pytest.raises(RemoteProtocolError):
        parse_type_response(respond(HOSTILE[case]))


def test_a_node_that_does_not_know_the_type_says_why() -> None:
    with pytest.raises(RemoteProtocolError, match="never heard"):
        parse_type_response(respond({WHEELS: []}, ok=False, why="never heard of it"))
    with pytest.raises(RemoteProtocolError, match="bytes"):
        parse_type_response(bytes(limits.ROS2_DESCRIPTION_MAX + 1))


def test_a_description_that_is_not_the_publishers_is_refused() -> None:
    pairs = Ros2Pairs(Ros2Types("jazzy"), TypeMapping(), MessageType)
    fields = parse_type_response(response(theirs("int32 x"), WHEELS))
    with pytest.raises(NoConversion, match="type hash"):
        pairs.described(WHEELS, "RIHS01_" + "0" * 64, fields)
    with pytest.raises(NoConversion, match="other types"):
        pairs.described("base_msgs/msg/Other", "RIHS01_" + "0" * 64, fields)
    missing = parse_type_response(respond({WHEELS: [("x", 1, 0, 0, "a/msg/Unknown")]}))
    with pytest.raises(NoConversion, match="not complete"):
        pairs.described(WHEELS, "RIHS01_" + "0" * 64, missing)
