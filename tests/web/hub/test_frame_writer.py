"""A client's connection: its frames, its signs of life."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.web.hub.connection import CommandAge, Session
from rmpa.web.hub.frame_writer import FairQueue, FrameWriter, Opcode, frame_header
from rmpa.web.hub.node_link import READ_ONLY
from rmpa.web.server.access import FrameCheck
from tests.waiting import DEADLINE, until

# 4 MB, in which a part that is left out or twice would show.
PAYLOAD = bytes(range(251)) * 16_000


async def no_drain() -> None: ...


class Reader:
    """The client's end."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.bytes = bytearray()

    async def read(self, count: int) -> None:
        """Read until there are so many bytes in all."""
        async with asyncio.timeout(DEADLINE):
            while len(self.bytes) < count:
                data = await asyncio.get_running_loop().sock_recv(self.sock, 37_501)
                assert data, "the connection has ended"
                self.bytes += data


@contextlib.asynccontextmanager
async def connection(count: int = 1) -> AsyncIterator[list[tuple[FrameWriter, asyncio.Transport, Reader]]]:
    """So many connections; the kernel takes a few KB of each."""
    loop = asyncio.get_running_loop()
    made = []
    for _ in range(count):
        near, far = socket.socketpair()
        near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8192)
        near.setblocking(False)
        far.setblocking(False)
        transport, _ = await loop.connect_accepted_socket(asyncio.Protocol, near)
        made.append((FrameWriter(transport, no_drain), transport, Reader(far)))
    try:
        yield made
    finally:
        for writer, transport, reader in made:
            writer.close()
            transport.abort()
            reader.sock.close()
        await asyncio.sleep(0)


async def test_frames_arrive_whole_and_in_order_at_a_slow_reader() -> None:
    async with connection() as [(writer, transport, reader)]:
        expected = bytearray()
        for number in range(3):
            parts = (bytes([number]) * 13, b"", memoryview(PAYLOAD)[number:])
            writer.write(Opcode.BINARY, parts)
            expected += frame_header(Opcode.BINARY, 13 + len(PAYLOAD) - number) + b"".join(parts)
            # Behind the first bytes of a large frame, which has not left: it must not get into it.
            writer.write(Opcode.PING, ())
            writer.write(Opcode.PONG, (b"answer",))
            expected += b"\x89\x00" + b"\x8a\x06answer"
        assert writer.unsent > len(PAYLOAD)
        await reader.read(len(expected))
        assert reader.bytes == expected
        await until(lambda: writer.unsent == 0)
        writer.write(Opcode.TEXT, (b"next",))
        await reader.read(len(expected) + 6)
        assert reader.bytes[len(expected) :] == b"\x81\x04next"
        assert transport.get_write_buffer_size() == 0


async def test_drain_waits_for_the_reader_and_for_nothing_else() -> None:
    async with connection() as [(writer, _, reader)]:
        await asyncio.wait_for(writer.drain(), DEADLINE)
        writer.write(Opcode.BINARY, (PAYLOAD,))
        draining = asyncio.ensure_future(writer.drain())
        await reader.read(len(PAYLOAD) // 2)
        assert not draining.done()
        await reader.read(len(PAYLOAD))
        await asyncio.wait_for(draining, DEADLINE)


async def test_a_close_frame_that_another_writes_comes_behind_a_frame_under_way() -> None:
    async with connection() as [(writer, transport, reader)]:
        writer.write(Opcode.BINARY, (PAYLOAD,))
        draining = asyncio.ensure_future(writer.drain())
        await reader.read(100_000)
        writer.hand_over()
        transport.write(b"\x88\x02" + struct.pack("!H", 1001))
        writer.write(Opcode.PING, ())  # nothing is lost or overtakes, whatever still comes
        await asyncio.wait_for(draining, DEADLINE)
        expected = frame_header(Opcode.BINARY, len(PAYLOAD)) + PAYLOAD + b"\x88\x02\x03\xe9" + b"\x89\x00"
        await reader.read(len(expected))
        assert reader.bytes == expected


async def test_a_reader_that_goes_ends_the_connection_and_the_wait() -> None:
    async with connection() as [(writer, transport, reader)]:
        writer.write(Opcode.BINARY, (PAYLOAD,))
        draining = asyncio.ensure_future(writer.drain())
        await reader.read(100_000)
        reader.sock.close()
        await asyncio.wait_for(draining, DEADLINE)
        await until(transport.is_closing)
        writer.write(Opcode.BINARY, (PAYLOAD,))
        assert writer.is_closing
        assert writer.unsent == 0


@pytest.mark.parametrize("by_close", [True, False])
async def test_nothing_is_written_to_a_connection_that_was_closed(by_close: bool) -> None:
    async with connection() as [(writer, transport, reader)]:
        writer.write(Opcode.BINARY, (PAYLOAD,))
        draining = asyncio.ensure_future(writer.drain())
        await asyncio.sleep(0)
        if by_close:
            writer.close()
        transport.abort()
        with contextlib.suppress(AssertionError):
            await reader.read(len(PAYLOAD))
        assert len(reader.bytes) < len(PAYLOAD)
        await asyncio.wait_for(draining, DEADLINE)


@pytest.mark.parametrize(
    ("size", "header"),
    [(0, "8100"), (125, "817d"), (126, "817e007e"), (65535, "817effff"), (65536, "817f0000000000010000")],
)
def test_header_of_a_text_frame(size: int, header: str) -> None:
    """The lengths of RFC 6455, section 5.2."""
    assert frame_header(Opcode.TEXT, size).hex() == header


_SIZES = (0, 1, 125, 126, 65535, 65536)


def _masked(size: int) -> bytes:
    header = bytearray(frame_header(Opcode.BINARY, size))
    header[1] |= 0x80
    return bytes(header) + b"mask" + bytes(size)


@pytest.mark.parametrize("step", [1, 3, 1000, 1 << 20])
def test_a_frame_without_a_mask_is_found_wherever_it_begins(step: int) -> None:
    data = b"".join(map(_masked, _SIZES))
    for unmasked in (b"", b"\x81\x00", b"\x81\x7e"):
        check, whole = FrameCheck(), data + unmasked
        passed = [check.passes(whole[at : at + step], 0.0) for at in range(0, len(whole), step)]
        assert all(passed) is (unmasked == b"")


def _all(queue: FairQueue[str]) -> list[str]:
    found = []
    while (entry := queue.pop()) is not None:
        found.append(entry)
    return found


@pytest.mark.parametrize(
    ("total", "each", "pushed", "left", "dropped"),
    [
        # Subscriptions take turns, however many messages one has.
        (100, 100, [(1, "a", 10, 0), (1, "b", 10, 0), (1, "c", 10, 0), (2, "z", 1, 0)], "azbc", {}),
        # Higher priorities go first, and what is urgent before all.
        (100, 100, [(1, "l", 1, -1), (2, "n", 1, 0), (3, "h", 1, 1), (None, "u", 1, 0)], "uhnl", {}),
        # A full subscription drops its oldest and keeps its newest.
        (100, 10, [(1, "a", 6, 0), (1, "b", 6, 0), (1, "c", 50, 0)], "c", {1: 2}),
        # Images do not push out small state.
        (100, 100, [(1, "s", 1, 0), *((2, str(number), 30, 0) for number in range(10))], "s789", {2: 7}),
        # A low priority gives way to a high one.
        (10, 10, [(1, "l", 8, -1), (2, "h", 8, 1), (1, "m", 8, -1)], "h", {1: 2}),
        # One message that is larger than the bound is sent.
        (10, 5, [(1, "small", 3, 0), (2, "!", 100, 0)], "!", {1: 1}),
    ],
)
def test_what_waits_goes_in_turn_and_by_priority_and_is_bounded(
    total: int, each: int, pushed: list[Any], left: str, dropped: dict[int, int]
) -> None:
    queue: FairQueue[str] = FairQueue(total, each)
    for entry in pushed:
        queue.push(*entry)
    assert queue.bytes <= total or len(left) == 1
    assert ("".join(_all(queue)), queue.dropped) == (left, dropped)


def test_what_is_urgent_is_never_dropped_and_its_overflow_shows() -> None:
    queue: FairQueue[str] = FairQueue(total_bytes=10, subscription_bytes=10)
    queue.push(1, "message", 8)
    queue.push(None, "one", 6)
    before = queue.overflow
    queue.push(None, "two", 6)
    assert (before, queue.overflow) == (False, True)
    assert (_all(queue), queue.dropped) == (["one", "two"], {1: 1})


def test_what_an_ended_subscription_had_is_not_sent() -> None:
    queue: FairQueue[str] = FairQueue()
    queue.push(1, "a", 1)
    queue.push(2, "b", 1)
    queue.end(1)
    queue.end(7)
    assert (queue.bytes, _all(queue)) == (1, ["b"])


def _paced(interval: float, length: int, *times: float) -> FairQueue[float]:
    """A queue with entries that came at these times, and were taken as soon as they may be."""
    queue: FairQueue[float] = FairQueue(total_bytes=100)
    queue.pace(1, interval, length)
    for time in times:
        queue.push(1, time, 1, now=time)
        if queue.due is None or queue.due <= time:
            queue.pop(time)
    return queue


@pytest.mark.parametrize(
    ("interval", "length", "times", "later"),
    [
        (0.0, 0, (0.0, 0.1, 0.2), []),  # without an interval all go at once
        (1.0, 0, (0.0, 0.1, 0.9), []),  # without a queue what comes meanwhile is left out
        (1.0, 2, (0.0, 0.1, 0.2, 0.3), [(1.0, 0.2), (2.0, 0.3)]),  # a full queue leaves its oldest out
    ],
)
def test_a_subscription_has_its_messages_at_its_pace(
    interval: float, length: int, times: tuple[float, ...], later: list[tuple[float, float]]
) -> None:
    queue = _paced(interval, length, *times)
    for due, entry in later:
        assert (queue.due, queue.pop(due - 0.01), queue.pop(due)) == (due, None, entry)
    assert (queue.due, queue.bytes, queue.dropped_total) == (None, 0, 0)


def test_another_pace_takes_effect_at_once_and_holds_up_no_other_subscription() -> None:
    queue = _paced(10.0, 3, 0.0, 0.0, 0.1, 0.2)
    queue.push(2, 7.0, 1, now=0.3)
    assert (queue.pop(0.3), queue.pop(0.3)) == (7.0, None)
    queue.pace(1, 1.0, 2)
    assert (queue.due, queue.waiting) == (1.0, {1: 2})
    queue.pace(1, 0.0, 2)
    assert (queue.due, queue.pop(0.4), queue.pop(0.4)) == (None, 0.1, 0.2)


@given(
    st.lists(
        st.one_of(
            st.tuples(st.integers(0, 4), st.integers(0, 60), st.integers(-1, 1)), st.just("pop"), st.integers(1, 4)
        )
    )
)
def test_bytes_are_counted_and_bounded_and_order_is_kept(steps: list[tuple[int, int, int] | str | int]) -> None:
    queue: FairQueue[tuple[int, int]] = FairQueue(total_bytes=100, subscription_bytes=50)
    inside: dict[tuple[int, int], int] = {}
    last: dict[int, int] = {}
    for number, step in enumerate(steps):
        if isinstance(step, tuple):
            handle, size, priority = step
            queue.push(handle or None, (handle, number), size, priority)
            inside[handle, number] = size
        elif isinstance(step, int):
            queue.end(step)
        elif (entry := queue.pop()) is not None:
            assert entry[1] > last.get(entry[0], -1)
            last[entry[0]] = entry[1]
        assert queue.bytes <= 100 or queue.overflow or sum(queue.waiting.values()) == 1
    while (entry := queue.pop()) is not None:
        assert entry in inside
    assert queue.bytes == 0
    assert queue.pop() is None


class Silent(Session):
    """A protocol without messages."""

    def opened(self) -> None: ...

    def received_frame(self, data: str | bytes, now: float) -> None: ...

    def warn(self, text: str, subject: str) -> None: ...


class Transport:
    """A transport with so many bytes waiting, look by look; the last number stays."""

    def __init__(self, *waiting: int) -> None:
        self.waiting = list(waiting)
        self.looks = 0
        self.written = b""
        self.aborted = False

    def get_write_buffer_size(self) -> int:
        self.looks += 1
        return self.waiting.pop(0) if len(self.waiting) > 1 else self.waiting[0]

    def is_closing(self) -> bool:
        return self.aborted

    def get_extra_info(self, _: str) -> None:
        return None

    def write(self, data: bytes) -> None:
        self.written += data

    def abort(self) -> None:
        self.aborted = True


async def forever() -> None:
    await asyncio.Event().wait()


async def watched(transport: Transport) -> None:
    hub: Any = None
    connection = Silent(hub, READ_ONLY, "here").connection
    played: Any = transport
    connection._transport = played
    connection._out = FrameWriter(played, forever)
    await asyncio.wait_for(connection._watch(), DEADLINE)


async def test_a_client_that_answers_no_ping_is_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.web.limits.PING_INTERVAL", 0.002)
    transport = Transport(0)
    await watched(transport)
    assert transport.aborted
    assert transport.written.startswith(b"\x89\x00")
    assert transport.looks == 4


async def test_a_large_message_that_goes_on_is_a_sign_of_life(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.web.limits.PING_INTERVAL", 0.002)
    transport = Transport(*range(1000, 100, -100))
    await watched(transport)
    assert transport.aborted
    assert transport.looks == 9 + 3
    assert transport.written == b""


def test_a_message_arrives_until_its_last_fragment_whatever_comes_between_them() -> None:
    check = FrameCheck()
    fragment, ping, last = b"\x01\x82maskab", b"\x89\x84maskping", b"\x80\x80mask"
    for now, data, since in (
        (1.0, fragment[:1], 1.0),
        (2.0, fragment[1:], 1.0),
        (3.0, ping + b"\x00" + fragment[1:], 1.0),
        (4.0, last[:-1], 1.0),
        (5.0, last[-1:], None),
        (6.0, ping, None),  # no message
        (7.0, last + fragment, 7.0),
    ):
        assert check.passes(data, now)
        assert check.since == since


def test_a_frame_is_younger_than_the_last_ping_that_was_answered_before_it() -> None:
    age = CommandAge(10.0)
    assert age.bound(10.5) == 0.5  # since the handshake
    first, second, third = age.ping(11.0), age.ping(11.1), age.ping(11.2)
    assert first is not None
    assert second is not None
    assert third is not None
    assert age.bound(11.2) == pytest.approx(1.2)
    age.pong(second)  # a client may answer the newest alone
    assert age.bound(11.3) == pytest.approx(0.2)
    for payload in (first, second, b"", b"mine", b"12345"):
        age.pong(payload)
    assert age.bound(11.3) == pytest.approx(0.2)
    age.pong(third)
    assert age.bound(60.0) == pytest.approx(48.8)


def test_no_more_pings_wait_than_some_while_a_cut_lasts() -> None:
    age = CommandAge(0.0)
    pings = [ping for second in range(60) if (ping := age.ping(float(second))) is not None]
    assert len(pings) == 8
    age.pong(pings[-1])
    assert age.bound(60.0) == 53.0
    assert age.ping(60.0) is not None
