"""The beacon codec: golden bytes, whole, byte by byte, malformed, and anything at all."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa import __version__
from rmpa.core import limits as core_limits
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import Guid, Identity
from rmpa.discovery import limits
from rmpa.discovery.beacon import MALFORMED, OTHER_DOMAIN, OTHER_VERSION, Beacon, BeaconKind, BeaconRefused
from tests.fuzz.readers import READERS

GOLDEN = bytes.fromhex(
    "524d5041 02 03 0005"  # RMPA, version 2, answer, domain 5
    "0a000001 9c41 0007"  # 10.0.0.1:40001#7
    "000102030405060708090a0b0c0d0e0f"
    "00003e80 0000002a"  # lease 16000 ms, sequence 42
    "04 62617365"  # base
    "01 c0a80002"  # 192.168.0.2
    "02 0a0000029c420000 0a0000039c430001"
    "00"
)
BEACON = Beacon(
    BeaconKind.ANSWER,
    Identity(Guid.of("10.0.0.1", 40001, 7), bytes(range(16)), "base", 5, (IPv4Address("192.168.0.2"),)),
    16000,
    42,
    (Guid.of("10.0.0.2", 40002), Guid.of("10.0.0.3", 40003, 1)),
)


def test_golden_bytes_both_ways() -> None:
    assert BEACON.serialize() == GOLDEN
    assert Beacon.parse(GOLDEN, 5) == BEACON


def test_text_is_short_and_safe() -> None:
    assert str(BEACON) == "answer 42 of base (10.0.0.1:40001#7), 2 gossiped"


def test_where_gossiped_peers_are_heard_follows_if_it_is_said() -> None:
    observed = replace(BEACON, observed=(("192.168.7.3", 40003), ("10.9.0.2", 1)))
    wire = GOLDEN[:-1] + bytes.fromhex("02 c0a807039c43 0a0900020001")
    assert observed.serialize() == wire
    assert Beacon.parse(wire, 5) == observed
    assert Beacon.parse(wire + b"later", 5) == observed
    for length in range(len(GOLDEN), len(wire)):
        with pytest.raises(BeaconRefused, match="malformed"):
            Beacon.parse(wire[:length], 5)
    for damaged in ("41 c0a807039c43", "01 e0a807039c43", "01 c0a807030000", "01 000000019c43"):
        with pytest.raises(BeaconRefused, match="malformed"):
            Beacon.parse(GOLDEN[:-1] + bytes.fromhex(damaged), 5)


def test_bytes_behind_are_left_for_later_versions() -> None:
    assert Beacon.parse(GOLDEN + b"\x00later", 5) == BEACON


@pytest.mark.parametrize("length", range(len(GOLDEN)))
def test_every_shorter_packet_is_malformed(length: int) -> None:
    with pytest.raises(BeaconRefused, match="malformed"):
        Beacon.parse(GOLDEN[:length], 5)


def test_the_largest_beacon_fits_a_packet() -> None:
    identity = Identity(
        Guid.of("10.0.0.1", 1), bytes(16), "n" * core_limits.PEER_NAME_MAX, 0, (IPv4Address("10.0.0.2"),) * 8
    )
    most = limits.BEACON_GOSSIP_MAX
    largest = Beacon(BeaconKind.ANSWER, identity, 1, 1, (Guid.of("10.0.0.3", 1),) * most, (("10.0.0.3", 1),) * most)
    wire = largest.serialize()
    assert len(wire) <= limits.BEACON_MAX_BYTES
    assert Beacon.parse(wire, 0) == largest


def test_too_long_a_packet_is_refused_before_anything_else() -> None:
    with pytest.raises(LimitExceeded, match="a beacon of 1201 bytes exceeds the limit of 1200"):
        Beacon.parse(bytes(1201), 5)


def test_another_domain_is_told_first() -> None:
    for data in (GOLDEN, GOLDEN[:4] + b"\x03" + GOLDEN[5:8]):
        with pytest.raises(BeaconRefused, match="is of domain 5") as refused:
            Beacon.parse(data, 6)
        assert refused.value.counter == OTHER_DOMAIN


def test_other_version_is_recognised_by_eight_bytes() -> None:
    text = rf"speaks beacon protocol 3, we speak 2 \(rmpa {__version__}\): install the same release of rmpa on both"
    with pytest.raises(BeaconRefused, match=text) as refused:
        Beacon.parse(GOLDEN[:4] + b"\x03" + GOLDEN[5:8], 5)
    assert refused.value.counter == OTHER_VERSION


@pytest.mark.parametrize(
    ("offset", "replacement", "problem"),
    [
        (0, b"XMPA", "does not begin with RMPA"),
        (5, b"\x00", "0 is not a valid BeaconKind"),
        (5, b"\x05", "5 is not a valid BeaconKind"),
        (8, b"\xe0\x00\x00\x01", "no peer can be reached at 224.0.0.1:40001"),
        (8, b"\xff\xff\xff\xff", "no peer can be reached at 255.255.255.255:40001"),
        (8, b"\x00\x00\x00\x00", "no peer can be reached at 0.0.0.0:40001"),
        (12, b"\x00\x00", "no peer can be reached at 10.0.0.1:0"),
        (40, b"\x00", "malformed"),
        (40, b"\x41", "malformed"),
        (41, b"b\xffse", "malformed"),
        (41, b"b\nse", "not a ROS base name"),
        (41, b"/ase", "not a ROS base name"),
        (45, b"\x09", "ends inside its addresses"),
        (46, b"\xef\x00\x00\x01", "no peer can be reached at 239.0.0.1"),
        (50, b"\x41", "ends inside its gossip"),
        (50, b"\x03", "ends inside its gossip"),
        (51, b"\xe0", "no gossiped peer"),
        (55, b"\x00\x00", "no gossiped peer"),
    ],
)
def test_malformed(offset: int, replacement: bytes, problem: str) -> None:
    with pytest.raises(BeaconRefused, match=problem) as refused:
        Beacon.parse(GOLDEN[:offset] + replacement + GOLDEN[offset + len(replacement) :], 5)
    assert refused.value.counter == MALFORMED


@pytest.mark.parametrize(
    "counted",
    ["09 " + "c0a80002" * 9 + "00 00", "00 41 " + "0a0000029c420000" * 65 + "00", "00 00 41" + "0a0000029c42" * 65],
)
def test_more_than_a_beacon_may_carry_is_malformed(counted: str) -> None:
    with pytest.raises(BeaconRefused, match="carries at most"):
        Beacon.parse(GOLDEN[:45] + bytes.fromhex(counted), 5)


@pytest.mark.parametrize(
    "change",
    [
        {"lease_ms": -1},
        {"lease_ms": 1 << 32},
        {"sequence": 1 << 32},
        {"gossip": (Guid.of("10.0.0.1", 1),) * 65},
        {"observed": (("10.0.0.1", 1),) * 65},
        {"observed": (("224.0.0.1", 1),)},
    ],
)
def test_what_cannot_be_written_is_not_made(change: dict[str, object]) -> None:
    values = {"kind": BEACON.kind, "identity": BEACON.identity, "lease_ms": 1, "sequence": 1, "gossip": ()} | change
    with pytest.raises(ValueError):
        Beacon(**values)  # type: ignore[arg-type]


names = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,63}", fullmatch=True)
unicast = st.integers(1 << 24, (224 << 24) - 1).map(IPv4Address)
guids = st.builds(Guid.of, unicast, st.integers(1, 0xFFFF), st.integers(0, 0xFFFF))
u32 = st.integers(0, 0xFFFFFFFF)
identities = st.builds(
    Identity,
    guids,
    st.binary(min_size=16, max_size=16),
    names,
    st.integers(0, core_limits.DOMAIN_MAX),
    st.lists(unicast, max_size=8).map(tuple),
)
beacons = st.builds(
    Beacon,
    st.sampled_from(BeaconKind),
    identities,
    u32,
    u32,
    st.lists(guids, max_size=6).map(tuple),
    st.lists(st.tuples(unicast.map(str), st.integers(1, 0xFFFF)), max_size=6).map(tuple),
)


@given(beacons)
def test_every_beacon_survives(beacon: Beacon) -> None:
    assert Beacon.parse(beacon.serialize(), beacon.identity.domain) == beacon


@given(st.binary(max_size=1300))
def test_anything_is_a_beacon_or_the_peers_fault(data: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        Beacon.parse(data, 0)


@given(beacons, st.data())
def test_a_damaged_beacon_is_a_beacon_or_the_peers_fault(beacon: Beacon, data: st.DataObject) -> None:
    wire = bytearray(beacon.serialize())
    for _ in range(data.draw(st.integers(1, 4))):
        wire[data.draw(st.integers(0, len(wire) - 1))] = data.draw(st.integers(0, 255))
    READERS["beacon"].fuzz(bytes(wire))
