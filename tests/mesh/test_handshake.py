"""Hello, welcome, refuse: golden bytes, malformed, and every reason to refuse."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import Guid
from rmpa.mesh.frames import Hello, Lane, Refusal, Refuse, judge, judge_welcome
from tests.mesh.worlds import HIGH, LOW

if TYPE_CHECKING:
    from rmpa.core.identity import Identity

HELLO = Hello(Guid.of("10.0.0.1", 40001, 7), bytes(range(16)), "base", 5, 1000, Guid.of("10.0.0.2", 2))
WIRE = bytes.fromhex(
    "524d5041 03 01 0005 0a0000019c410007 000102030405060708090a0b0c0d0e0f 000003e8 0a00000200020000 0462617365"
)


def test_golden_bytes() -> None:
    assert HELLO.serialize() == WIRE
    assert Hello.parse(WIRE) == HELLO
    assert Hello.parse(WIRE + b"later") == HELLO
    assert Hello.parse(memoryview(WIRE)) == HELLO
    assert Refuse(2, "no").serialize() == b"\x00\x02no"
    assert Refuse.parse(b"\x00\x02no") == Refuse(2, "no")
    assert str(Refuse.parse(b"\x01\x00?")) == "code 256: ?"


def problem(wire: bytes) -> Refuse:
    """The answer to a hello that cannot be read."""
    refuse = Hello.parse(wire)
    assert isinstance(refuse, Refuse)
    return refuse


@pytest.mark.parametrize("cut", range(len(WIRE)))
def test_every_shorter_hello_is_malformed(cut: int) -> None:
    assert problem(WIRE[:cut]).code == Refusal.MALFORMED


def test_other_version_is_distinguished_from_garbage() -> None:
    refuse = problem(b"RMPA\x04\x01\x00\x00")
    assert refuse.code == Refusal.VERSION
    assert "same release" in refuse.text


@pytest.mark.parametrize("name", [b"\xff\xff", b"a/b", b"a b", b"", b"a" * 65])
def test_names_that_are_not(name: bytes) -> None:
    assert problem(WIRE[:44] + bytes([len(name)]) + name).code == Refusal.MALFORMED


def test_a_lease_of_nothing_a_domain_of_none_and_a_refusal_of_nothing() -> None:
    assert problem(WIRE[:32] + bytes(4) + WIRE[36:]).code == Refusal.MALFORMED
    assert "no domain 1056" in problem(replace(HELLO, domain=1056).serialize()).text
    with pytest.raises(RemoteProtocolError):
        Refuse.parse(b"\x00")


def hello_of(identity: Identity, expected: Guid | None = None) -> Hello:
    return Hello.of(identity, lease=1.0, expected=expected)


GHOST = replace(LOW, instance=b"g" * 16)

REFUSED: list[tuple[Hello, Identity | None, Refusal, str]] = [
    (hello_of(replace(LOW, domain=3)), None, Refusal.DOMAIN, "--domain"),
    (hello_of(HIGH), None, Refusal.MYSELF, "its own port"),
    (hello_of(replace(HIGH, instance=b"x" * 16)), None, Refusal.DUPLICATE, "--port"),
    (hello_of(LOW), GHOST, Refusal.DUPLICATE, "--port"),
    (hello_of(LOW, Guid.of("10.0.0.9", 9)), None, Refusal.WRONG_PEER, "changed hands"),
    (replace(hello_of(LOW), lane=3), None, Refusal.LANE, "same release"),
    (replace(hello_of(LOW), lane=0), None, Refusal.LANE, "same release"),
    (replace(hello_of(LOW), lane=2), None, Refusal.NO_EXPRESS, "belongs to an express one"),
    (replace(hello_of(LOW), lane=2), GHOST, Refusal.NO_EXPRESS, "belongs to an express one"),
    (replace(hello_of(replace(LOW, domain=3)), lane=2), None, Refusal.DOMAIN, "--domain"),
]


@pytest.mark.parametrize(("hello", "linked", "code", "advice"), REFUSED)
def test_refused(hello: Hello, linked: Identity | None, code: Refusal, advice: str) -> None:
    verdict = judge(hello, HIGH, linked)
    assert verdict is not None
    assert verdict.code == code
    assert advice in verdict.text


@pytest.mark.parametrize("dialled", [False, True])
@pytest.mark.parametrize("alive", [False, True])
def test_bulk_lane_is_accepted_beside_its_express_lane(dialled: bool, alive: bool) -> None:
    for one, other in ((LOW, HIGH), (HIGH, LOW)):
        bulk = replace(hello_of(one), lane=Lane.BULK)
        assert judge(bulk, other, one, dialled=dialled, alive=alive) is None
        assert judge(bulk, other, one, dialled=dialled, alive=alive, full=True) is None
        ghost = judge(bulk, other, replace(one, instance=b"g" * 16), dialled=dialled, alive=alive)
        assert ghost is not None
        assert ghost.code == Refusal.NO_EXPRESS


def test_a_full_mesh_refuses_strangers_alone() -> None:
    verdict = judge(hello_of(LOW), HIGH, full=True)
    assert verdict is not None
    assert verdict.code == Refusal.FULL
    assert "docs/sites.md" in verdict.text
    assert judge(hello_of(LOW), HIGH, LOW, full=True) is None


def test_welcome_cases() -> None:
    assert judge(hello_of(LOW, HIGH.guid), HIGH) is None
    older = Guid.of(HIGH.guid.address, HIGH.guid.port, 0)
    assert judge(hello_of(LOW, older), HIGH) is None, "a restarted peer is welcome under its old number"
    assert judge(hello_of(LOW), HIGH, GHOST, alive=False) is None, "the ghost of a new instance"
    assert judge(hello_of(LOW), HIGH, LOW, dialled=True) is None, "the lower GUID's call replaces ours"
    verdict = judge(hello_of(HIGH), LOW, HIGH, dialled=True)
    assert verdict is not None
    assert verdict.code == Refusal.ALREADY_LINKED


def test_the_answer_is_judged_too() -> None:
    good = hello_of(HIGH, LOW.guid)
    assert judge_welcome(good, LOW, HIGH.guid) is None
    assert judge_welcome(good, LOW, None) is None
    cases = [
        (replace(good, expected=None), Refusal.MALFORMED),
        (replace(good, domain=1), Refusal.DOMAIN),
        (replace(good, guid=Guid.of("10.0.0.3", 1)), Refusal.WRONG_PEER),
        (replace(good, instance=LOW.instance), Refusal.MYSELF),
    ]
    for welcome, code in cases:
        verdict = judge_welcome(welcome, LOW, HIGH.guid)
        assert verdict is not None
        assert verdict.code == code


@pytest.mark.parametrize("place", ["0.0.0.0:0", "0.1.2.3:40001", "224.0.0.1:40001", "240.0.0.1:1", "10.0.0.1:0"])
def test_unreachable_guid_is_malformed(place: str) -> None:
    """Discovery gossips the GUIDs of its links; one that no beacon may carry stopped all its beacons."""
    refuse = problem(replace(HELLO, guid=Guid.parse(place)).serialize())
    assert refuse.code == Refusal.MALFORMED
    assert "no peer can be reached" in refuse.text


@given(
    guid=st.builds(
        Guid.of, st.ip_addresses(v=4, network="64.0.0.0/2"), st.integers(1, 0xFFFF), st.integers(0, 0xFFFF)
    ),
    instance=st.binary(min_size=16, max_size=16),
    name=st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,63}", fullmatch=True),
    domain=st.integers(0, 232),
    lease=st.integers(1, 2**32 - 1),
    expected=st.integers(1, 2**64 - 1),
    lane=st.integers(0, 255),
)
def test_any_hello_survives(
    guid: Guid, instance: bytes, name: str, domain: int, lease: int, expected: int, lane: int
) -> None:
    hello = Hello(guid, instance, name, domain, lease, Guid(expected), lane)
    assert Hello.parse(hello.serialize()) == hello
