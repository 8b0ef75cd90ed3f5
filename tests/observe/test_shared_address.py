"""Two machines with one IP address, as a third one sees them."""

from __future__ import annotations

import msgspec
import pytest

from rmpa.discovery import limits
from rmpa.observe.snapshot import PeerInfo
from rmpa.observe.snapshot_builder import ADDRESS_SHARED_MARGIN, mark_shared_addresses


def peer(name: str, guid: str, state: str = "linking", since: float = 30.0, beacon: float | None = 2.0) -> PeerInfo:
    return PeerInfo(name=name, guid=guid, instance=name * 32, state=state, since_ago=since, beacon_ago=beacon)


B = peer("b", "10.0.0.2:40001#1", "linked")
C = peer("c", "10.0.0.2:38211#1")


def test_a_peer_behind_anothers_address_is_in_conflict() -> None:
    b, c = mark_shared_addresses([B, C], {"10.0.0.1"})
    assert b == B
    assert c.state == "conflict"
    assert len(c.conflicts) == 1
    assert c.conflicts[0].startswith(
        "its address 10.0.0.2 is also that of peer b, and its port 38211 does not answer there: two machines seem to "
        "have one address; give one of them another"
    )


def test_both_are_in_conflict_while_neither_is_linked() -> None:
    found = mark_shared_addresses([msgspec.structs.replace(B, state="linking"), C], set())
    assert [one.state for one in found] == ["conflict", "conflict"]


def test_this_machines_own_address() -> None:
    (c,) = mark_shared_addresses([C], {"10.0.0.2"})
    assert "also that of this machine" in c.conflicts[0]


@pytest.mark.parametrize(
    "other",
    [
        peer("c", "10.0.0.3:38211#1"),
        peer("c", "10.0.0.2:38211#1", "linked"),
        peer("c", "10.0.0.2:38211#1", "refused"),
        peer("c", "10.0.0.2:38211#1", since=limits.ADDRESS_SHARED_AFTER / 2),
        peer("killed", "10.0.0.2:38211#1", since=10.0, beacon=12.0),
        peer("killed", "10.0.0.2:38211#1", since=10.0, beacon=10.0 - ADDRESS_SHARED_MARGIN),
        peer("unheard", "10.0.0.2:38211#1", beacon=None),
    ],
)
def test_no_conflict(other: PeerInfo) -> None:
    assert mark_shared_addresses([B, other], {"10.0.0.1"}) == (B, other)


def test_agents_on_loopback_share_their_address_rightly() -> None:
    peers = (peer("b", "127.0.0.1:1#1", "linked"), peer("c", "127.0.0.1:2#1"))
    assert mark_shared_addresses(peers, set()) == peers
