"""What stands between the sockets and the parser."""

from __future__ import annotations

import os

from rmpa.core.counters import Counters
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.io.packet_filter import PacketFilter

FRIEND = Identity(Guid.of("10.0.0.2", 4000), b"f" * 16, "friend")


def packet(identity: Identity, sequence: int) -> bytes:
    return Beacon(BeaconKind.HEARTBEAT, identity, 16_000, sequence).serialize()


def forged(number: int) -> bytes:
    guid = Guid.of(f"10.1.{number // 250}.{1 + number % 250}", 4000)
    return packet(Identity(guid, os.urandom(16), "forged"), 1)


def source(number: int) -> tuple[str, int]:
    return f"10.2.{number // 250}.{1 + number % 250}", 4000


class Door:
    """An intake that has a link with one peer."""

    def __init__(self) -> None:
        self.counters = Counters()
        self.intake = PacketFilter(
            0, self.counters, is_linked=lambda guid, run: (guid, run) == (FRIEND.guid, FRIEND.instance)
        )

    def flood(self, count: int, now: float, *, interface: int = 1) -> int:
        """So many forged beacons, each from an address of its own; return how many got in."""
        found = (
            self.intake.parse(forged(n), source(n), now, multicast=True, interface=interface) for n in range(count)
        )
        return sum(beacon is not None for beacon in found)


def test_peers_without_a_link_share_what_an_interface_takes() -> None:
    door = Door()
    assert door.flood(3000, 10.0) == limits.BEACONS_UNLINKED_BURST
    assert door.counters["beacon.unlinked_limited"] == 3000 - limits.BEACONS_UNLINKED_BURST
    assert door.flood(3000, 11.0) == limits.BEACONS_UNLINKED_PER_SECOND
    assert door.flood(10, 11.0, interface=2) == 10, "a flood on one network leaves the others alone"


def test_a_linked_peer_is_heard_through_a_flood() -> None:
    door = Door()
    door.flood(3000, 10.0)
    heard = door.intake.parse(packet(FRIEND, 7), ("10.0.0.2", 4000), 10.0, multicast=True, interface=1)
    assert heard is not None
    assert heard.identity == FRIEND
    again = Identity(FRIEND.guid, b"g" * 16, "friend")
    assert door.intake.parse(packet(again, 8), ("10.0.0.2", 4000), 10.0, multicast=True, interface=1) is None


def test_malformed_packets_are_counted_by_kind_during_a_flood() -> None:
    door = Door()
    door.flood(3000, 10.0)
    good = packet(FRIEND, 9)
    for data in (b"garbage", good[:30], good[:4] + b"\x09" + good[5:], good[:6] + b"\0\1" + good[8:]):
        assert door.intake.parse(data, ("10.3.0.1", 1), 10.0, multicast=True, interface=1) is None
    counted = [door.counters[f"beacon.{name}"] for name in ("malformed", "version", "other_domain")]
    assert counted == [2, 1, 1]


def test_flooding_address_is_ignored_for_the_rest_of_the_second() -> None:
    door = Door()
    taken = [
        door.intake.parse(packet(FRIEND, n), ("10.0.0.2", 4000), 10.0, multicast=True, interface=1)
        for n in range(500)
    ]
    assert sum(beacon is not None for beacon in taken) == limits.BEACONS_PER_SOURCE
    assert door.intake.parse(packet(FRIEND, 501), ("10.0.0.2", 4000), 11.0, multicast=True, interface=1) is not None
