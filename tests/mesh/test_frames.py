"""Frames: golden bytes, whole, byte by byte, malformed, any."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core import limits as core_limits
from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.core.outbox import ABORT, FIRST, LAST, QueuedMessage
from rmpa.mesh import limits
from rmpa.mesh.frames import (
    PAYLOAD_MAX,
    WHOLE,
    Frame,
    FrameKind,
    check_header,
    pack_data_header,
    pack_fragment_header,
    parse_pong,
    parse_text,
    pong,
    unpack_header,
)

GOLDEN = [
    (
        Frame(FrameKind.DATA, b"\x04\x00\x00\x00abcd", route=7, sequence=12, stamp_ns=0x0102030405060708),
        "00000008 07 03 0000 00000007 0000000c 0102030405060708 0400000061626364",
    ),
    (Frame(FrameKind.PING, stamp_ns=1), "00000000 04 03 0000 00000000 00000000 0000000000000001"),
    (pong(1, 2, 3), "00000010 05 03 0000 00000000 00000000 0000000000000003 0000000000000001 0000000000000002"),
    (Frame(FrameKind.BYE, b"ends"), "00000004 08 03 0000 00000000 00000000 0000000000000000 656e6473"),
    (
        Frame(FrameKind.DATA, b"\x08\0\0\0ab", 7, 12, 9, flags=FIRST),
        "00000006 07 01 0000 00000007 0000000c 0000000000000009 080000006162",
    ),
    (Frame(FrameKind.DATA, b"cd", 7, 12, 9, flags=0), "00000002 07 00 0000 00000007 0000000c 0000000000000009 6364"),
    (
        Frame(FrameKind.DATA, b"ef", 7, 12, 9, flags=LAST),
        "00000002 07 02 0000 00000007 0000000c 0000000000000009 6566",
    ),
    (
        Frame(FrameKind.DATA, b"", 7, 12, 9, flags=LAST | ABORT),
        "00000000 07 06 0000 00000007 0000000c 0000000000000009",
    ),
    (Frame(FrameKind.ACK, route=7, sequence=0xFFFFFFFF), "00000000 09 03 0000 00000007 ffffffff 0000000000000000"),
    (Frame(FrameKind.FENCE, route=7, sequence=1), "00000000 0a 03 0000 00000007 00000001 0000000000000000"),
    (Frame(FrameKind.FENCED, route=7, sequence=1), "00000000 0b 03 0000 00000007 00000001 0000000000000000"),
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


def test_a_parcel_makes_the_headers_of_its_fragments() -> None:
    parcel = QueuedMessage(7, 10, 12, 9)
    sizes = [(6, FIRST), (2, 0), (2, LAST), (0, LAST | ABORT)]
    for (frame, _), (length, flags) in zip(GOLDEN[4:8], sizes, strict=True):
        assert pack_fragment_header(parcel, length, flags) + frame.payload == frame.serialize()
    assert pack_fragment_header(QueuedMessage(7, 10, (1 << 32) + 12, 9), 2, 0) == GOLDEN[5][0].serialize()[:24]


def test_the_sequence_wraps() -> None:
    assert pack_data_header(0, 1, 1 << 32, 0)[12:16] == bytes(4)


@pytest.mark.parametrize("kind", list(FrameKind))
def test_header_alone_limits_the_length_by_kind(kind: FrameKind) -> None:
    header = (PAYLOAD_MAX[kind] + 1).to_bytes(4, "big") + bytes([kind, 3]) + bytes(18)
    with pytest.raises(LimitExceeded, match=kind.name.lower()):
        Frame.parse(header)


@pytest.mark.parametrize("kind", [0, 14, 0x7F, 0xFF])
def test_unknown_kinds(kind: int) -> None:
    with pytest.raises(RemoteProtocolError, match="unknown kind"):
        Frame.parse(bytes([0, 0, 0, 0, kind, 3]) + bytes(18))


@pytest.mark.parametrize("kind", [kind for kind in FrameKind if kind is not FrameKind.DATA])
@pytest.mark.parametrize("flags", [0, FIRST, LAST, LAST | ABORT, ABORT])
def test_only_data_comes_in_fragments(kind: FrameKind, flags: int) -> None:
    with pytest.raises(RemoteProtocolError, match="fragment"):
        Frame.parse(Frame(kind, flags=flags).serialize())


@pytest.mark.parametrize(
    ("payload", "flags", "problem"),
    [
        (b"", WHOLE, "without data"),
        (b"", FIRST, "without data"),
        (b"", 0, "without data"),
        (b"", LAST, "without data"),
        (b"", ABORT, "aborts"),
        (b"", FIRST | ABORT, "aborts"),
        (b"", WHOLE | ABORT, "aborts"),
        (b"x", LAST | ABORT, "aborts"),
        (b"x", WHOLE | ABORT, "aborts"),
    ],
)
def test_a_fragment_that_cannot_be(payload: bytes, flags: int, problem: str) -> None:
    with pytest.raises(RemoteProtocolError, match=problem):
        Frame.parse(Frame(FrameKind.DATA, payload, flags=flags).serialize())


@pytest.mark.parametrize("flags", [0x08, 0x80, 0xF8])
def test_flags_of_a_later_version_are_ignored(flags: int) -> None:
    check_header(0, FrameKind.PING, WHOLE | flags)
    for own in (0, FIRST, LAST, WHOLE):
        check_header(1, FrameKind.DATA, own | flags)


def test_fragment_length_is_bounded() -> None:
    check_header(core_limits.FRAGMENT_BYTES, FrameKind.DATA, 0)
    check_header(limits.DATA_PAYLOAD_MAX, FrameKind.DATA, WHOLE)
    with pytest.raises(LimitExceeded, match="data"):
        check_header(limits.DATA_PAYLOAD_MAX + 1, FrameKind.DATA, 0)


def test_our_own_faults() -> None:
    with pytest.raises(LocalProtocolError):
        Frame(FrameKind.PING, b"x").serialize()
    with pytest.raises(LocalProtocolError):
        pack_data_header(limits.DATA_PAYLOAD_MAX + 1, 1, 1, 1)
    with pytest.raises(LocalProtocolError):
        pack_data_header(1, 1 << 32, 1, 1)
    with pytest.raises(RemoteProtocolError):
        parse_pong(b"short")


def test_text_is_safe_for_a_log() -> None:
    assert parse_text(b"a\nb\x1b[2J\xff") == "a b [2J\ufffd"
    assert str(GOLDEN[0][0]) == "DATA route=7 #12 8 bytes"
    assert str(GOLDEN[1][0]) == "PING"
    assert str(GOLDEN[4][0]) == "DATA route=7 #12 flags=1 6 bytes"
    assert str(GOLDEN[7][0]) == "DATA route=7 #12 flags=6"


@given(
    kind=st.sampled_from(FrameKind),
    payload=st.binary(max_size=200),
    route=st.integers(0, 2**32 - 1),
    sequence=st.integers(0, 2**32 - 1),
    stamp=st.integers(0, 2**64 - 1),
    flags=st.sampled_from([0, FIRST, LAST, WHOLE]),
)
def test_any_frame_survives(
    kind: FrameKind, payload: bytes, route: int, sequence: int, stamp: int, flags: int
) -> None:
    if kind is FrameKind.DATA:
        frame = Frame(kind, payload or b"x", route, sequence, stamp, flags)
    else:
        frame = Frame(kind, payload[: PAYLOAD_MAX[kind]], route, sequence, stamp)
    assert Frame.parse(frame.serialize()) == (frame, 24 + len(frame.payload))
