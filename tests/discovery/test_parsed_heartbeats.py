"""Heartbeats of which only the number is new, and those that must be parsed."""

from __future__ import annotations

import os
from dataclasses import replace
from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core import limits as core_limits
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.parsed_heartbeats import ParsedHeartbeats

BASE = Identity(Guid.of("10.0.0.1", 40001, 7), bytes(range(16)), "base", 3, (IPv4Address("10.1.0.1"),))
HEARTBEAT = Beacon(BeaconKind.HEARTBEAT, BASE, 15000, 1)


def kept(beacon: Beacon, trailer: bytes = b"") -> ParsedHeartbeats:
    found = ParsedHeartbeats(len(trailer))
    found.keep(beacon.serialize(extended=bool(trailer)) + trailer, beacon)
    return found


@given(
    st.integers(0, 0xFFFFFFFF),
    st.lists(st.integers(1, 200).map(lambda n: Guid.of(f"10.0.0.{n}", 40000)), max_size=5).map(tuple),
    st.lists(st.tuples(st.integers(1, 200).map(lambda n: f"10.9.0.{n}"), st.integers(1, 65535)), max_size=5).map(
        tuple
    ),
    st.sampled_from([b"", bytes(32)]),
)
def test_another_number_gives_what_parsing_gives(
    number: int, gossip: tuple[Guid, ...], observed: tuple[tuple[str, int], ...], trailer: bytes
) -> None:
    first = replace(HEARTBEAT, gossip=gossip, observed=observed)
    packet = replace(first, sequence=number).serialize(extended=bool(trailer)) + trailer
    assert kept(first, trailer).find(packet) == Beacon.parse(packet, BASE.domain)


def test_the_proof_of_a_secured_mesh_may_be_another_one() -> None:
    packet = replace(HEARTBEAT, sequence=2).serialize(extended=True)
    assert kept(HEARTBEAT, os.urandom(32)).find(packet + os.urandom(32)) == replace(HEARTBEAT, sequence=2)


@pytest.mark.parametrize(
    "other",
    [
        replace(HEARTBEAT, kind=BeaconKind.GOODBYE),
        replace(HEARTBEAT, lease_ms=15001),
        replace(HEARTBEAT, identity=replace(BASE, guid=Guid.of("10.0.0.2", 40001, 7))),
        replace(HEARTBEAT, identity=replace(BASE, instance=bytes(16))),
        replace(HEARTBEAT, identity=replace(BASE, name="bass")),
        replace(HEARTBEAT, identity=replace(BASE, domain=4)),
        replace(HEARTBEAT, identity=replace(BASE, addresses=())),
        replace(HEARTBEAT, gossip=(Guid.of("10.0.0.9", 40001),)),
    ],
)
def test_any_other_difference_is_parsed(other: Beacon) -> None:
    assert kept(HEARTBEAT).find(other.serialize()) is None


def test_every_cut_of_a_packet_is_parsed() -> None:
    packet = HEARTBEAT.serialize()
    heartbeats = kept(HEARTBEAT)
    assert all(heartbeats.find(packet[:end]) is None for end in range(len(packet)))
    assert heartbeats.find(packet + b"\0") is None


def test_only_heartbeats_are_kept() -> None:
    for kind in set(BeaconKind) - {BeaconKind.HEARTBEAT}:
        assert not len(kept(replace(HEARTBEAT, kind=kind)))


def test_the_number_of_kept_heartbeats_is_bounded() -> None:
    heartbeats = ParsedHeartbeats()
    for number in range(5 * core_limits.PEERS_MAX):
        one = replace(HEARTBEAT, identity=replace(BASE, instance=number.to_bytes(16, "big")))
        heartbeats.keep(one.serialize(), one)
        assert len(heartbeats) <= 2 * core_limits.PEERS_MAX
