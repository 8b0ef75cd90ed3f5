"""Hostile types, names and messages of ROS 2 nodes and ROS 1 publishers: nothing runs, hangs or fills the memory."""

from __future__ import annotations

import contextlib
import struct
import time
import tracemalloc
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.ros2 import transcoder
from rmpa.gateway.ros2.conversion import Conversion, NoConversion
from rmpa.gateway.ros2.pairs import Ros2Pairs, TypeMapping
from rmpa.gateway.ros2.transcoder import LayoutPart, Transcoder
from rmpa.gateway.ros2.types import Ros2Types, parse_type_response
from rmpa.ros.types.messages import MessageType
from tests.gateway.ros2.type_descriptions import respond

if TYPE_CHECKING:
    from pathlib import Path

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
                tracemalloc.stop()


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
        assert not (tmp_path / "owned").exists()
