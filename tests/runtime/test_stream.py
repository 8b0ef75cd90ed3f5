"""Streams of messages over real sockets."""

from __future__ import annotations

import asyncio
import errno
import logging
import math
import socket

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rmpa.bridge.topics.part import STALE_TICK
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.limits import KIB, MIB
from rmpa.core.outbox import URGENT, Outbox
from rmpa.runtime import limits
from rmpa.runtime.loop import AgentLoop
from rmpa.runtime.stream import LATER, CollectedSends, Stream, after_read
from rmpa.runtime.tls import Buffer, unsent
from tests.runtime.message_streams import End
from tests.waiting import until

Sockets = tuple[socket.socket, socket.socket]


async def test_all_sizes_in_order_both_ways_through_full_buffers(sockets: Sockets) -> None:
    one, other = End(sockets[0]), End(sockets[1])
    sizes = [0, 1, 3, 100, 65532, 65533, 200_000, 3 * MIB, 5, 9 * MIB, 7] * 2
    messages = [bytes([i]) * size for i, size in enumerate(sizes)]
    for message in messages:
        one.send(message)
        other.send(message[::-1])
    await until(lambda: len(one.got) == len(other.got) == len(messages))
    assert other.got == one.got == messages
    assert one.stream.bytes_out == other.stream.bytes_in == sum(sizes) + 4 * len(sizes)
    assert not one.stream.pending_bytes
    assert len(one.stream._buffer) <= 4 * MIB, "a large buffer is given back"


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    sizes=st.lists(st.one_of(st.integers(0, 300), st.integers(60_000, 300_000)), max_size=12),
    cut=st.integers(1, 9999),
)
def test_any_messages_in_any_pieces(sizes: list[int], cut: int) -> None:
    messages = [bytes([i]) * size for i, size in enumerate(sizes)]
    wire = b"".join(len(m).to_bytes(4, "big") + m for m in messages)
    cut = max(cut, len(wire) // 2000)  # megabytes byte by byte take a minute, and prove nothing else

    async def run() -> list[bytes]:
        left, right = socket.socketpair()
        end = End(right)
        for start in range(0, len(wire), cut):
            end.stream.feed(wire[start : start + cut])
        end.stream.close()
        left.close()
        return end.got

    assert asyncio.run(run()) == messages


async def test_a_claim_is_not_allocated(sockets: Sockets) -> None:
    end = End(sockets[1])
    sockets[0].sendall((200 * MIB).to_bytes(4, "big") + bytes(1000))
    await until(lambda: end.stream.bytes_in == 1004)
    assert len(end.stream._buffer) <= 64 * KIB
    before = end.stream.last_in
    offered = len(end.offered)
    sockets[0].sendall(bytes(10))
    await until(lambda: end.stream.bytes_in == 1014)
    assert end.stream.last_in > before
    assert len(end.offered) == offered, "half a message is not offered again and again"


async def test_slow_reader_costs_bounded_memory_and_gets_whole_messages(sockets: Sockets) -> None:
    sockets[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)
    sockets[1].setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    one = End(sockets[0], Outbox(10, 4 * MIB))
    dropped = sum(one.send(b"%06d" % i + bytes(100_000)) for i in range(300))
    one.send(b"urgent", URGENT)
    assert dropped > 100
    assert one.stream.pending_bytes <= 4 * MIB
    other = End(sockets[1])
    await until(lambda: not one.stream.pending_bytes and one.stream.bytes_out == other.stream.bytes_in)
    numbers = [int(m[:6]) for m in other.got if m != b"urgent"]
    assert numbers == sorted(numbers)
    assert len(numbers) == 300 - dropped
    assert numbers[-1] == 299
    assert b"urgent" in other.got[:-5]


async def test_ends_are_told_once_and_not_after_close(sockets: Sockets) -> None:
    one, other = End(sockets[0]), End(sockets[1])
    one.stream.close()
    await until(lambda: other.ends == [None])
    assert other.stream.closed
    assert other.send(b"x") == 0
    other.stream.feed(b"x")
    assert one.ends == []


async def test_a_reader_may_leave_bytes_for_later_turns_in_which_nothing_else_is_read(sockets: Sockets) -> None:
    seen: list[str] = []

    def take_one(view: memoryview) -> tuple[int, int]:
        seen.append(bytes(view[:1]).decode())
        asyncio.get_running_loop().call_soon(seen.append, "another")
        return 1, LATER if len(view) > 1 else 0

    def end(_: Exception | None) -> None:
        seen.append("end")

    sockets[0].setblocking(False)
    stream = Stream(sockets[0], on_bytes=take_one, on_close=end, outbox=Outbox(1, KIB))
    sockets[1].send(b"abc")
    sockets[1].close()  # what was sent before the end is read before it
    await until(lambda: "end" in seen)
    assert [word for word in seen if word != "another"] == ["a", "b", "c", "end"]
    assert seen.index("another") < seen.index("c")
    stream.close()


async def test_finish_lets_what_waits_leave_and_reads_on(sockets: Sockets) -> None:
    one = End(sockets[0])
    one.send(bytes(8 * MIB))
    one.stream.finish()
    assert one.send(b"late") == 0
    other = End(sockets[1])
    await until(lambda: other.ends == [None])
    assert len(other.got) == 1
    await until(lambda: one.ends == [None])


async def test_a_failed_send_is_told_from_the_loop(sockets: Sockets) -> None:
    one = End(sockets[0])

    class Broken:
        def sendmsg(self, _parts: object) -> int:
            raise OSError(errno.EPIPE, "Broken pipe")

        def close(self) -> None:
            sockets[0].close()

    one.stream._sock = Broken()  # type: ignore[assignment]
    assert one.send(b"x") == 0
    assert one.ends == []
    assert one.stream.closed
    await until(lambda: len(one.ends) == 1)
    assert isinstance(one.ends[0], OSError)


async def test_close_after_a_failed_send_is_silent(sockets: Sockets) -> None:
    one = End(sockets[0])
    one.stream.lost(OSError())
    one.stream.close()
    await asyncio.sleep(0)
    assert one.ends == []


async def test_a_protocol_error_and_a_bug_close_the_connection(
    sockets: Sockets, caplog: pytest.LogCaptureFixture
) -> None:
    one, other = End(sockets[0]), End(sockets[1])

    def bug(_message: bytes) -> None:
        raise ZeroDivisionError

    one.on_message = bug
    sockets[0].setblocking(False)
    with caplog.at_level(logging.ERROR):
        other.send(b"x")
        await until(lambda: len(one.ends) == 1)
    assert isinstance(one.ends[0], ZeroDivisionError)
    assert "a reader of bytes failed" in caplog.text
    await until(lambda: len(other.ends) == 1)


async def test_garbage_ends_with_its_error(sockets: Sockets) -> None:
    one = End(sockets[0])
    sockets[1].sendall(b"\xff" * 4)
    await until(lambda: len(one.ends) == 1)
    assert isinstance(one.ends[0], RemoteProtocolError)


async def test_closing_from_within_a_callback(sockets: Sockets) -> None:
    one = End(sockets[0])
    one.on_message = lambda _m: one.stream.close()
    sockets[1].sendall(b"\0\0\0\1x" * 3)
    await until(lambda: one.stream.closed)
    assert one.ends == []


async def test_drained_waits_for_the_last_byte_and_not_for_ever(sockets: Sockets) -> None:
    one = End(sockets[0])
    await one.stream.drained()
    one.send(bytes(16 * MIB))
    await one.stream.drained(0.01)
    assert one.stream.pending_bytes
    End(sockets[1])
    await asyncio.gather(one.stream.drained(20), one.stream.drained(20))
    assert not one.stream.pending_bytes


class Counted(socket.socket):
    """A socket that keeps how many bytes each ``sendmsg`` was given."""

    calls: list[int]

    def sendmsg(self, buffers, *rest):  # type: ignore[no-untyped-def]
        parts = list(buffers)
        self.calls.append(sum(map(len, parts)))
        return super().sendmsg(parts, *rest)


def counted(sock: socket.socket) -> Counted:
    made = Counted(fileno=sock.detach())
    made.setblocking(False)
    made.calls = []
    return made


class Relay:
    """Hands each message that ``inbound`` brings on to ``outbound``, as views of the read buffer."""

    def __init__(self, inbound: socket.socket, outbound: socket.socket, outbox: Outbox | None = None) -> None:
        inbound.setblocking(False)
        box = Outbox(1 << 20, 1 << 30) if outbox is None else outbox
        self.out = Stream(outbound, on_bytes=lambda view: (len(view), 0), on_close=self.ended, outbox=box)
        self.into = Stream(inbound, on_bytes=self.take, on_close=self.ended, outbox=Outbox(1, 1))

    def ended(self, error: Exception | None) -> None:
        raise AssertionError(error)

    def take(self, view: memoryview) -> tuple[int, int]:
        at = 0
        while len(view) - at >= 4:
            end = at + 4 + int.from_bytes(view[at : at + 4], "big")
            if end > len(view):
                return at, end - at
            self.out.send([view[at : at + 4], view[at + 4 : end]], 1)
            at = end
        return at, 0

    def close(self) -> None:
        self.into.close()
        self.out.close()


async def test_messages_of_one_read_leave_in_one_call(sockets: Sockets) -> None:
    left, right = socket.socketpair()
    target = counted(sockets[0])
    relay, end = Relay(right, target), End(sockets[1])
    messages = [b"%d" % i for i in range(100)]
    left.send(b"".join(len(m).to_bytes(4, "big") + m for m in messages))
    await until(lambda: len(end.got) == 100)
    assert end.got == messages
    assert len(target.calls) == 1
    left.send(b"\0\0\0\1x")
    await until(lambda: len(end.got) == 101)
    assert target.calls[1:] == [5]
    relay.close()
    end.stream.close()
    left.close()


async def test_messages_that_are_collected_leave_in_one_call(sockets: Sockets) -> None:
    target = counted(sockets[0])
    one, end = End(target), End(sockets[1])
    with CollectedSends():
        for i in range(50):
            one.send(b"%d" % i)
        with CollectedSends():
            one.send(b"inner")
    one.send(b"after")
    await until(lambda: len(end.got) == 52)
    assert end.got == [*(b"%d" % i for i in range(50)), b"inner", b"after"]
    assert len(target.calls) == 2


def test_what_is_left_for_the_end_of_a_read_is_called_once_there_also_of_one_within_another() -> None:
    called: list[str] = []
    after_read(lambda: called.append("no read"))
    assert called == ["no read"]
    with CollectedSends():
        after_read(lambda: called.append("outer"))
        with CollectedSends():
            after_read(lambda: called.append("inner"))
        assert called == ["no read", "inner"]
    assert called == ["no read", "inner", "outer"]


async def test_batches_keep_order_and_bytes_through_full_buffers(sockets: Sockets) -> None:
    sockets[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 32768)
    left, right = socket.socketpair()
    relay, source = Relay(right, counted(sockets[0])), End(left)
    messages = [b"%d " % i * (i % 97) for i in range(20_000)]
    for message in messages:
        source.send(message)
    await until(lambda: bool(relay.out.pending_bytes))  # nobody reads yet
    end = End(sockets[1])
    await until(lambda: len(end.got) == len(messages))
    assert end.got == messages
    assert not relay.out.pending_bytes
    relay.close()
    source.stream.close()


async def test_messages_of_a_read_are_sent_before_a_close_in_it(sockets: Sockets) -> None:
    """As a publisher refuses a subscriber: an error header, then the end."""
    one, other = End(sockets[0]), End(sockets[1])

    def refuse(_message: bytes) -> None:
        one.send(b"no")
        one.send(b"never")
        one.stream.close()

    one.on_message = refuse
    other.send(b"may I?")
    await until(lambda: bool(other.ends))
    assert other.got == [b"no", b"never"]
    assert other.ends == [None]


@pytest.mark.parametrize("size", [5, 600])
async def test_a_read_within_a_read_moves_nothing_that_still_waits(sockets: Sockets, size: int) -> None:
    """A reader feeds another stream whose messages go to the same target; views of both must stay whole."""
    target, end = counted(sockets[0]), End(sockets[1])
    (a_far, a_near), (b_far, b_near) = socket.socketpair(), socket.socketpair()
    first = Relay(a_near, target)
    inner: list[bytes] = [b"inner 1", b"inner 2", b"the beginning of inner 3"]
    wire = b"".join(len(m).to_bytes(4, "big") + m for m in inner)
    b_near.setblocking(False)
    second = Stream(b_near, on_bytes=first.take, on_close=first.ended, outbox=Outbox(1, 1))
    take = first.take

    def both(view: memoryview) -> tuple[int, int]:
        taken = take(view)
        second.feed(wire[:-10])
        second.feed(wire[-10:])
        return taken

    first.into._on_bytes = both
    a_far.send(size.to_bytes(4, "big") + b"o" * size)
    await until(lambda: len(end.got) == 4)
    assert end.got == [b"o" * size, *inner]
    second.close()
    first.close()
    end.stream.close()
    a_far.close()
    b_far.close()


PARTS: list[Buffer] = [b"ab", b"", memoryview(b"cde"), bytearray(b"f")]
WHOLE = b"abcdef"


def test_each_cut_leaves_the_rest() -> None:
    for sent in range(len(WHOLE) + 1):
        left = unsent(PARTS, sent)
        assert b"".join(left) == WHOLE[sent:]
        assert all(len(part) for part in left[1:]) or sent == 0


def test_whole_parts_are_not_copied() -> None:
    assert unsent(PARTS, 2)[-1] is PARTS[-1]


def after(silence: float, paused: float = 0.0) -> float:
    """Let a stream hear nothing, while the loop is awake, then while it has no CPU: ``resumed_at`` from between."""

    async def watch() -> float:
        near, far = socket.socketpair()
        end = End(near)
        loop = asyncio.get_running_loop()
        end_of_silence = loop.time() + silence
        while loop.time() < end_of_silence:
            await asyncio.sleep(STALE_TICK)
        began = loop.time()
        while loop.time() < began + paused:
            pass  # as a process that gets no CPU
        far.send(b"\0\0\0\1x")
        await until(lambda: end.got)
        end.stream.close()
        far.close()
        return end.stream.resumed_at - began

    with asyncio.Runner(loop_factory=AgentLoop) as runner:
        return runner.run(watch())


def test_a_silence_that_was_watched_ends_with_the_next_bytes() -> None:
    assert after(3 * limits.STALE_AGE) > -limits.STALE_AGE


def test_a_pause_is_none() -> None:
    assert after(0.0) == -math.inf


def test_silence_ends_where_a_pause_of_this_process_begins() -> None:
    # What was sent during the pause did not wait for the network.
    assert -limits.STALE_AGE < after(2 * limits.STALE_AGE, 2 * limits.STALE_AGE) <= 0.0
