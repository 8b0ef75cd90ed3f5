"""The attachment of ROS 2's messages: golden bytes, and bytes that are none."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway.ros2.format import Ros2Attachment

GOLDEN = bytes.fromhex("0700000000000000 15cd5b0700000000 10 000102030405060708090a0b0c0d0e0f")
ATTACHMENT = Ros2Attachment(7, 123456789, bytes(range(16)))


def test_golden_bytes() -> None:
    assert ATTACHMENT.serialize() == GOLDEN
    assert len(GOLDEN) == 33
    assert Ros2Attachment.parse(GOLDEN) == ATTACHMENT


def test_what_later_versions_add_is_ignored() -> None:
    assert Ros2Attachment.parse(GOLDEN + b"more") == ATTACHMENT


@pytest.mark.parametrize("length", range(len(GOLDEN)))
def test_a_shorter_one_is_refused(length: int) -> None:
    with pytest.raises(RemoteProtocolError):
        Ros2Attachment.parse(GOLDEN[:length])


@given(st.integers(-(2**63), 2**63 - 1), st.integers(-(2**63), 2**63 - 1), st.binary(max_size=255))
def test_each_is_read_back(sequence: int, stamp: int, gid: bytes) -> None:
    made = Ros2Attachment(sequence, stamp, gid)
    assert Ros2Attachment.parse(memoryview(made.serialize())) == made


def test_the_older_form_with_names_is_read() -> None:
    raw = (
        b"\x0fsequence_number" + (7).to_bytes(8, "little") + b"\x10source_timestamp" + (9).to_bytes(8, "little")
        + b"\x0asource_gid" + b"\x10" + bytes(range(16))
    )  # fmt: skip
    assert Ros2Attachment.parse(raw) == Ros2Attachment(7, 9, bytes(range(16)))
    for end in range(16, len(raw)):
        with pytest.raises(RemoteProtocolError):
            Ros2Attachment.parse(raw[:end])
