"""Tags of packets: keys, and packets that come again."""

from __future__ import annotations

import hashlib
import hmac
from ipaddress import IPv4Address

import msgspec
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
    ReplayWindow,
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


def key(number: int) -> GroupKey:
    return GroupKey(number, bytes([number & 0xFF]) * 32)


def test_a_tag_is_made_by_the_key_of_its_purpose() -> None:
    derived = hmac.new(b"\x01" * 32, b"rmpa beacon 1", hashlib.sha256).digest()
    assert key(1).tag(b"packet") == hmac.new(derived, b"packet", hashlib.sha256).digest()[:16]


def test_secrets_are_never_shown() -> None:
    secret = b"secret".ljust(32, b"!")
    shown = repr(GroupKey(1, secret)) + str(GroupKey(1, secret)) + repr(KeyRing([GroupKey(1, secret)], 0.0))
    assert "secret" not in shown
    assert shown.endswith("KeyRing([1])")


@pytest.mark.parametrize(("number", "secret"), [(0, bytes(32)), (1 << 32, bytes(32)), (1, bytes(31)), (1, b"")])
def test_a_key_that_cannot_be_is_refused(number: int, secret: bytes) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"number": number, "key": secret}, GroupKey)


def test_a_ring_needs_a_key() -> None:
    with pytest.raises(ValueError, match="at least one"):
        KeyRing([], 0.0)


def test_the_newest_key_of_the_files_signs_at_once() -> None:
    ring = KeyRing([key(2), key(1)], 100.0)
    assert ring.signing(100.0) == ring.newest == key(2)
    assert ring.verifies(key(2), 1e9)
    assert not ring.verifies(key(1), 100.0)
    assert ring.find(1) == key(1)


def test_two_keys_verify_during_a_rotation() -> None:
    ring = KeyRing([key(1)], 0.0)
    ring.take([key(2)], 10.0)
    signs = 10.0 + limits.KEY_SPREAD
    assert ring.signing(signs - 0.1) == key(1)
    assert ring.signing(signs) == key(2)
    for now in (10.0, signs, signs + limits.KEY_OVERLAP):
        assert ring.verifies(key(1), now)
        assert ring.verifies(key(2), now)
    assert not ring.verifies(key(1), signs + limits.KEY_OVERLAP + 0.1)
    assert ring.find(1) == key(1)


def test_after_a_revocation_the_new_key_signs_and_older_ones_recognise_at_once() -> None:
    ring = KeyRing([key(1)], 0.0)
    ring.take([key(2)], 5.0)
    ring.take([key(2), key(3)], 10.0, proves_from=3)
    assert ring.signing(10.0) == key(3)
    assert not ring.verifies(key(1), 10.0)
    assert not ring.verifies(key(2), 10.0)
    assert ring.find(2) == key(2)


def test_a_member_that_was_away_during_two_rotations_takes_the_revocation_among_them() -> None:
    ring = KeyRing([key(1)], 0.0)
    ring.take([key(1), key(2), key(3)], 10.0, proves_from=2, age=limits.KEY_SPREAD - 10)
    assert not ring.verifies(key(1), 10.0)
    assert ring.signing(10.0) == key(2)
    assert ring.signing(20.0) == key(3)


def test_members_that_learn_a_key_at_different_times_understand_each_other() -> None:
    early, late = KeyRing([key(1)], 0.0), KeyRing([key(1)], 0.0)
    early.take([key(2)], 0.0)
    late.take([key(2)], limits.KEY_SPREAD - 1)
    for now in (0.0, 29.0, 31.0, 60.0, 600.0):
        for sender, receiver in ((early, late), (late, early)):
            signing = sender.signing(now)
            if now < limits.KEY_SPREAD - 1 and receiver is late:
                assert signing == key(1)
            assert receiver.verifies(signing, now)


def test_an_older_or_known_key_is_ignored() -> None:
    ring = KeyRing([key(5)], 0.0)
    ring.take([key(5), key(4)], 1.0, proves_from=5)
    assert ring.keys == (key(5),)


def test_the_oldest_key_is_forgotten() -> None:
    ring = KeyRing([key(1)], 0.0)
    for number in range(2, 20):
        ring.take([key(number)], float(number))
    assert [k.number for k in ring.keys] == list(range(20 - limits.KEYS_MAX, 20))
    assert ring.find(1) is None


def test_of_equal_low_bits_the_newest_key_is_meant() -> None:
    ring = KeyRing([key(1), GroupKey(0x10001, bytes(32))], 0.0)
    assert ring.find(1) == GroupKey(0x10001, bytes(32))


A_RUN = (1, bytes(16))
BEGIN = 5.0


def test_what_is_behind_the_window_is_stale() -> None:
    window = ReplayWindow()
    window.take(A_RUN, 1000, BEGIN)
    assert window.take(A_RUN, 1001 - limits.REPLAY_WINDOW, BEGIN) is Verdict.ACCEPTED
    assert window.take(A_RUN, 1000 - limits.REPLAY_WINDOW, BEGIN) is Verdict.REPLAYED
    assert window.take(A_RUN, 0, BEGIN) is Verdict.REPLAYED


def test_zero_is_never_new() -> None:
    assert ReplayWindow().take(A_RUN, 0, BEGIN) is Verdict.REPLAYED


def test_the_highest_number_leaves_nothing_above_it() -> None:
    window = ReplayWindow()
    assert window.take(A_RUN, (1 << 64) - 1, BEGIN) is Verdict.ACCEPTED
    assert window.take(A_RUN, (1 << 64) - 1, BEGIN) is Verdict.REPEATED
    assert window.take(A_RUN, 1, BEGIN) is Verdict.REPLAYED


def test_a_leap_is_refused_and_leaves_nothing_behind() -> None:
    window = ReplayWindow()
    window.take(A_RUN, 10, BEGIN)
    assert window.take(A_RUN, (1 << 64) - 1, BEGIN) is Verdict.LEAP
    assert window.take(A_RUN, 11 + limits.REPLAY_LEAP, BEGIN) is Verdict.LEAP
    assert window.take(A_RUN, 11, BEGIN) is Verdict.ACCEPTED
    assert window.take(A_RUN, 11 + limits.REPLAY_LEAP, BEGIN) is Verdict.ACCEPTED


def test_a_run_that_was_out_of_reach_for_days_is_heard_again() -> None:
    window, days = ReplayWindow(), 3 * 86_400
    window.take(A_RUN, 1, BEGIN)
    assert window.take(A_RUN, 600 * days, BEGIN + days) is Verdict.ACCEPTED


def test_each_group_key_has_numbers_of_its_own() -> None:
    window = ReplayWindow()
    assert window.take((1, A_RUN[1]), (1 << 64) - 1, BEGIN) is Verdict.ACCEPTED
    assert window.take((2, A_RUN[1]), 7, BEGIN) is Verdict.ACCEPTED


def test_runs_are_apart_and_the_silent_one_is_forgotten() -> None:
    window = ReplayWindow(2)
    runs = [(1, bytes([n]) * 16) for n in range(3)]
    for run in runs[:2]:
        assert window.take(run, 7, BEGIN) is Verdict.ACCEPTED
    window.take(runs[0], 8, BEGIN)
    assert window.take(runs[2], 7, BEGIN) is Verdict.ACCEPTED
    assert len(window) == 2
    assert window.take(runs[0], 8, BEGIN) is Verdict.REPEATED
    assert window.take(runs[1], 7, BEGIN) is Verdict.ACCEPTED  # it was forgotten


@given(st.lists(st.integers(1, 200), max_size=100))
def test_beside_a_model(numbers: list[int]) -> None:
    window, seen = ReplayWindow(), set[int]()
    for number in numbers:
        if seen and max(seen) - number >= limits.REPLAY_WINDOW:
            expected = Verdict.REPLAYED
        else:
            expected = Verdict.REPEATED if number in seen else Verdict.ACCEPTED
            seen.add(number)
        assert window.take(A_RUN, number, BEGIN) is expected
