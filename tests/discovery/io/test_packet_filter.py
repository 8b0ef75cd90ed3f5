"""What stands between the sockets and the parser."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from rmpa.core.identity import Guid, Identity
from rmpa.core.statistics import Counters
from rmpa.discovery import limits
from rmpa.discovery.beacon import STRANGER_KEPT, Beacon, BeaconKind, PacketFilter
from rmpa.discovery.discovery import BEACONS_UNPROVED_PAUSE
from rmpa.trust import limits as trust_limits
from rmpa.trust.packets import GroupKey, KeyRing, PacketTrust
from rmpa.trust.permissions import TrustReason

if TYPE_CHECKING:
    import pytest

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
            0, self.counters, is_verified=lambda guid, run: (guid, run) == (FRIEND.guid, FRIEND.instance)
        )

    def flood(self, count: int, now: float, *, interface: int = 1) -> int:
        """So many forged beacons, each from an address of its own; return how many got in."""
        found = (
            self.intake.parse(forged(n), source(n), now, multicast=True, interface=interface) for n in range(count)
        )
        return sum(beacon is not None for beacon in found)


def test_peers_without_a_link_share_what_an_interface_takes() -> None:
    door = Door()
    assert door.flood(6000, 10.0) == limits.BEACONS_UNLINKED_BURST
    assert door.counters["beacon.unlinked_limited"] == 6000 - limits.BEACONS_UNLINKED_BURST
    assert door.flood(3000, 11.0) == limits.BEACONS_UNLINKED_PER_SECOND
    assert door.flood(10, 11.0, interface=2) == 10, "a flood on one network leaves the others alone"


def test_a_linked_peer_is_heard_through_a_flood() -> None:
    door = Door()
    door.flood(6000, 10.0)
    heard = door.intake.parse(packet(FRIEND, 7), ("10.0.0.2", 4000), 10.0, multicast=True, interface=1)
    assert heard is not None
    assert heard[0].identity == FRIEND
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


WALL = 1_790_000_000.0
RING = KeyRing([GroupKey(1, b"k" * 32)], 0.0)


class SecuredDoor:
    """An intake of a secured mesh, and a member that sends."""

    def __init__(self) -> None:
        self.counters = Counters()
        self._signer = PacketTrust(RING, lambda: WALL)
        self.intake = PacketFilter(0, self.counters, trust=PacketTrust(RING, lambda: WALL))

    def signed(self, sequence: int, wall: float = WALL) -> bytes:
        beacon = Beacon(BeaconKind.HEARTBEAT, FRIEND, 16_000, sequence)
        self._signer.wall = lambda: wall
        return self._signer.sign(beacon.serialize(), 10.0)

    def hears(self, data: bytes, host: str = "10.0.0.2", now: float = 10.0) -> bool:
        return self.intake.parse(data, (host, 4000), now, multicast=True, interface=1) is not None


def test_a_secured_mesh_hears_its_members_once() -> None:
    door = SecuredDoor()
    first = door.signed(1)
    assert door.hears(first)
    assert not door.hears(first)
    assert door.hears(door.signed(2))
    assert door.counters["beacon.repeated"] == 1
    assert door.counters["beacon.in"] == 2


def test_a_secured_mesh_hears_nothing_else() -> None:
    door = SecuredDoor()
    foreign = PacketTrust(KeyRing([GroupKey(1, b"x" * 32)], 0.0), lambda: WALL)
    body = Beacon(BeaconKind.ANNOUNCE, FRIEND, 16_000, 1).serialize()
    newer = PacketTrust(KeyRing([GroupKey(2, b"x" * 32)], 0.0), lambda: WALL)
    for data, reason in (
        (packet(FRIEND, 1), "untagged"),
        (foreign.sign(body, 10.0), "forged"),
        (newer.sign(body, 10.0), "unknown_key"),
        (door.signed(1, WALL - 3600), "clock"),
        (bytes(2000), "malformed"),
    ):
        assert not door.hears(data)
        assert door.counters[f"beacon.{reason}"] == 1
    assert door.counters["beacon.in"] == 0


class RotatedDoor:
    """An intake of a mesh that has a new group key; others have only the key before."""

    def __init__(self) -> None:
        ring = KeyRing([GroupKey(1, b"k" * 32), GroupKey(2, b"n" * 32)], 0.0)
        self.counters = Counters()
        self.member, self.old = PacketTrust(ring, lambda: WALL), PacketTrust(RING, lambda: WALL)
        self.intake = PacketFilter(0, self.counters, trust=PacketTrust(ring, lambda: WALL))

    def found(
        self, signer: PacketTrust, number: int, now: float, host: str = "10.0.0.2"
    ) -> tuple[Beacon, int | None] | None:
        beacon = Beacon(BeaconKind.HEARTBEAT, FRIEND, 16_000, number).serialize()
        data = signer.sign(beacon, now)
        return self.intake.parse(data, (host, 4000), now, multicast=True, interface=1)


def test_a_module_with_an_older_group_key_is_recognised_and_counts_for_no_limit() -> None:
    """It was away, or it was revoked; it sends more than a member may, from a member's address."""
    door = RotatedDoor()
    recognised = [door.found(door.old, n, 10.0 + n / 1000) for n in range(1000)]
    assert {each and each[1] for each in recognised} == {1, None}
    assert door.found(door.member, 7, 11.0) == (Beacon(BeaconKind.HEARTBEAT, FRIEND, 16_000, 7), None)
    assert door.counters["beacon.in"] == 1
    assert door.counters["beacon.flood"] == door.counters["beacon.unlinked_limited"] == 0


def test_one_address_does_not_use_up_the_answers_of_all_modules_that_were_away() -> None:
    door = RotatedDoor()
    for n in range(1000):
        now = 10.0 + n / 1000
        door.found(door.old, n, now, "10.0.0.66")
        if n % 100 == 0:
            assert door.found(door.old, n, now, f"10.0.1.{n // 100}")
    assert door.counters["beacon.old_key"] == trust_limits.OLD_KEY_PACKETS_PER_ADDRESS + 10
    assert door.counters["beacon.limited"] == 1000 - trust_limits.OLD_KEY_PACKETS_PER_ADDRESS
    assert door.found(door.old, 1, 11.0, "10.0.0.66"), "it may have been away, too"


def test_all_modules_that_were_away_are_recognised_at_a_low_rate() -> None:
    door = RotatedDoor()
    for now in (10.0, 11.0):
        found = [door.found(door.old, n, now, f"10.0.0.{n}") for n in range(200)]
        assert sum(each is not None for each in found) == trust_limits.OLD_KEY_PACKETS_RATE


def test_a_flood_under_the_address_of_a_member_does_not_silence_it() -> None:
    door = SecuredDoor()
    forged_beacon = packet(FRIEND, 1) + bytes(32)
    for _ in range(2 * limits.BEACONS_PER_SOURCE):
        assert not door.hears(forged_beacon)
    assert door.hears(door.signed(1))
    assert door.counters["beacon.flood"] == 0


def test_more_forged_packets_than_can_be_looked_at_ask_for_a_pause() -> None:
    door = SecuredDoor()
    forged_beacon = packet(FRIEND, 1) + bytes(32)
    asked = []
    for _ in range(2 * limits.BEACONS_UNPROVED_BURST):
        door.hears(forged_beacon)
        asked.append(door.intake.overrun)
    assert asked.index(True) == limits.BEACONS_UNPROVED_BURST
    door.hears(forged_beacon, now=10.0 + BEACONS_UNPROVED_PAUSE)
    assert not door.intake.overrun, "the pause is over"


def test_refused_packets_are_logged_with_what_to_do(caplog: pytest.LogCaptureFixture) -> None:
    door = SecuredDoor()
    door.hears(packet(FRIEND, 1))
    door.hears(door.signed(1, WALL + 60))
    texts = [record.getMessage() for record in caplog.records]
    assert "friend at 10.0.0.2 is not of this mesh" in texts[0]
    assert "rmpa trust join TOKEN there" in texts[0]
    assert "60 s ahead of ours" in texts[1]
    (shown,) = door.intake.strangers(10.0)
    assert shown.identity == FRIEND
    assert "60 s ahead of ours" in shown.problem, "the last word on it"


def test_a_stranger_has_the_reason_of_its_last_beacon_and_goes_with_a_goodbye() -> None:
    door = SecuredDoor()
    door.hears(packet(FRIEND, 1))
    body = packet(FRIEND, 2)
    for data, reason in (
        (body, TrustReason.UNSECURED),
        (PacketTrust(KeyRing([GroupKey(1, b"x" * 32)], 0.0), lambda: WALL).sign(body, 10.0), TrustReason.FOREIGN),
        (PacketTrust(KeyRing([GroupKey(9, b"x" * 32)], 0.0), lambda: WALL).sign(body, 10.0), TrustReason.KEY),
        (door.signed(1, WALL + 60), None),
    ):
        door.hears(data, now=12.0)
        (shown,) = door.intake.strangers(12.0)
        assert (shown.reason, shown.since, shown.heard) == (reason, 10.0, 12.0)
    door.hears(Beacon(BeaconKind.GOODBYE, FRIEND, 16_000, 3).serialize())
    assert not door.intake.strangers(12.0)


def test_one_with_a_group_key_from_before_a_revocation_is_remembered_for_the_deny_list() -> None:
    door = RotatedDoor()
    assert door.found(door.old, 1, 10.0)
    (shown,) = door.intake.strangers(10.0)
    assert (shown.identity, shown.reason, shown.problem) == (FRIEND, TrustReason.REVOKED, "")
    assert not door.intake.strangers(10.1 + STRANGER_KEPT)


def test_a_packet_that_is_no_beacon_of_this_domain_is_not_told_of(caplog: pytest.LogCaptureFixture) -> None:
    """`rmpa doctor` sends such a packet to look whether multicast comes back."""
    door = SecuredDoor()
    other = Identity(FRIEND.guid, FRIEND.instance, "friend", domain=7)
    for data in (packet(other, 1), packet(FRIEND, 1)[:20] + bytes(60)):
        assert not door.hears(data)
    assert door.counters["beacon.untagged"] == 2
    assert not caplog.records
    assert not door.intake.strangers(10.0)


def test_strangers_fill_no_table_and_no_time(caplog: pytest.LogCaptureFixture) -> None:
    door = SecuredDoor()
    assert not door.hears(packet(FRIEND, 1))
    for n in range(5000):
        assert not door.hears(forged(n), host=f"10.9.{n // 250}.{n % 250}", now=10.0 + n / 1000)
    shown = door.intake.strangers(15.0)
    assert shown[0].identity == FRIEND, "one that was there before stays"
    assert len(shown) == limits.STRANGERS_SHOWN
    assert len(caplog.records) < limits.STRANGERS_SHOWN
    note = door.intake.strangers_note(15.0)
    assert f"{len(shown)} modules that are not of this mesh are shown, which is the most" in note
    assert not door.intake.strangers_note(15.0 + STRANGER_KEPT)
    assert not door.intake.strangers(15.0 + STRANGER_KEPT)
