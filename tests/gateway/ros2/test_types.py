"""Types of ROS 2, and hostile ones."""

from __future__ import annotations

import contextlib
import struct
import time
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError, RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.ros2 import transcoder
from rmpa.gateway.ros2.asking import parse_type_response, type_request
from rmpa.gateway.ros2.conversion import Conversion, NoConversion
from rmpa.gateway.ros2.format import NO_HASH, Ros2Attachment
from rmpa.gateway.ros2.pairs import Ros2Pairs, TypeMapping
from rmpa.gateway.ros2.transcoder import LayoutPart, Transcoder
from rmpa.gateway.ros2.types import Ros2Sequences, Ros2Types, ros2_name, snake_case
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
    assert counts.lost == 0
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
        assert counts.accept(numbered(1, gid), history=True), "the one that was silent for longest was forgotten"


HEAD = b"\0\1\0\0"
INT32, NESTED = 6, 1


def laughs(levels: int) -> dict[str, list[tuple[str, int, int, int, str]]]:
    """A type of a few hundred bytes that embeds 16 ** levels numbers."""
    made = {
        f"eve/msg/L{level}": [(f"f{each}", NESTED, 0, 0, f"eve/msg/L{level + 1}") for each in range(16)]
        for level in range(levels)
    }
    return {**made, f"eve/msg/L{levels}": [("x", INT32, 0, 0, "")]}


def bomb1(levels: int) -> str:
    """The same as a definition of ROS 1."""
    own = "\n".join(f"L1 f{each}" for each in range(16))
    inner = [
        f"MSG: eve/L{level}\n" + "\n".join(f"L{level + 1} f{each}" for each in range(16))
        for level in range(1, levels)
    ]
    line = "\n" + "=" * 80 + "\n"
    return line.join([own, *inner, f"MSG: eve/L{levels}\nint32 x"])


@pytest.mark.parametrize("levels", [4, 20])
def test_a_type_that_embeds_types_without_end_is_refused_at_once(levels: int) -> None:
    """As a node of ROS 2 describes it, and as a publisher of ROS 1 does in its header, of another site too."""
    begin = time.process_time()
    with pytest.raises(RemoteProtocolError, match="with those of its types"):
        parse_type_response(respond(laughs(levels)))
    with pytest.raises(RmpaError):
        Ros2Pairs(Ros2Types("jazzy"), TypeMapping(), MessageType).outgoing(MessageType.learn("eve/L0", bomb1(levels)))
    assert time.process_time() - begin < 5


def test_descriptions_are_bounded_in_types_and_in_all(monkeypatch: pytest.MonkeyPatch) -> None:
    many = {f"eve/msg/T{number}": [("x", INT32, 0, 0, "")] for number in range(limits.ROS2_DESCRIBED_TYPES_MAX + 1)}
    with pytest.raises(RemoteProtocolError, match="129 types"):
        parse_type_response(respond(many))
    monkeypatch.setattr(limits, "ROS2_LEARNT_FIELDS_MAX", 5)
    pairs = Ros2Pairs(Ros2Types("jazzy"), TypeMapping(), MessageType)

    def describe(number: int) -> None:
        name = f"eve/msg/T{number}"
        fields = parse_type_response(respond({name: [("x", INT32, 0, 0, "")]}))
        pairs.described(name, Ros2Types("jazzy").variant(fields).type_hash(name), fields)

    for number in range(3):
        describe(number)
    with pytest.raises(NoConversion, match="6 fields of ROS 2 were learnt already"):
        describe(3)


def test_a_giant_array_of_ros_1_is_not_made_up_for_each_message() -> None:
    """Else a message of 4 bytes from ROS 2 would become one of gigabytes."""
    types = Ros2Types("jazzy")
    types.learn(MessageType.learn("eve/A", "int32 x").specifications)
    with pytest.raises(NoConversion, match="arrays of more than"):
        Conversion(MessageType.learn("eve/A", "int32 x\nfloat64[100000000] y"), "eve/msg/A", types)


def test_elements_that_the_other_side_fills_up_are_bounded() -> None:
    """Each element has 4 bytes in ROS 2, and 8,000 more in ROS 1."""
    made = Transcoder((LayoutPart(items=(LayoutPart(4), LayoutPart(8, 1000, in2=False))),))
    assert len(made.to_ros1(HEAD + struct.pack("<I", 10) + bytes(40))) == 4 + 10 * 8004
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="too many elements"):
            made.to_ros1(HEAD + struct.pack("<I", 100_000) + bytes(400_000))
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def test_loops_within_loops_are_bounded_and_arrays_of_numbers_are_not() -> None:
    texts = Transcoder((LayoutPart(items=(LayoutPart(items=(LayoutPart(),)),)),))
    begin = time.process_time()
    with pytest.raises(ValueError, match="too many elements"):
        texts.to_ros1(HEAD + struct.pack("<I", 3_000_000) + bytes(12_000_000))
    assert time.process_time() - begin < 10
    image = Transcoder((LayoutPart(items=(LayoutPart(1),)),))
    size = 8_000_000
    assert len(image.to_ros1(HEAD + struct.pack("<I", size) + bytes(size))) == size + 4
    with pytest.raises(ValueError, match="fixed length"):
        Transcoder((LayoutPart(0, limits.ROS2_WORK_MAX + 1, (LayoutPart(),)),))


@pytest.mark.parametrize("count", [2**32 - 1, 2**31, 1000])
def test_a_length_that_the_message_does_not_have_allocates_nothing(count: int) -> None:
    for part in (
        LayoutPart(items=(LayoutPart(),)),
        LayoutPart(items=(LayoutPart(8),)),
        LayoutPart(),
        LayoutPart(items=(LayoutPart(items=(LayoutPart(1),)),)),
    ):
        made = Transcoder((part,))
        for convert, head in ((made.to_ros1, HEAD), (made.to_cdr, b"")):
            tracemalloc.start()
            try:
                with pytest.raises((ValueError, struct.error, IndexError)):
                    convert(head + struct.pack("<I", count) + bytes(8))
                assert tracemalloc.get_traced_memory()[1] < 1_000_000
            finally:
                tracemalloc.stop()  # fmt: skip


def test_no_name_of_a_type_gets_into_the_code_of_a_conversion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also names that the parsers would refuse: the code has numbers alone."""
    written: list[str] = []
    write = transcoder.FunctionText.add

    def add(self: transcoder.FunctionText, *lines: str) -> None:
        written.extend(lines)
        write(self, *lines)

    monkeypatch.setattr(transcoder.FunctionText, "add", add)
    evil = "x'); raise SystemExit  # {1/0}"
    made = Transcoder((LayoutPart(bound=2, name=evil), LayoutPart(items=(LayoutPart(),), bound=2, name=evil)))
    assert not any("SystemExit" in line for line in written)
    with pytest.raises(ValueError, match=r"SystemExit.* has 3 bytes; ROS 2 allows 2"):
        made.to_cdr(struct.pack("<I", 3) + b"abc" + bytes(4))
    with pytest.raises(ValueError, match=r"SystemExit.* has 3 elements; ROS 2 allows 2"):
        made.to_cdr(bytes(4) + struct.pack("<I", 3) + bytes(12))


def test_a_mapping_file_is_data_and_its_errors_name_it(tmp_path: Path) -> None:
    for text in (
        "!!python/object/apply:os.system ['touch owned']",
        "- &a [*a, *a]",
        "&a [" + "[" * 1000,
        "- {ros1_package_name: ../../etc, ros1_message_name: passwd, ros2_package_name: x, ros2_message_name: y}",
    ):
        file = tmp_path / "rules.yaml"
        file.write_text(text)
        with contextlib.suppress(RmpaError):
            TypeMapping().read(file)
        assert not (tmp_path / "owned").exists()  # fmt: skip
