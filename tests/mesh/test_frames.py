"""Frames: golden bytes, whole, byte by byte, malformed, any."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core import limits
from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.mesh.frames import PAYLOAD_MAX, Frame, Kind, pack_data_header, parse_pong, parse_text, pong, unpack_header

GOLDEN = [
    (
        Frame(Kind.DATA, b"\x04\x00\x00\x00abcd", route=7, sequence=12, stamp_ns=0x0102030405060708),
        "00000008 07 03 0000 00000007 0000000c 0102030405060708 0400000061626364",
    ),
    (Frame(Kind.PING, stamp_ns=1), "00000000 04 03 0000 00000000 00000000 0000000000000001"),
    (pong(1, 2, 3), "00000010 05 03 0000 00000000 00000000 0000000000000003 0000000000000001 0000000000000002"),
    (Frame(Kind.BYE, b"ends"), "00000004 08 03 0000 00000000 00000000 0000000000000000 656e6473"),
]


@pytest.mark.parametrize(("frame", "wire"), GOLDEN)
def test_golden_bytes(frame: Frame, wire: str) -> None:
    data = bytes.fromhex(wire)
    assert frame.serialize() == data
    assert Frame.parse(data) == (frame, len(data))
    for cut in range(len(data)):
        assert Frame.parse(data[:cut]) is None
    assert Frame.parse(data + b"next") == (frame, len(data))


def test_the_data_path_packs_the_same_header() -> None:
    frame, _ = GOLDEN[0]
    header = pack_data_header(8, 7, 12, frame.stamp_ns)
    assert header + frame.payload == frame.serialize()
    assert unpack_header(memoryview(header), 0) == (8, 7, 3, 0, 7, 12, frame.stamp_ns)


def test_the_sequence_wraps() -> None:
    assert pack_data_header(0, 1, 1 << 32, 0)[12:16] == bytes(4)


@pytest.mark.parametrize("kind", list(Kind))
def test_lengths_are_limited_by_kind_from_the_header_alone(kind: Kind) -> None:
    header = (PAYLOAD_MAX[kind] + 1).to_bytes(4, "big") + bytes([kind, 3]) + bytes(18)
    with pytest.raises(LimitExceeded, match=kind.name.lower()):
        Frame.parse(header)


@pytest.mark.parametrize("header", [bytes(24), b"\x00\x00\x00\x00\x09\x03" + bytes(18), b"\xff" * 24])
def test_unknown_kinds(header: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        Frame.parse(header)


@pytest.mark.parametrize("flags", [0, 1, 2])
def test_fragments_are_not_in_use(flags: int) -> None:
    with pytest.raises(RemoteProtocolError, match="fragment"):
        Frame.parse(Frame(Kind.DATA, flags=flags).serialize())


def test_our_own_faults() -> None:
    with pytest.raises(LocalProtocolError):
        Frame(Kind.PING, b"x").serialize()
    with pytest.raises(LocalProtocolError):
        pack_data_header(limits.FRAME_PAYLOAD_MAX + 1, 1, 1, 1)
    with pytest.raises(LocalProtocolError):
        pack_data_header(1, 1 << 32, 1, 1)
    with pytest.raises(RemoteProtocolError):
        parse_pong(b"short")


def test_text_is_safe_for_a_log() -> None:
    assert parse_text(b"a\nb\x1b[2J\xff") == "a b [2J\ufffd"
    assert str(GOLDEN[0][0]) == "DATA route=7 #12 8 bytes"
    assert str(GOLDEN[1][0]) == "PING"


@given(
    kind=st.sampled_from(Kind),
    payload=st.binary(max_size=200),
    route=st.integers(0, 2**32 - 1),
    sequence=st.integers(0, 2**32 - 1),
    stamp=st.integers(0, 2**64 - 1),
)
def test_any_frame_survives(kind: Kind, payload: bytes, route: int, sequence: int, stamp: int) -> None:
    frame = Frame(kind, payload[: PAYLOAD_MAX[kind]], route, sequence, stamp)
    assert Frame.parse(frame.serialize()) == (frame, 24 + len(frame.payload))
