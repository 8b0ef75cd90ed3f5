"""Digests of catalogues: golden values, equality, and what a hello says of them."""

from __future__ import annotations

from hashlib import blake2b

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.bridge.catalogue.digest import (
    HeldOffers,
    digest_of,
    digest_text,
    entry_hash,
    parse_digest,
    with_entry,
    without_entry,
)
from rmpa.bridge.messages import Advertise, Origin, ServiceOffer, TopicOffer, encode

TOPIC = TopicOffer("/cmd", "/joy", "sensor_msgs/Joy")
RELAYED = TopicOffer("/map", "/slam", "a/Map", Origin("arm", "10.0.0.1:40001#7", "0" * 32, "/slam", ("1" * 32,)))
SERVICE = ServiceOffer("/add", "/adder")
TEXTS = {
    TOPIC: b'{"topic":"/cmd","node":"/joy","type":"sensor_msgs/Joy"}',
    RELAYED: b'{"topic":"/map","node":"/slam","type":"a/Map","origin":{"name":"arm","guid":"10.0.0.1:40001#7",'
    b'"instance":"00000000000000000000000000000000","node":"/slam","path":["11111111111111111111111111111111"]}}',
    SERVICE: b'{"service":"/add","node":"/adder"}',
}
HELD = HeldOffers(bytes(range(8)), 5, 0x1122334455667788, 0x99)
HELD_WIRE = bytes.fromhex("0001020304050607 00000005 1122334455667788 0000000000000099")
offers = st.builds(
    TopicOffer, st.sampled_from(["/a", "/b", "/c"]), st.sampled_from(["/n", "/m"]), st.sampled_from(["a/B", "a/C"])
)


def test_golden_values() -> None:
    assert digest_text(entry_hash(TOPIC)) == "6f046483ee94828b"
    assert digest_text(entry_hash(SERVICE)) == "5cecadc17e186207"
    assert digest_text(digest_of([TOPIC, RELAYED])) == "e5b94fd24fcd73da"
    assert digest_of([]) == 0


@pytest.mark.parametrize(("offer", "text"), TEXTS.items())
def test_the_hash_is_over_the_text_of_the_advertisement(offer: TopicOffer | ServiceOffer, text: bytes) -> None:
    assert entry_hash(offer) == int.from_bytes(blake2b(text, digest_size=8).digest(), "big")
    if isinstance(offer, TopicOffer):
        assert text in encode(Advertise(added=(offer,)))


@settings(deadline=None)
@given(st.sets(offers), st.sets(offers))
def test_digests_are_equal_as_the_catalogues_are(one: set[TopicOffer], other: set[TopicOffer]) -> None:
    assert (digest_of(one) == digest_of(other)) == (one == other)


@settings(deadline=None)
@given(st.lists(offers, unique=True), st.randoms(use_true_random=False))
def test_the_order_does_not_count_and_changes_are_as_good_as_the_whole(found: list[TopicOffer], rng: object) -> None:
    digest = 0
    for offer in found:
        digest = with_entry(digest, offer)
    shuffled = sorted(found, key=lambda _: rng.random())  # type: ignore[attr-defined]
    assert digest == digest_of(shuffled)
    for offer in shuffled:
        digest = without_entry(digest, offer)
    assert digest == 0


def test_golden_bytes_of_what_is_held() -> None:
    assert HELD.serialize() == HELD_WIRE
    assert HeldOffers.parse(HELD_WIRE) == HELD
    assert HELD.is_of(bytes(range(16)))
    assert not HELD.is_of(bytes(16))
    assert str(HELD) == "version 5, topics 1122334455667788, services 0000000000000099"
    assert HeldOffers.of(bytes(range(16)), 5, HELD.topics, HELD.services) == HELD


@pytest.mark.parametrize("size", [*range(len(HELD_WIRE)), len(HELD_WIRE) + 1, 255])
def test_another_length_says_nothing(size: int) -> None:
    assert HeldOffers.parse((HELD_WIRE * 10)[:size]) is None


def test_version_0_is_none() -> None:
    assert HeldOffers.parse(HELD_WIRE[:8] + bytes(4) + HELD_WIRE[12:]) is None


@pytest.mark.parametrize("text", [None, 5, "", "0" * 15, "0" * 17, "x" * 16, "0 " * 8, [], "\u0660" * 16])
def test_what_is_no_digest(text: object) -> None:
    assert parse_digest(text) is None


@settings(deadline=None)
@given(st.integers(0, 2**64 - 1))
def test_any_digest_survives(digest: int) -> None:
    assert parse_digest(digest_text(digest)) == digest
