"""Group keys: which one signs, and which ones verify, while they are replaced."""

from __future__ import annotations

import hashlib
import hmac

import msgspec
import pytest

from rmpa.trust import limits
from rmpa.trust.packets import GroupKey, KeyRing


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
