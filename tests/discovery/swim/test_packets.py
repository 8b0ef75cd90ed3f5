"""The codec of the failure detector: golden bytes, whole, byte by byte, malformed, and anything at all."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import LimitExceeded
from rmpa.core.guid import Guid
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon, BeaconMalformed, BeaconOtherDomain, BeaconOtherVersion
from rmpa.discovery.swim.packets import (
    MemberState,
    News,
    SwimKind,
    SwimMalformed,
    SwimPacket,
    is_swim,
    room_for_news,
)
from rmpa.trust.packets import TRAILER_BYTES
from tests.fuzz import target_swim

HEAD = (
    "524d5041 01 {kind:02x} 0005"  # RMPA, version 1, kind, domain 5
    "0a000001 9c41 0007"  # 10.0.0.1:40001#7
    "000102030405060708090a0b0c0d0e0f"
    "0000002a 0102030405060708 00000003 00000009 01"  # sequence, digest, incarnation, version, active
)
NEWS_BYTES = (
    "03"
    "0a0000029c420000 1011121314151617 00 00000000 00000004"
    "0a0000039c430001 2021222324252627 01 00000002 00000005 0001020304050607"
    "0a0000039c430001 2021222324252627 02 00000002 00000005"
)
NEWS = (
    News(Guid.of("10.0.0.2", 40002), bytes(range(16, 24)), MemberState.ALIVE, 0, 4),
    News(Guid.of("10.0.0.3", 40003, 1), bytes(range(32, 40)), MemberState.SUSPECT, 2, 5, bytes(range(8))),
    News(Guid.of("10.0.0.3", 40003, 1), bytes(range(32, 40)), MemberState.FAILED, 2, 5),
)
SUBJECT = (Guid.of("10.0.0.2", 40002), bytes(range(16, 24)))
ACK = SwimPacket(
    SwimKind.ACK,
    Guid.of("10.0.0.1", 40001, 7),
    bytes(range(16)),
    5,
    42,
    0x0102030405060708,
    3,
    9,
    active=True,
    subject=SUBJECT,
    news=NEWS,
)
SYNC = replace(ACK, kind=SwimKind.SYNC, subject=None, news=(), buckets=tuple(range(64)))
TABLE = replace(ACK, kind=SwimKind.TABLE, subject=None, wanted=1 << 63 | 1)
GOLDEN = [
    (ACK, bytes.fromhex(HEAD.format(kind=17) + "0a0000029c420000 1011121314151617" + NEWS_BYTES)),
    (SYNC, bytes.fromhex(HEAD.format(kind=22) + "".join(f"{n:08x}" for n in range(64)) + "00")),
    (TABLE, bytes.fromhex(HEAD.format(kind=23) + "8000000000000001" + NEWS_BYTES)),
    (replace(ACK, kind=SwimKind.NEWS, subject=None), bytes.fromhex(HEAD.format(kind=21) + NEWS_BYTES)),
]


@pytest.mark.parametrize(("packet", "wire"), GOLDEN, ids=lambda value: getattr(value, "kind", ""))
def test_golden_bytes_both_ways(packet: SwimPacket, wire: bytes) -> None:
    assert packet.serialize() == wire
    assert SwimPacket.parse(wire, 5) == packet
    assert SwimPacket.parse(wire + b"later", 5) == packet


@pytest.mark.parametrize(("packet", "wire"), GOLDEN, ids=lambda value: getattr(value, "kind", ""))
def test_every_shorter_packet_is_malformed(packet: SwimPacket, wire: bytes) -> None:
    for length in range(len(wire)):
        with pytest.raises((SwimMalformed, BeaconMalformed)):
            SwimPacket.parse(wire[:length], 5)


def test_text_is_short_and_safe() -> None:
    assert str(ACK) == "ack 42 of 10.0.0.1:40001#7 about 10.0.0.2:40002#0, 3 news"
    assert str(NEWS[1]) == "suspect 10.0.0.3:40003#1 incarnation 2 version 5"


def test_kinds_are_told_from_beacons() -> None:
    wire = ACK.serialize()
    assert is_swim(wire)
    with pytest.raises(BeaconMalformed):  # as an agent of the first release does with it
        Beacon.parse(wire, 5)
    assert not is_swim(target_swim.SEEDS[0])
    assert not any(is_swim(b"RMPA\x01" + bytes([kind])) for kind in range(16))


def test_what_comes_first_is_told_as_of_beacons() -> None:
    wire = ACK.serialize()
    with pytest.raises(BeaconOtherDomain):
        SwimPacket.parse(wire, 6)
    with pytest.raises(BeaconOtherVersion):
        SwimPacket.parse(wire[:4] + b"\x02" + wire[5:], 5)
    with pytest.raises(LimitExceeded):
        SwimPacket.parse(wire + bytes(1200), 5)


@pytest.mark.parametrize(
    ("offset", "replacement", "problem"),
    [
        (5, b"\x18", "24 is not a valid SwimKind"),
        (8, b"\xe0", "no member can be reached at 224.0.0.1"),
        (69, b"\x29", "ends after"),
        (70, b"\xff", "no member can be reached at 255.0.0.2"),
        (86, b"\x04", "4 is not a valid MemberState"),
    ],
)
def test_malformed(offset: int, replacement: bytes, problem: str) -> None:
    wire = ACK.serialize()
    with pytest.raises(SwimMalformed, match=problem):
        SwimPacket.parse(wire[:offset] + replacement + wire[offset + len(replacement) :], 5)


@pytest.mark.parametrize("kind", SwimKind)
def test_the_fullest_packet_fits_with_the_trailer_of_a_secured_mesh(kind: SwimKind) -> None:
    subject = SUBJECT if kind <= SwimKind.NACK else None
    buckets = tuple(range(64)) if kind is SwimKind.SYNC else ()
    news = (NEWS[0],) * (room_for_news(kind) // NEWS[0].size)
    packet = SwimPacket(kind, ACK.guid, ACK.instance, 5, 1, subject=subject, buckets=buckets, news=news)
    wire = packet.serialize()
    assert len(wire) + TRAILER_BYTES <= limits.BEACON_MAX_BYTES
    assert SwimPacket.parse(wire, 5) == packet


@pytest.mark.parametrize(
    "change",
    [
        {"guid": Guid.of("10.0.0.1", 0)},
        {"subject": None},
        {"kind": SwimKind.NEWS},
        {"buckets": (1, 2)},
        {"digest": 1 << 64},
        {"wanted": -1},
    ],
)
def test_what_cannot_be_written_is_not_made(change: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        replace(ACK, **change)  # type: ignore[arg-type]


@pytest.mark.parametrize("change", [{"run": b"short"}, {"accuser": b""}, {"version": 1 << 32}, {"incarnation": -1}])
def test_news_that_cannot_be_written_is_not_made(change: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        replace(NEWS[1], **change)  # type: ignore[arg-type]


@given(st.binary(max_size=1300))
def test_any_bytes_at_all(data: bytes) -> None:
    target_swim.fuzz(data)
    target_swim.fuzz(target_swim.SEEDS[3][:33] + data)
