"""Types of ROS 2: hashes beside those that ROS 2 Jazzy publishes, descriptions of nodes, and sequence numbers."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError, RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.conversion import NoConversion
from rmpa.gateway.ros2.format import NO_HASH, Ros2Attachment
from rmpa.gateway.ros2.pairs import Ros2Pairs, TypeMapping
from rmpa.gateway.ros2.types import Ros2Sequences, Ros2Types, parse_type_response, ros2_name, snake_case, type_request
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from tests.gateway.ros2.type_descriptions import respond, response


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


# --- Type descriptions of ROS 2 nodes -------------------------------------------------------------------------------

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


# --- Losses and repetitions by the numbers of publishers ------------------------------------------------------------


def numbered(sequence: int, gid: bytes = b"a") -> Ros2Attachment:
    return Ros2Attachment(sequence, 0, gid)


@given(st.sets(st.integers(1, 200), min_size=1))
def test_each_gap_is_a_loss(numbers: set[int]) -> None:
    counts = Ros2Sequences()
    assert all(counts.accept(numbered(number), history=False) for number in sorted(numbers))
    assert counts.lost == max(numbers) - min(numbers) + 1 - len(numbers)


def test_publishers_are_counted_apart_and_a_repetition_of_a_history_is_dropped() -> None:
    counts = Ros2Sequences()
    for number in (5, 6):
        assert counts.accept(numbered(number), history=True)
        assert counts.accept(numbered(number + 90, b"b"), history=True)
    assert not counts.accept(numbered(6), history=True)
    assert (counts.lost, counts.repeated) == (0, 1)
    assert counts.accept(numbered(1), history=False), "a publisher that counts anew"
    assert counts.accept(numbered(0), history=True), "a program that does not count"
    assert counts.accept(numbered(0), history=True)
    counts.forget()
    assert counts.accept(numbered(100), history=True)
    assert counts.lost == 0


def test_the_publishers_that_are_followed_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ROS2_PUBLISHERS_MAX", 2)
    counts = Ros2Sequences()
    for gid in (b"a", b"b", b"c", b"a"):
        assert counts.accept(numbered(1, gid), history=True)
    assert counts.repeated == 0, "the one that was silent for longest was forgotten"
