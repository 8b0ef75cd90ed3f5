"""DiagnosticArray as bytes: golden, and read by the types that others use."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.ros.types.definitions import (
    ARRAY_TYPE,
    DiagnosticLevel,
    DiagnosticStatus,
    frame_array,
    known_description,
    md5sum,
    parse_definition,
)
from rmpa.ros.types.messages import MessageType

GOLDEN = (
    "45000000"  # the message's length
    "07000000"  # header: seq
    "05000000"
    "06000000"  # stamp
    "00000000"  # frame_id
    "01000000"  # one status
    "01"  # WARN
    "05000000"
    "726d7061 3a"  # name "rmpa:"
    "03000000"
    "c2b573"  # message, UTF-8
    "01000000"
    "62"  # hardware_id
    "02000000"  # two values
    "04000000"
    "72617465"
    "02000000"
    "3130"
    "01000000"
    "6b"
    "00000000"
).replace(" ", "")


def test_golden_bytes() -> None:
    status = DiagnosticStatus(DiagnosticLevel.WARN, "rmpa:", "µs", "b", {"rate": "10", "k": ""})
    framed = frame_array(7, 5_000_000_006, [status.serialize()])
    assert framed.hex() == GOLDEN
    assert struct.unpack_from("<I", framed)[0] == len(framed) - 4


@pytest.mark.parametrize(
    ("name", "md5"),
    [
        (ARRAY_TYPE, "60810da900de1dd6ddd437c3503511da"),
        ("rosgraph_msgs/Log", "acffd30cd6b6de30f120938c17c593fb"),
    ],
)
def test_the_definitions_are_those_of_ros(name: str, md5: str) -> None:
    about = known_description(name)
    assert (about.type, about.md5sum) == (name, md5)
    assert md5sum(name, parse_definition(name, about.definition)) == md5


TEXT = st.text(max_size=20)
STATUS = st.builds(
    DiagnosticStatus, st.sampled_from(DiagnosticLevel), TEXT, TEXT, TEXT, st.dictionaries(TEXT, TEXT, max_size=5)
)


@given(st.integers(0, 1 << 40), st.integers(0, (1 << 31) * 1_000_000_000 - 1), st.lists(STATUS, max_size=5))
def test_others_read_what_we_write(sequence: int, stamp: int, statuses: list[DiagnosticStatus]) -> None:
    framed = frame_array(sequence, stamp, (status.serialize() for status in statuses))
    message = MessageType(ARRAY_TYPE).deserialize(framed[4:])
    assert message.header.seq == sequence & 0xFFFFFFFF
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(stamp, 1_000_000_000)
    assert [
        DiagnosticStatus(
            DiagnosticLevel(s.level), s.name, s.message, s.hardware_id, {v.key: v.value for v in s.values}
        )
        for s in message.status
    ] == statuses


def test_what_is_no_text_becomes_a_question_mark() -> None:
    assert b"a?b" in DiagnosticStatus(DiagnosticLevel.OK, "a\udc80b", "", "", {}).serialize()
