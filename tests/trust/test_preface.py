"""The preface: golden bytes, damage, and which connections may go on to TLS."""

from __future__ import annotations

import contextlib
import hashlib
import hmac

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.mesh.frames import Frame, FrameKind
from rmpa.mesh.handshake import Refusal
from rmpa.trust import limits
from rmpa.trust.keyring import GroupKey, KeyPurpose, KeyRing
from rmpa.trust.preface import (
    PREFACE_BYTES,
    Preface,
    PrefaceError,
    PrefaceGuard,
    Purpose,
    is_preface,
    signed_with,
)
from rmpa.trust.reasons import TrustReason
from tests.fuzz import target_preface

KEY = GroupKey(3, bytes(range(32)))
SIGNING = KEY.key_for(KeyPurpose.PREFACE)
WALL = 1_790_000_000.0
NOW = 9.0
PREFACE = Preface(Purpose.LINK, 3, 1_790_000_000_000, bytes(range(16)))
HEAD = bytes.fromhex("524d5053 01 01 0003 0000000000000000 000001a0c4506c00 000102030405060708090a0b0c0d0e0f")
TOKEN_ID, TOKEN_KEY = b"token-id", b"k" * 32


def _guard(*keys: GroupKey) -> PrefaceGuard:
    return PrefaceGuard(KeyRing(keys or (KEY,), 0.0), {TOKEN_ID: TOKEN_KEY}.get)


def _link(nonce: int = 0, time_ms: int = 1_790_000_000_000, key: int = 3) -> bytes:
    return Preface(Purpose.LINK, key, time_ms, nonce.to_bytes(16, "big")).serialize(SIGNING)


def _refused(guard: PrefaceGuard, data: bytes, now: float = NOW, wall: float | None = WALL) -> TrustReason:
    with pytest.raises(PrefaceError) as caught:
        guard.admit(data, now, wall)
    assert str(caught.value)
    return caught.value.reason


def test_golden_bytes_both_ways() -> None:
    wire = PREFACE.serialize(SIGNING)
    assert wire[:40] == HEAD
    assert wire[40:] == hmac.new(SIGNING, HEAD, hashlib.sha256).digest()[:16]
    assert len(wire) == PREFACE_BYTES == 56
    assert Preface.parse(wire + b"a ClientHello") == PREFACE
    assert signed_with(wire + b"a ClientHello", SIGNING)
    assert _guard().admit(wire, NOW, WALL) == (PREFACE, False)


def test_the_reasons_continue_the_refusals() -> None:
    assert min(TrustReason) == max(Refusal) + 1
    assert all(reason.remedy and reason.label.isalpha() for reason in TrustReason)


@pytest.mark.parametrize("length", range(PREFACE_BYTES))
def test_every_shorter_preface_is_none(length: int) -> None:
    with pytest.raises(PrefaceError):
        Preface.parse(PREFACE.serialize(SIGNING)[:length])


def test_every_changed_byte_is_noticed() -> None:
    wire = PREFACE.serialize(SIGNING)
    for offset in range(len(wire)):
        changed = wire[:offset] + bytes([wire[offset] ^ 1]) + wire[offset + 1 :]
        _refused(_guard(), changed)


def test_the_first_bytes_tell_plain_from_secured() -> None:
    hello = Frame(FrameKind.HELLO, b"RMPA" + bytes(60)).serialize()
    assert is_preface(hello) is False
    assert is_preface(hello[:1]) is False
    wire = PREFACE.serialize(SIGNING)
    assert [is_preface(wire[:n]) for n in range(6)] == [None, None, None, None, True, True]
    assert _refused(_guard(), hello) is TrustReason.PLAIN


def test_later_versions_and_purposes_are_refused_as_such() -> None:
    wire = PREFACE.serialize(SIGNING)
    for offset in (4, 5):
        changed = wire[:offset] + b"\x09" + wire[offset + 1 :]
        assert _refused(_guard(), changed) is TrustReason.DOWNGRADE


def test_other_keys_are_refused() -> None:
    assert _refused(_guard(GroupKey(3, bytes(32))), _link()) is TrustReason.KEY
    assert _refused(_guard(GroupKey(4, KEY.secret)), _link()) is TrustReason.KEY
    beacon_key = Preface(Purpose.LINK, 3, 0, bytes(16)).serialize(KEY.key_for(KeyPurpose.BEACON))
    assert _refused(_guard(), beacon_key) is TrustReason.KEY


def test_a_preface_is_admitted_once() -> None:
    guard = _guard()
    guard.admit(_link(1), NOW, WALL)
    assert _refused(guard, _link(1)) is TrustReason.FLOOD
    guard.admit(_link(2), NOW, WALL)
    kept = NOW + limits.NONCE_KEPT
    assert _refused(guard, _link(1), kept - 1, WALL + 29) is TrustReason.FLOOD
    assert _refused(guard, _link(1), kept, WALL + limits.NONCE_KEPT) is TrustReason.CLOCK


def test_clocks_that_are_set_must_agree() -> None:
    ms = 1_790_000_000_000
    _guard().admit(_link(time_ms=ms + 30_000), NOW, WALL)
    assert _refused(_guard(), _link(time_ms=ms + 30_001)) is TrustReason.CLOCK
    assert _refused(_guard(), _link(time_ms=ms - 30_001)) is TrustReason.CLOCK
    _guard().admit(_link(time_ms=0), NOW, WALL)
    _guard().admit(_link(time_ms=1), NOW, None)


def test_a_token_admits_to_joining_alone() -> None:
    guard = _guard()
    join = Preface(Purpose.JOIN, 0, 0, bytes(16), TOKEN_ID)
    assert guard.admit(join.serialize(TOKEN_KEY), NOW, WALL) == (join, False)
    unknown = Preface(Purpose.JOIN, 0, 0, bytes(16), b"another!").serialize(TOKEN_KEY)
    assert _refused(guard, unknown) is TrustReason.KEY
    assert _refused(guard, join.serialize(SIGNING)) is TrustReason.KEY
    assert _refused(guard, Preface(Purpose.LINK, 3, 0, bytes(16), TOKEN_ID).serialize(TOKEN_KEY)) is TrustReason.KEY


def test_old_keys_are_admitted_at_a_low_rate() -> None:
    guard = _guard(KEY, GroupKey(4, b"n" * 32))
    for nonce in range(int(limits.OLD_KEY_DIALS_PER_ADDRESS)):
        assert guard.admit(_link(nonce), NOW, WALL)[1]
    assert _refused(guard, _link(99)) is TrustReason.FLOOD
    guard.admit(_link(100), NOW + 1, WALL)


def test_old_keys_of_one_address_take_nothing_from_others() -> None:
    """Nor do prefaces that are sent again, or late, by something without any key."""
    guard = _guard(KEY, GroupKey(4, b"n" * 32))
    guard.admit(_link(0), NOW, WALL, "10.0.0.9")
    for _ in range(100):
        with pytest.raises(PrefaceError, match="came before"):
            guard.admit(_link(0), NOW, WALL, "10.0.0.2")
        with pytest.raises(PrefaceError, match="clock"):
            guard.admit(_link(1), NOW, WALL + 60, "10.0.0.2")
    for nonce in range(100, 200):
        with contextlib.suppress(PrefaceError):
            guard.admit(_link(nonce), NOW, WALL, "10.0.0.9")
    guard.admit(_link(2), NOW, WALL, "10.0.0.2")


def test_old_keys_are_bounded_over_all_addresses() -> None:
    guard = _guard(KEY, GroupKey(4, b"n" * 32))
    admitted = 0
    for nonce in range(3 * limits.OLD_KEYS_MAX):
        with contextlib.suppress(PrefaceError):
            guard.admit(_link(nonce), NOW, WALL, f"10.0.{nonce // 256}.{nonce % 256}")
            admitted += 1
    assert admitted == limits.OLD_KEY_DIALS_RATE
    assert len(guard._old_keys_there) == limits.OLD_KEYS_MAX


def test_a_former_member_uses_up_no_place_of_a_member_or_a_joining_module() -> None:
    """After a revocation, from as many addresses as it likes and for as long as nonces are kept."""
    new = GroupKey(4, b"n" * 32)
    ring = KeyRing([KEY], 0.0)
    guard = PrefaceGuard(ring, {TOKEN_ID: TOKEN_KEY}.get)
    ring.take([new], NOW, proves_from=4)
    for nonce in range(3 * limits.NONCES_MAX):
        with contextlib.suppress(PrefaceError):
            guard.admit(_link(nonce), NOW + nonce / 200, WALL, f"10.0.{nonce % 40}.1")
    now = NOW + 3 * limits.NONCES_MAX / 200
    for nonce in range(limits.NONCES_PER_ADDRESS):
        member = Preface(Purpose.LINK, 4, 0, nonce.to_bytes(16, "little"))
        assert not guard.admit(member.serialize(new.key_for(KeyPurpose.PREFACE)), now, WALL, "10.1.0.1")[1]
        join = Preface(Purpose.JOIN, 0, 0, nonce.to_bytes(16, "little"), TOKEN_ID)
        guard.admit(join.serialize(TOKEN_KEY), now, WALL, "10.1.0.2")


def test_nonces_are_bounded_and_forgotten() -> None:
    guard = _guard()
    for nonce in range(limits.NONCES_MAX):
        guard.admit(_link(nonce), NOW, WALL, f"10.0.0.{nonce % 9}")
    assert _refused(guard, _link(limits.NONCES_MAX)) is TrustReason.FLOOD
    guard.admit(_link(limits.NONCES_MAX), NOW + limits.NONCE_KEPT, WALL)
    assert len(guard._members) == 1
    assert guard._members._there.total() == len(guard._members._there) == 1


def test_one_address_leaves_places_to_others() -> None:
    guard = _guard()
    for nonce in range(limits.NONCES_MAX):
        with contextlib.suppress(PrefaceError):
            guard.admit(_link(nonce), NOW, WALL, "10.0.0.9")
    guard.admit(_link(limits.NONCES_MAX), NOW, WALL, "10.0.0.2")


def test_refused_prefaces_leave_no_nonce() -> None:
    guard = _guard()
    wire = _link(1)
    _refused(guard, wire[:-1] + bytes([wire[-1] ^ 1]))
    _refused(guard, _link(2), wall=WALL + 60)
    assert not len(guard._members)


@pytest.mark.parametrize(
    ("nonce", "key", "time_ms", "token_id"),
    [
        (b"", 1, 0, bytes(8)),
        (bytes(16), 1 << 16, 0, bytes(8)),
        (bytes(16), 1, 1 << 64, bytes(8)),
        (bytes(16), 1, 0, b""),
    ],
)
def test_what_cannot_be_is_no_preface(nonce: bytes, key: int, time_ms: int, token_id: bytes) -> None:
    with pytest.raises(ValueError, match="has"):
        Preface(Purpose.LINK, key, time_ms, nonce, token_id)


@given(st.binary(max_size=80))
def test_anything_at_all_is_refused(data: bytes) -> None:
    _refused(_guard(), data)


def test_the_fuzz_target_takes_its_seeds() -> None:
    for seed in target_preface.SEEDS:
        target_preface.fuzz(seed)
