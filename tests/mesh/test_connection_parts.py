"""Messages in parts, marks between them, and how a bulk lane's machine differs."""

from __future__ import annotations

import pytest

from rmpa.core import limits as core_limits
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh import limits
from rmpa.mesh.connection import ConnectionState
from rmpa.mesh.frames import WHOLE, Frame, FrameKind, Lane, pack_data_header
from tests.mesh.worlds import ACCEPTOR, HIGH, AnyRoute, Side, Time, deliver, exchange, pair, pass_time


def fragments(route: int, sequence: int, payload: bytes, sizes: list[int]) -> list[bytes]:
    """The frames of one message, cut at these sizes and one more for the rest."""
    pieces = []
    for size in sizes:
        pieces.append(payload[:size])
        payload = payload[size:]
    pieces.append(payload)
    frames = []
    for number, piece in enumerate(pieces):
        flags = FIRST * (number == 0) | LAST * (number == len(pieces) - 1)
        frames.append(Frame(FrameKind.DATA, piece, route, sequence, 99, flags).serialize())
    return frames


@pytest.mark.parametrize("chunk", [1, 7, 24, 25, 4096, 1 << 20])
def test_fragments_of_several_routes_interleave(chunk: int) -> None:
    time = Time()
    _, acceptor = pair(time)
    one, two = bytes(range(256)) * 4, b"two" * 300
    first, second = fragments(1, 5, one, [100, 900]), fragments(2, 6, two, [1, 898])
    small = pack_data_header(5, 3, 1, 99) + b"small"
    wire = b"".join([first[0], second[0], small, second[1], first[1], first[2], small, second[2]])
    deliver(wire, acceptor, time.now, chunk)
    assert acceptor.messages() == [(1, 5, 99, one), (2, 6, 99, two)]
    assert [flags for route, _, _, flags, _ in acceptor.parts if route == 1] == [FIRST, 0, LAST]
    assert acceptor.data == [(3, 1, 99, b"small")] * 2


@pytest.mark.parametrize("flags", [FIRST, 0, LAST, WHOLE])
@pytest.mark.parametrize("chunk", [1000, 65_536, 131_073])
def test_a_large_frame_is_handed_on_while_it_arrives(flags: int, chunk: int) -> None:
    time = Time()
    _, acceptor = pair(time)
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


def test_short_frame_is_delivered_whole() -> None:
    time = Time()
    _, acceptor = pair(time)
    payload = bytes(core_limits.CUT_THROUGH_BYTES)
    deliver(pack_data_header(len(payload), 7, 1, 99) + payload, acceptor, time.now, 50_000)
    assert acceptor.data == [(7, 1, 99, payload)]
    assert acceptor.parts == []


def test_header_alone_delivers_nothing() -> None:
    time = Time()
    _, acceptor = pair(time)
    for size in (100, limits.DATA_PAYLOAD_MAX):
        assert acceptor.receive(memoryview(pack_data_header(size, 7, 1, 99)), time.now) == (0, 24 + size)
    assert not acceptor.parts
    assert not acceptor.data


def test_an_abort_is_handed_on_as_a_part_without_bytes() -> None:
    time = Time()
    _, acceptor = pair(time)
    frames = fragments(7, 1, bytes(900), [300, 300])
    abort = Frame(FrameKind.DATA, b"", 7, 1, 99, LAST | ABORT).serialize()
    deliver(frames[0] + frames[1] + abort, acceptor, time.now, 11)
    assert [(flags, len(part)) for _, _, _, flags, part in acceptor.parts] == [
        (FIRST, 300),
        (0, 300),
        (LAST | ABORT, 0),
    ]
    assert acceptor.messages() == []


@pytest.mark.parametrize("flags", [ABORT, FIRST | ABORT, WHOLE | ABORT])
def test_an_abort_that_is_none_ends_the_link(flags: int) -> None:
    time = Time()
    _, acceptor = pair(time)
    with pytest.raises(RemoteProtocolError, match="aborts"):
        acceptor.receive(memoryview(Frame(FrameKind.DATA, b"", 7, 1, 99, flags).serialize()), time.now)
    assert acceptor.state is ConnectionState.CLOSED
    assert acceptor.parts == []


@pytest.mark.parametrize("size", [limits.DATA_PAYLOAD_MAX + 1, 0xFFFFFFFF])
@pytest.mark.parametrize("flags", [0, FIRST, LAST, WHOLE, LAST | ABORT])
def test_too_long_frame_is_refused_by_its_header(size: int, flags: int) -> None:
    time = Time()
    _, acceptor = pair(time)
    header = size.to_bytes(4, "big") + bytes([FrameKind.DATA, flags]) + bytes(18)
    with pytest.raises(LimitExceeded):
        acceptor.receive(memoryview(header), time.now)


def test_no_fragment_before_the_handshake_is_over() -> None:
    time = Time()
    acceptor = Side(ACCEPTOR, HIGH, time)
    with pytest.raises(RemoteProtocolError, match="data frame while handshaking"):
        acceptor.receive(memoryview(Frame(FrameKind.DATA, b"x", flags=FIRST).serialize()), time.now)


def test_closing_from_within_a_part_stops_the_reading() -> None:
    time = Time()
    _, acceptor = pair(time)
    got: list[int] = []

    def on_part(_route: int, _sequence: int, _stamp: int, _flags: int, part: memoryview) -> None:
        got.append(len(part))
        acceptor.lost("closed by its user")

    acceptor.routes = AnyRoute(lambda *_: acceptor.data.append((0, 0, 0, b"")), on_part)
    wire = pack_data_header(200_000, 1, 1, 0) + bytes(200_000) + pack_data_header(1, 1, 2, 0) + b"x"
    acceptor.receive(memoryview(wire[:150_000]), time.now)
    acceptor.receive(memoryview(wire[150_000:]), time.now)
    assert got == [150_000 - 24]
    assert acceptor.data == []


def test_rest_of_a_begun_frame_is_dropped_while_closing() -> None:
    time = Time()
    _, acceptor = pair(time)
    wire = pack_data_header(200_000, 1, 1, 0) + bytes(200_000)
    acceptor.receive(memoryview(wire[:150_000]), time.now)
    acceptor.close("done", time.now)
    acceptor.receive(memoryview(wire[150_000:]), time.now)
    assert len(acceptor.parts) == 1


def test_half_read_frame_renews_the_lease_only_with_bytes() -> None:
    time = Time()
    _, acceptor = pair(time)
    acceptor.receive(memoryview(pack_data_header(200_000, 1, 1, 0) + bytes(1000)), time.now)
    for _ in range(5):
        time.now += 0.9
        acceptor.receive(memoryview(bytes(1000)), time.now)
        acceptor.handle_timer(time.now)
    assert not acceptor.seen("closed")
    pass_time(acceptor, time, 1.0)
    assert acceptor.last()[0] == "closed"


@pytest.mark.parametrize("kind", [FrameKind.ACK, FrameKind.FENCE, FrameKind.FENCED])
@pytest.mark.parametrize("chunk", [1, 24, 1 << 20])
def test_marks_come_in_the_order_of_the_messages(kind: FrameKind, chunk: int) -> None:
    time = Time()
    dialler, acceptor = pair(time)
    said: list[object] = []
    for link in (dialler, acceptor):
        link.routes = AnyRoute(lambda _r, sequence, _t, _v: said.append(sequence))
    mark = Frame(kind, route=7, sequence=0xFFFFFFFF).serialize()
    wire = pack_data_header(1, 7, 1, 0) + b"x" + mark + pack_data_header(1, 7, 2, 0) + b"x"
    for link in (dialler, acceptor):
        said.clear()
        link.events = said  # type: ignore[assignment]
        deliver(wire, link, time.now, chunk)
        assert said == [1, ("mark", kind, 7, 0xFFFFFFFF), 2]
        assert not link.output, "who answers a fence is the driver's business"


@pytest.mark.parametrize("kind", [FrameKind.ACK, FrameKind.FENCE, FrameKind.FENCED])
def test_a_mark_has_no_bytes(kind: FrameKind) -> None:
    time = Time()
    _, acceptor = pair(time)
    with pytest.raises(LimitExceeded, match=kind.name.lower()):
        acceptor.receive(memoryview(bytes([0, 0, 0, 1, kind, 3]) + bytes(18)), time.now)


def test_bulk_lane_has_its_own_lease() -> None:
    time = Time()
    dialler, acceptor = pair(time, lane=Lane.BULK)
    hello, welcome = acceptor.remote, dialler.remote
    assert hello is not None
    assert welcome is not None
    assert hello.lane == welcome.lane == acceptor.lane == Lane.BULK
    assert hello.lease == welcome.lease == limits.BULK_LEASE
    pings = 0
    begin = time.now
    while time.now < begin + 100.0:
        time.now = min(t for s in (dialler, acceptor) if (t := s.next_timer()) is not None)
        for mine in (dialler, acceptor):
            mine.handle_timer(time.now)
            pings += bool(mine.output)
        exchange(dialler, acceptor, time)
    assert dialler.state is acceptor.state is ConnectionState.UP
    assert pings <= 100 * 2.1, "a bulk lane's keepalives are seldom"
