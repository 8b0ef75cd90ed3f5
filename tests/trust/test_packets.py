"""The trailer of packets: golden bytes, damage in every byte, rotation, clocks, repeats."""

from __future__ import annotations

import hashlib
import hmac
from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core import limits as core_limits
from rmpa.core.identity import Guid, Identity
from rmpa.discovery import limits as discovery_limits
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.trust import limits
from rmpa.trust.packets import (
    TRAILER_BYTES,
    GroupKey,
    KeyRing,
    PacketTrust,
    Verdict,
    Verification,
)

KEY = GroupKey(3, bytes(range(32)))
RUN = (16, 32)
WALL = 1_790_000_000.5
NOW = 50.0
BEACON = Beacon(
    BeaconKind.HEARTBEAT, Identity(Guid.of("10.0.0.1", 40001, 7), bytes(range(16)), "base", 5), 16000, 42
).serialize()
GOLDEN_TAG = "f640dd86c92a0b701f540511ba2915e6"
"""As ``openssl dgst -sha256 -mac HMAC`` computes it, of 32 zero bytes and the trailer's begin."""
HEAD = "01 01 0003 0000000000000001 6ab13b80"  # format, clock set, key 3, number 1, 1790000000


def _trust(*keys: GroupKey, wall: float | None = WALL) -> PacketTrust:
    return PacketTrust(KeyRing(keys or (KEY,), 0.0), lambda: wall)


def _verify(verifier: PacketTrust, data: bytes, wall: float | None = WALL, now: float = NOW) -> Verification:
    verifier.wall = lambda: wall
    return verifier.verify(data, RUN, now)


def test_golden_bytes_both_ways() -> None:
    body = BEACON + bytes.fromhex(HEAD)
    key = hmac.new(bytes(range(32)), b"rmpa beacon 1", hashlib.sha256).digest()
    tag = hmac.new(key, body, hashlib.sha256).digest()[:16]
    signed = _trust().sign(BEACON, NOW)
    assert signed == body + tag
    assert len(signed) == len(BEACON) + TRAILER_BYTES
    assert _verify(_trust(), signed) == Verification(Verdict.ACCEPTED, len(BEACON), 0)


def test_the_tag_itself_is_golden() -> None:
    assert _trust(wall=None).sign(bytes(32), NOW)[-32:].hex() == (
        "010000030000000000000001" + "00000000" + GOLDEN_TAG
    )


def test_a_reader_without_trust_ignores_the_trailer() -> None:
    # The count of observed addresses in front of it is written even where it is 0: docs/design/trust.md.
    signed = _trust().sign(BEACON + b"\x00", NOW)
    assert Beacon.parse(signed, 5).serialize() == BEACON


def test_the_largest_beacon_fits_with_its_trailer() -> None:
    identity = Identity(
        Guid.of("10.0.0.1", 1), bytes(16), "n" * core_limits.PEER_NAME_MAX, 0, (IPv4Address("10.0.0.2"),) * 8
    )
    most = discovery_limits.BEACON_GOSSIP_MAX
    largest = Beacon(BeaconKind.ANSWER, identity, 1, 1, (Guid.of("10.0.0.3", 1),) * most, (("10.0.0.3", 1),) * most)
    assert len(largest.serialize()) + TRAILER_BYTES <= discovery_limits.BEACON_MAX_BYTES


def test_every_changed_byte_is_noticed() -> None:
    signed = _trust().sign(BEACON, NOW)
    for offset in range(len(signed)):
        changed = signed[:offset] + bytes([signed[offset] ^ 1]) + signed[offset + 1 :]
        verdict = _verify(_trust(), changed).verdict
        assert verdict in {Verdict.FORGED, Verdict.UNTAGGED, Verdict.UNKNOWN_KEY}, offset


def test_every_shorter_packet_is_refused() -> None:
    signed = _trust().sign(BEACON, NOW)
    for length in range(len(signed)):
        assert _verify(_trust(), signed[:length]).verdict is not Verdict.ACCEPTED


def test_a_plain_packet_is_untagged_or_forged() -> None:
    assert _verify(_trust(), BEACON).verdict is Verdict.UNTAGGED
    assert _verify(_trust(), BEACON + bytes(TRAILER_BYTES)).verdict is Verdict.UNTAGGED


def test_the_key_of_another_mesh_is_refused() -> None:
    signed = _trust().sign(BEACON, NOW)
    assert _verify(_trust(GroupKey(3, bytes(32))), signed).verdict is Verdict.FORGED
    assert _verify(_trust(GroupKey(4, KEY.secret)), signed).verdict is Verdict.UNKNOWN_KEY


def test_a_packet_is_accepted_once() -> None:
    signer, verifier = _trust(), _trust()
    packets = [signer.sign(BEACON, NOW) for _ in range(100)]
    assert _verify(verifier, packets[99]).verdict is Verdict.ACCEPTED
    assert _verify(verifier, packets[99]).verdict is Verdict.REPEATED
    assert _verify(verifier, packets[90]).verdict is Verdict.ACCEPTED
    assert _verify(verifier, packets[0]).verdict is Verdict.REPLAYED


@pytest.mark.parametrize(
    ("sent", "heard", "verdict", "skew"),
    [
        (WALL, WALL + 29, Verdict.ACCEPTED, -29),
        (WALL, WALL + 32, Verdict.CLOCK, -32),
        (WALL + 3600, WALL, Verdict.CLOCK, 3600),
        (None, WALL, Verdict.ACCEPTED, 0),
        (WALL, None, Verdict.ACCEPTED, 0),
        (2.0**32 + 3, 2.0**32 - 3, Verdict.ACCEPTED, 6),
        (5.0, WALL, Verdict.CLOCK, 5 - 1_790_000_000),
    ],
)
def test_clocks_that_are_set_must_agree(sent: float | None, heard: float | None, verdict: Verdict, skew: int) -> None:
    signed = _trust(wall=sent).sign(BEACON, NOW)
    found = _verify(_trust(), signed, heard)
    assert (found.verdict, found.skew) == (verdict, skew)


def test_what_is_refused_leaves_nothing_behind() -> None:
    signer, verifier = _trust(), _trust()
    first = signer.sign(BEACON, NOW)
    forged = first[:-1] + bytes([first[-1] ^ 1])
    for _ in range(3):
        assert _verify(verifier, forged).verdict is Verdict.FORGED
        assert _verify(verifier, first, WALL + 100).verdict is Verdict.CLOCK
    assert len(verifier._window) == 0
    assert _verify(verifier, first).verdict is Verdict.ACCEPTED


def _numbered(signer: PacketTrust, number: int) -> bytes:
    """A packet of this number, which a module with the group key can make for any run."""
    signer._number = number - 1
    return signer.sign(BEACON, NOW)


def test_a_revoked_module_cannot_silence_the_run_of_a_member() -> None:
    """It has the key before, which only recognises from the revocation on, and claims the highest number."""
    revoked, present = KeyRing([KEY], 0.0), KeyRing([KEY], 0.0)
    following = GroupKey(4, b"k" * 32)
    present.take([following], 1.0, proves_from=4)
    member, verifier = PacketTrust(present, lambda: WALL), PacketTrust(present, lambda: WALL)
    for now in (1.0, limits.KEY_SPREAD, limits.KEY_SPREAD + limits.KEY_OVERLAP + 1):
        forged = _numbered(PacketTrust(revoked, lambda: WALL), (1 << 64) - 1 - int(now))
        assert _verify(verifier, forged, now=now).verdict in {Verdict.OLD_KEY, Verdict.REPLAYED}
        signed = member.sign(BEACON, now)
        assert _verify(verifier, signed, now=now).verdict is Verdict.ACCEPTED


def test_a_member_cannot_silence_another_run_by_one_packet() -> None:
    verifier, member = _trust(), _trust()
    assert _verify(verifier, _numbered(member, 1)).verdict is Verdict.ACCEPTED
    assert _verify(verifier, _numbered(_trust(), (1 << 64) - 1)).verdict is Verdict.LEAP
    assert _verify(verifier, _numbered(member, 2)).verdict is Verdict.ACCEPTED


def test_packets_with_old_keys_push_no_run_out() -> None:
    verifier = PacketTrust(KeyRing([KEY, GroupKey(4, b"k" * 32)], 0.0), lambda: WALL)
    fresh = _trust(GroupKey(4, b"k" * 32)).sign(BEACON, NOW)
    assert _verify(verifier, fresh).verdict is Verdict.ACCEPTED
    for number in range(limits.RUNS_MAX):
        run = number.to_bytes(len(BEACON), "little")
        old = _trust(KEY).sign(run, NOW)
        verifier.verify(old, (0, 16), NOW + number)
    assert _verify(verifier, fresh).verdict is Verdict.REPEATED


def test_old_packets_take_nothing_from_modules_that_were_away() -> None:
    """Repeated, or with an old time, by something without any key."""
    verifier = PacketTrust(KeyRing([KEY, GroupKey(4, b"k" * 32)], 0.0), lambda: WALL)
    away = _trust(KEY)
    first = away.sign(BEACON, NOW)
    assert _verify(verifier, first).verdict is Verdict.OLD_KEY
    for _ in range(20):
        assert _verify(verifier, first).verdict is Verdict.REPEATED
        assert _verify(verifier, first, WALL + 60).verdict is Verdict.CLOCK
    assert _verify(verifier, away.sign(BEACON, NOW)).verdict is Verdict.OLD_KEY


@given(st.binary(max_size=300))
def test_anything_at_all_is_refused(data: bytes) -> None:
    assert _verify(_trust(), data).verdict is not Verdict.ACCEPTED


@given(st.binary(min_size=32, max_size=300), st.floats(0, 2**33))
def test_what_is_signed_is_accepted(packet: bytes, wall: float) -> None:
    signed = _trust(wall=wall).sign(packet, NOW)
    assert _verify(_trust(), signed, wall) == Verification(Verdict.ACCEPTED, len(packet), 0)
