from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa import __version__
from rmpa.core import limits as core_limits
from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.core.identity import Guid, Identity
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh import limits
from rmpa.mesh.frames import (
    PAYLOAD_MAX,
    WHOLE,
    Frame,
    FrameKind,
    Hello,
    Refusal,
    Refuse,
    check_header,
    judge,
    judge_welcome,
    pack_data_header,
    parse_pong,
    parse_text,
    pong,
)
from tests.mesh.worlds import HIGH, LOW, Side, Time, deliver, pass_time, with_peer

# Frames: golden bytes, whole, byte by byte, malformed, any.


GOLDEN = [
    (
        Frame(FrameKind.DATA, b"\x04\x00\x00\x00abcd", route=7, sequence=12, stamp_ns=0x0102030405060708),
        "00000008 07 03 0000 00000007 0000000c 0102030405060708 0400000061626364",
    ),
    (Frame(FrameKind.PING, stamp_ns=1), "00000000 04 03 0000 00000000 00000000 0000000000000001"),
    (pong(1, 2, 3), "00000010 05 03 0000 00000000 00000000 0000000000000003 0000000000000001 0000000000000002"),
    (Frame(FrameKind.BYE, b"ends"), "00000004 08 03 0000 00000000 00000000 0000000000000000 656e6473"),
    (
        Frame(FrameKind.DATA, b"\x08\0\0\0ab", 7, 12, 9, flags=FIRST),
        "00000006 07 01 0000 00000007 0000000c 0000000000000009 080000006162",
    ),
    (Frame(FrameKind.DATA, b"cd", 7, 12, 9, flags=0), "00000002 07 00 0000 00000007 0000000c 0000000000000009 6364"),
    (
        Frame(FrameKind.DATA, b"ef", 7, 12, 9, flags=LAST),
        "00000002 07 02 0000 00000007 0000000c 0000000000000009 6566",
    ),
    (
        Frame(FrameKind.DATA, b"", 7, 12, 9, flags=LAST | ABORT),
        "00000000 07 06 0000 00000007 0000000c 0000000000000009",
    ),
    (Frame(FrameKind.ACK, route=7, sequence=0xFFFFFFFF), "00000000 09 03 0000 00000007 ffffffff 0000000000000000"),
    (Frame(FrameKind.FENCE, route=7, sequence=1), "00000000 0a 03 0000 00000007 00000001 0000000000000000"),
    (Frame(FrameKind.FENCED, route=7, sequence=1), "00000000 0b 03 0000 00000007 00000001 0000000000000000"),
]


@pytest.mark.parametrize(("frame", "wire"), GOLDEN)
def test_golden_bytes(frame: Frame, wire: str) -> None:
    data = bytes.fromhex(wire)
    assert frame.serialize() == data
    assert Frame.parse(data) == (frame, len(data))
    for cut in range(len(data)):
        assert Frame.parse(data[:cut]) is None
    assert Frame.parse(data + b"next") == (frame, len(data))


def test_the_sequence_wraps() -> None:
    assert pack_data_header(0, 1, 1 << 32, 0)[12:16] == bytes(4)


@pytest.mark.parametrize("kind", list(FrameKind))
def test_header_alone_limits_the_length_by_kind(kind: FrameKind) -> None:
    header = (PAYLOAD_MAX[kind] + 1).to_bytes(4, "big") + bytes([kind, 3]) + bytes(18)
    with pytest.raises(LimitExceeded, match=kind.name.lower()):
        Frame.parse(header)


@pytest.mark.parametrize("kind", [0, 14, 0x7F, 0xFF])
def test_unknown_kinds(kind: int) -> None:
    with pytest.raises(RemoteProtocolError, match="unknown kind"):
        Frame.parse(bytes([0, 0, 0, 0, kind, 3]) + bytes(18))


@pytest.mark.parametrize("kind", [kind for kind in FrameKind if kind is not FrameKind.DATA])
@pytest.mark.parametrize("flags", [0, FIRST, LAST, LAST | ABORT, ABORT])
def test_only_data_comes_in_fragments(kind: FrameKind, flags: int) -> None:
    with pytest.raises(RemoteProtocolError, match="fragment"):
        Frame.parse(Frame(kind, flags=flags).serialize())


@pytest.mark.parametrize(
    ("payload", "flags", "problem"),
    [
        (b"", WHOLE, "without data"), (b"", FIRST, "without data"), (b"", 0, "without data"),
        (b"", LAST, "without data"), (b"", ABORT, "aborts"), (b"", FIRST | ABORT, "aborts"),
        (b"", WHOLE | ABORT, "aborts"), (b"x", LAST | ABORT, "aborts"), (b"x", WHOLE | ABORT, "aborts"),
    ],
)  # fmt: skip
def test_a_fragment_that_cannot_be(payload: bytes, flags: int, problem: str) -> None:
    with pytest.raises(RemoteProtocolError, match=problem):
        Frame.parse(Frame(FrameKind.DATA, payload, flags=flags).serialize())


@pytest.mark.parametrize("flags", [0x08, 0x80, 0xF8])
def test_flags_of_a_later_version_are_ignored(flags: int) -> None:
    check_header(0, FrameKind.PING, WHOLE | flags)
    for own in (0, FIRST, LAST, WHOLE):
        check_header(1, FrameKind.DATA, own | flags)


def test_fragment_length_is_bounded() -> None:
    check_header(core_limits.FRAGMENT_BYTES, FrameKind.DATA, 0)
    check_header(limits.DATA_PAYLOAD_MAX, FrameKind.DATA, WHOLE)
    with pytest.raises(LimitExceeded, match="data"):
        check_header(limits.DATA_PAYLOAD_MAX + 1, FrameKind.DATA, 0)


def test_our_own_faults() -> None:
    with pytest.raises(LocalProtocolError):
        Frame(FrameKind.PING, b"x").serialize()
    with pytest.raises(LocalProtocolError):
        pack_data_header(limits.DATA_PAYLOAD_MAX + 1, 1, 1, 1)
    with pytest.raises(LocalProtocolError):
        pack_data_header(1, 1 << 32, 1, 1)
    with pytest.raises(RemoteProtocolError):
        parse_pong(b"short")


def test_text_is_safe_for_a_log() -> None:
    assert parse_text(b"a\nb\x1b[2J\xff") == "a b [2J\ufffd"
    assert str(GOLDEN[0][0]) == "DATA route=7 #12 8 bytes"
    assert str(GOLDEN[1][0]) == "PING"
    assert str(GOLDEN[4][0]) == "DATA route=7 #12 flags=1 6 bytes"
    assert str(GOLDEN[7][0]) == "DATA route=7 #12 flags=6"


@given(
    kind=st.sampled_from(FrameKind),
    payload=st.binary(max_size=200),
    route=st.integers(0, 2**32 - 1),
    sequence=st.integers(0, 2**32 - 1),
    stamp=st.integers(0, 2**64 - 1),
    flags=st.sampled_from([0, FIRST, LAST, WHOLE]),
)
def test_any_frame_survives(
    kind: FrameKind, payload: bytes, route: int, sequence: int, stamp: int, flags: int
) -> None:
    if kind is FrameKind.DATA:
        frame = Frame(kind, payload or b"x", route, sequence, stamp, flags)
    else:
        frame = Frame(kind, payload[: PAYLOAD_MAX[kind]], route, sequence, stamp)
    assert Frame.parse(frame.serialize()) == (frame, 24 + len(frame.payload))


# Hello, welcome, refuse: golden bytes, malformed, and every reason to refuse.


HELLO = Hello(Guid.of("10.0.0.1", 40001, 7), bytes(range(16)), "base", 5, 1000, Guid.of("10.0.0.2", 2))


WIRE = bytes.fromhex(
    "524d5041 03 01 0005 0a0000019c410007 000102030405060708090a0b0c0d0e0f 000003e8 0a00000200020000 0462617365"
)


def test_golden_bytes_of_the_handshake() -> None:
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
    text = f"link protocol 4 meets 3 of rmpa {__version__}: install the same release of rmpa on both"
    assert refuse.text == text


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
    verdict = judge(hello, HIGH, None if linked is None else with_peer(linked, dialled=False))
    assert verdict is not None
    assert verdict.code == code
    assert advice in verdict.text


def test_a_full_mesh_refuses_strangers_alone() -> None:
    verdict = judge(hello_of(LOW), HIGH, full=True)
    assert verdict is not None
    assert verdict.code == Refusal.FULL
    assert "docs/guides/sites.md" in verdict.text
    assert judge(hello_of(LOW), HIGH, with_peer(LOW), full=True) is None


def test_welcome_cases() -> None:
    assert judge(hello_of(LOW, HIGH.guid), HIGH) is None
    older = Guid.of(HIGH.guid.address, HIGH.guid.port, 0)
    assert judge(hello_of(LOW, older), HIGH) is None, "a restarted peer is welcome under its old number"
    assert judge(hello_of(LOW), HIGH, with_peer(GHOST, dialled=False, alive=False)) is None, (
        "the ghost of a new instance"
    )
    assert judge(hello_of(LOW), HIGH, with_peer(LOW)) is None, "the lower GUID's call replaces ours"
    verdict = judge(hello_of(HIGH), LOW, with_peer(HIGH))
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


# Messages in parts, marks between them, and how a bulk lane's machine differs.


@pytest.mark.parametrize("flags", [FIRST, 0, LAST, WHOLE])
@pytest.mark.parametrize("chunk", [1000, 65_536, 131_073])
def test_a_large_frame_is_handed_on_while_it_arrives(acceptor: Side, time: Time, flags: int, chunk: int) -> None:
    payload = bytes(range(251)) * 1000
    assert core_limits.CUT_THROUGH_BYTES < len(payload) <= limits.DATA_PAYLOAD_MAX
    wire = Frame(FrameKind.DATA, payload, 7, 1, 99, flags).serialize()
    half = len(wire) // 2
    consumed, wanted = acceptor.receive(memoryview(wire[:half]), time.now)
    assert (consumed, wanted) == (half, 0), "nothing is kept, nothing is waited for"
    assert sum(len(part) for *_, part in acceptor.parts) == half - 24
    deliver(wire[half:] + Frame(FrameKind.CONTROL, b"{}").serialize(), acceptor, time.now, chunk)
    assert b"".join(part for *_, part in acceptor.parts) == payload
    marks = [mark for _, _, _, mark, _ in acceptor.parts]
    assert marks[0] == flags & FIRST
    assert marks[-1] == flags & LAST
    assert not any(marks[1:-1])
    assert {part[:3] for part in acceptor.parts} == {(7, 1, 99)}
    assert acceptor.last() == ("control", b"{}"), "the next frame begins behind it"


def test_half_read_frame_renews_the_lease_only_with_bytes(acceptor: Side, time: Time) -> None:
    acceptor.receive(memoryview(pack_data_header(200_000, 1, 1, 0) + bytes(1000)), time.now)
    for _ in range(5):
        time.now += 0.9
        acceptor.receive(memoryview(bytes(1000)), time.now)
        acceptor.handle_timer(time.now)
    assert not acceptor.seen("closed")
    pass_time(acceptor, time, 1.0)
    assert acceptor.last()[0] == "closed"
