"""Two connection machines back to back."""

from __future__ import annotations

import pytest

from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.core.identity import Guid
from rmpa.mesh import limits
from rmpa.mesh.connection import ConnectionState
from rmpa.mesh.frames import Frame, FrameKind, Hello, Refusal, Refuse, pack_data_header
from tests.mesh.worlds import ACCEPTOR, DIALLER, HIGH, LOW, AnyRoute, Side, Time, deliver, exchange, pass_time


@pytest.mark.parametrize("chunk", [1, 7, 24, 1 << 20])
def test_handshake_control_data_and_bye_in_pieces(time: Time, chunk: int) -> None:
    dialler = Side(DIALLER, LOW, time, expected=HIGH.guid)
    acceptor = Side(ACCEPTOR, HIGH, time)
    deliver(dialler.take_output(), acceptor, time.now, chunk)
    assert acceptor.events[0] == ("hello", LOW)
    exchange(dialler, acceptor, time, chunk)
    assert dialler.events[0] == ("opened", HIGH)
    control = dialler.pack_control(b'{"op":"x"}')
    data = [pack_data_header(n, 7, i, 99) + bytes(n) for i, n in enumerate([3, 1, 300])]
    deliver(control + b"".join(data), acceptor, time.now, chunk)
    assert acceptor.last() == ("control", b'{"op":"x"}')
    assert acceptor.data == [(7, 0, 99, bytes(3)), (7, 1, 99, bytes(1)), (7, 2, 99, bytes(300))]
    dialler.close("shutting down", time.now)
    assert dialler.state is ConnectionState.CLOSING
    deliver(dialler.take_output(), acceptor, time.now, chunk)
    assert acceptor.last() == ("closed", "low left: shutting down")
    dialler.lost("the other side closed the connection")
    assert dialler.last() == ("closed", "shutting down")


def with_byte(data: bytes, offset: int, value: int) -> bytes:
    return data[:offset] + bytes([value]) + data[offset + 1 :]


@pytest.mark.parametrize(
    ("offset", "value", "code"),
    [
        (0, 0x58, Refusal.MALFORMED), (4, 2, Refusal.VERSION), (44, 60, Refusal.MALFORMED),
        (45, 0x2F, Refusal.MALFORMED),
    ],
)  # fmt: skip
def test_an_unreadable_hello_is_refused_with_its_code(time: Time, offset: int, value: int, code: Refusal) -> None:
    acceptor = Side(ACCEPTOR, HIGH, time)
    payload = Hello.of(LOW, lease=1.0, expected=None).serialize()
    deliver(Frame(FrameKind.HELLO, with_byte(payload, offset, value)).serialize(), acceptor, time.now)
    frame = Frame.parse(acceptor.take_output())
    assert frame is not None
    assert frame[0].kind is FrameKind.REFUSE
    assert Refuse.parse(frame[0].payload).code == code
    assert acceptor.state is ConnectionState.CLOSING
    assert acceptor.events[0][0] == "refused"


def test_a_wrong_welcome_ends_the_link_with_a_bye(time: Time) -> None:
    dialler = Side(DIALLER, LOW, time, expected=Guid.of("10.0.0.9", 1))
    dialler.take_output()
    welcome = Hello.of(HIGH, lease=1.0, expected=LOW.guid)
    deliver(Frame(FrameKind.WELCOME, welcome.serialize()).serialize(), dialler, time.now)
    assert dialler.events[0][0] == "refused"
    assert dialler.events[0][1].code == Refusal.WRONG_PEER
    frame = Frame.parse(dialler.take_output())
    assert frame is not None
    assert frame[0].kind is FrameKind.BYE


@pytest.mark.parametrize(
    "header",
    [
        b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
        bytes.fromhex("00001001 01 03 0000 00000000 00000000 0000000000000000"),
        bytes(24),
    ],
)
def test_garbage_on_the_port(time: Time, header: bytes) -> None:
    acceptor = Side(ACCEPTOR, HIGH, time)
    with pytest.raises(RemoteProtocolError):
        acceptor.receive(memoryview(header), time.now)


@pytest.mark.parametrize("first", ["timer", "bytes"])
def test_after_a_pause_beyond_the_lease_nothing_is_acted_on_until_the_peer_answers(
    dialler: Side, acceptor: Side, time: Time, first: str
) -> None:
    """The peer has ended the link then, and what it asked before comes from this side's buffers."""
    told: list[bool] = []
    for one in (dialler, acceptor):
        one.routes = AnyRoute(lambda *_, link=one: told.append(link.doubted))
    data = pack_data_header(3, 1, 1, 1) + b"abc"
    pass_time(dialler, time, 0.3)
    time.now += 0.9 * limits.EXPRESS_LEASE - 0.3
    deliver(Frame(FrameKind.PING, stamp_ns=1).serialize() + data, dialler, time.now)
    assert told == [False]
    time.now += limits.EXPRESS_LEASE + 0.1
    if first == "timer":
        dialler.handle_timer(time.now)
    deliver(Frame(FrameKind.PING, stamp_ns=2).serialize() + data, dialler, time.now)
    assert told == [False, True]
    pass_time(dialler, time, 0.5)
    time.now += 0.001
    exchange(dialler, acceptor, time)
    deliver(data, dialler, time.now)
    assert told == [False, True, False], "the peer was stopped as well, and its link stands"


@pytest.mark.parametrize("role", [DIALLER, ACCEPTOR])
def test_a_handshake_that_takes_too_long(time: Time, role: str) -> None:
    mine = Side(role, LOW, time)
    assert mine.next_timer() == time.now + limits.HANDSHAKE_TIMEOUT
    time.now += limits.HANDSHAKE_TIMEOUT
    mine.handle_timer(time.now)
    assert "handshake" in mine.seen("closed")[0][1]


def test_the_driver_loses_the_connection(dialler: Side) -> None:
    dialler.lost("reset by peer")
    dialler.lost("twice")
    assert dialler.last() == ("closed", "reset by peer")
    assert len(dialler.seen("closed")) == 1


def test_answers_out_of_turn_are_our_own_fault(time: Time) -> None:
    with pytest.raises(LocalProtocolError, match="no ping"):
        Side(ACCEPTOR, HIGH, time).ping(time.now)


@pytest.mark.parametrize("offset_ns", [0, 1_500_000_000, -86_400_000_000_000])
def test_the_clock_offset_is_within_its_bound(offset_ns: int) -> None:
    mine, theirs = Time(), Time()
    theirs.offset_ns = offset_ns
    dialler = Side(DIALLER, LOW, mine)
    acceptor = Side(ACCEPTOR, HIGH, theirs)

    def carry(source: Side, target: Side, delay: float) -> None:
        mine.now += delay
        theirs.now = mine.now
        deliver(source.take_output(), target, mine.now)

    carry(dialler, acceptor, 0.001)
    carry(acceptor, dialler, 0.001)
    for there, back in [(0.03, 0.001), (0.002, 0.004), (0.001, 0.05)]:
        carry(dialler, acceptor, there)
        carry(acceptor, dialler, back)
        mine.now += 0.25
        dialler.handle_timer(mine.now)
    estimate = dialler.clock.estimate(mine.now)
    assert estimate is not None
    offset, error = estimate
    assert error < 0.0041
    assert abs(offset - offset_ns / 1e9) <= error + 1e-9


@pytest.mark.parametrize("one_way", [0.05, 0.6, 1.4])
def test_link_with_a_long_round_trip_stays_up(time: Time, one_way: float) -> None:
    """Where a foreign flow fills a slow radio's queue: each side hears the other steadily, only late."""
    dialler = Side(DIALLER, LOW, time, expected=HIGH.guid)
    acceptor = Side(ACCEPTOR, HIGH, time)
    on_the_way: list[tuple[float, Side, bytes]] = []
    ends: list[float] = []
    begin = time.now
    while time.now < begin + 30.0 and not ends:
        for one, other in ((dialler, acceptor), (acceptor, dialler)):
            if one.output:
                on_the_way.append((time.now + one_way, other, one.take_output()))
        dues = [due for s in (dialler, acceptor) if (due := s.next_timer()) is not None]
        time.now = max(time.now, min([*dues, *(when for when, _, _ in on_the_way)]))
        arrived = [packet for packet in on_the_way if packet[0] <= time.now]
        on_the_way = [packet for packet in on_the_way if packet[0] > time.now]
        for _, to, data in arrived:
            deliver(data, to, time.now)
        for s in (dialler, acceptor):
            s.handle_timer(time.now)
            ends += [time.now - begin] * len(s.seen("closed"))
    assert ends == []
    assert dialler.state is acceptor.state is ConnectionState.UP
