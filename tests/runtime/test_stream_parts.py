"""Messages in parts through a real socket with next to no room, and outboxes that outlive their stream."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
from collections.abc import AsyncIterator, Callable

import pytest

from rmpa.core import limits
from rmpa.core.errors import LocalProtocolError
from rmpa.core.outbox import URGENT, Framer, Outbox, QueuedMessage
from rmpa.mesh.frames import Frame, FrameKind, pack_fragment_header
from rmpa.runtime.stream import Stream
from tests import waiting
from tests.core.outbox_model import Reader, fence, payload, whole
from tests.runtime.message_streams import STREAMS, close_all

Sockets = tuple[socket.socket, socket.socket]
FRAGMENT = limits.FRAGMENT_BYTES


async def until(condition: Callable[[], bool], receiver: Receiver | None = None) -> None:
    """Wait, and say at once if the receiver has ended."""
    await waiting.until(lambda: condition() or (receiver is not None and receiver.stream.closed))
    assert condition(), receiver and receiver.ends


@pytest.fixture
async def sockets() -> AsyncIterator[Sockets]:
    """Two ends with room for a few KB between them; the streams of a test end with them."""
    pair = socket.socketpair()
    for sock in pair:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4608)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4608)
        sock.setblocking(False)
    yield pair
    close_all(*pair)


def large_outbox(frame: Framer | None = pack_fragment_header, fragment: int = FRAGMENT) -> Outbox:
    return Outbox(1 << 20, 1 << 30, frame=frame, fragment=fragment)


class Receiver:
    """Reads frames, and keeps the numbers of whole messages by route."""

    def __init__(self, sock: socket.socket) -> None:
        self.reader = Reader(longest=FRAGMENT)
        self.got: list[tuple[int, int]] = []
        self.said: list[str] = []
        self.ends: list[Exception | None] = []
        self.stream = Stream(sock, on_bytes=self.take, on_close=self.ends.append, outbox=Outbox(1, 1))
        STREAMS.append(self.stream)

    def take(self, view: memoryview) -> tuple[int, int]:
        for kind, route, number, _, what in self.reader.feed(bytes(view)):
            if what == "whole":
                self.got.append((route, number))
            self.said.append(f"{FrameKind(kind).name.lower()} {route}:{number} {what}")
        return len(view), 0


class Sender:
    """What a lane does with a stream, and what it has said so far."""

    def __init__(self, sock: socket.socket, outbox: Outbox | None = None) -> None:
        self.ends: list[Exception | None] = []
        own = Outbox(1, 1) if outbox is None else outbox
        self.stream = Stream(sock, on_bytes=lambda view: (len(view), 0), on_close=self.ends.append, outbox=own)
        if outbox is None:
            self.stream.adopt(large_outbox(), pack_fragment_header)
        STREAMS.append(self.stream)
        self.number = 0
        self.sent: list[tuple[int, int]] = []

    def send(self, key: int, size: int) -> None:
        self.number += 1
        data = whole(key, self.number, size)
        assert self.stream.send([memoryview(data)[:24], memoryview(data)[24:]], key) == 0
        self.sent.append((key, self.number))

    def mark(self, key: int) -> None:
        self.number += 1
        self.stream.send_mark(fence(key, self.number), key)
        self.sent.append((key, self.number))

    def open(self, key: int, size: int) -> Opened:
        self.number += 1
        return Opened(self, self.stream.open(key, size, self.number, size))


class Opened:
    """A message that is being sent."""

    def __init__(self, sender: Sender, parcel: QueuedMessage) -> None:
        self.sender = sender
        self.parcel = parcel
        self.given = 0

    def extend(self, size: int) -> None:
        size = min(size, self.parcel.size - self.given)
        data = payload(self.parcel.sequence, size, self.given)
        self.given += size
        assert self.sender.stream.extend(self.parcel, memoryview(bytearray(data))) == 0
        if self.done:
            self.sender.sent.append((self.parcel.key, self.parcel.sequence))

    @property
    def done(self) -> bool:
        return self.given == self.parcel.size


def by_key(messages: list[tuple[int, int]]) -> dict[int, list[int]]:
    found: dict[int, list[int]] = {}
    for key, number in messages:
        found.setdefault(key, []).append(number)
    return found


@pytest.mark.parametrize("seed", range(8))
async def test_all_that_a_lane_may_do_in_any_order(sockets: Sockets, seed: int) -> None:
    rng = random.Random(seed)
    sender, receiver = Sender(sockets[0]), Receiver(sockets[1])
    open_now: dict[int, Opened] = {}
    for _ in range(300):
        key = rng.randint(1, 3)
        opened = open_now.get(key)
        if opened is not None and rng.random() < 0.05:
            assert not sender.stream.abandon(open_now.pop(key).parcel)
        elif opened is not None:
            opened.extend(rng.choice([1, 100, 5000, 200_000]))
            if opened.done:
                del open_now[key]
        elif rng.random() < 0.4:
            open_now[key] = sender.open(key, rng.choice([1, 3000, 70_000, 150_000]))
        elif rng.random() < 0.2:
            sender.mark(key)
        else:
            sender.send(key, rng.choice([1, 100, 4000]))
        if rng.random() < 0.1:
            sender.stream.send([Frame(FrameKind.PING).serialize()], URGENT)
        if rng.random() < 0.5:
            await asyncio.sleep(rng.choice([0, 0, 0.0005]))
    for opened in open_now.values():
        while not opened.done:
            opened.extend(60_000)
    await until(lambda: not sender.stream.pending_bytes, receiver)
    await until(lambda: receiver.stream.bytes_in == sender.stream.bytes_out, receiver)
    assert by_key([m for m in receiver.got if m[0]]) == by_key(sender.sent)
    assert not receiver.reader.begun
    assert not receiver.reader.pending


class CutThrough:
    """As a bridge: takes ``[key, size, bytes]`` from one socket and hands large ones on while they arrive."""

    def __init__(self, inbound: socket.socket, sender: Sender, whole_up_to: int) -> None:
        self.sender = sender
        self.whole_up_to = whole_up_to
        self.open: tuple[QueuedMessage, int] | None = None
        self.ends: list[Exception | None] = []
        self.into = Stream(inbound, on_bytes=self.take, on_close=self.ends.append, outbox=Outbox(1, 1))
        STREAMS.append(self.into)

    def take(self, view: memoryview) -> tuple[int, int]:
        at, size = 0, len(view)
        while at < size:
            if self.open is not None:
                parcel, left = self.open
                part = view[at : at + left]
                self.sender.stream.extend(parcel, part)
                at += len(part)
                self.open = (parcel, left - len(part)) if left > len(part) else None
                continue
            if size - at < 5:
                break
            key, length = view[at], int.from_bytes(view[at + 1 : at + 5], "big")
            if length <= self.whole_up_to:
                if size - at - 5 < length:
                    break
                self.sender.number += 1
                header = whole(key, self.sender.number, length)[:24]
                self.sender.stream.send([header, view[at + 5 : at + 5 + length]], key)
                at += 5 + length
            else:
                self.sender.number += 1
                self.open = (self.sender.stream.open(key, length, self.sender.number, length), length)
                at += 5
        return at, 0


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("keys", [1, 3])
async def test_a_bridge_that_hands_on_while_it_reads(sockets: Sockets, seed: int, keys: int) -> None:
    """Small and large messages of one read, corked, where the socket takes a part of the batch or nothing."""
    rng = random.Random(seed)
    source, inbound = socket.socketpair()
    inbound.setblocking(False)
    source.setblocking(False)
    bridge = CutThrough(inbound, Sender(sockets[0]), whole_up_to=rng.choice([50, 1000, 5000]))
    receiver = Receiver(sockets[1])
    sizes = [(rng.randint(1, keys), rng.choice([1, 40, 800, 4000, 90_000])) for _ in range(150)]
    wire = b"".join(
        bytes([key]) + size.to_bytes(4, "big") + payload(number, size) for number, (key, size) in enumerate(sizes, 1)
    )
    at = 0
    while at < len(wire):
        chunk = wire[at : at + rng.choice([10, 3000, 60_000])]
        try:
            at += source.send(chunk)
        except BlockingIOError:
            await asyncio.sleep(0.0005)
        if rng.random() < 0.2:
            await asyncio.sleep(0)
    await until(lambda: len(receiver.got) == len(sizes), receiver)
    assert by_key(receiver.got) == by_key([(key, number) for number, (key, _) in enumerate(sizes, 1)])
    assert bridge.ends == receiver.ends == []
    source.close()


def stuff(sock: socket.socket) -> int:
    """Leave no room in a socket; return how many zeros that took."""
    count = 0
    with contextlib.suppress(BlockingIOError):
        while True:
            count += sock.send(bytes(100))
    return count


async def drain_zeros(sock: socket.socket, count: int) -> None:
    while count:
        got = await asyncio.get_running_loop().sock_recv(sock, min(count, 100))
        assert got
        assert not got.strip(b"\0")
        count -= len(got)


@pytest.mark.parametrize("sizes", [[10, 20, 300, 30, 400, 40], [300, 20], [10, 300], [10, 70_000, 5], [70_000, 5]])
async def test_small_messages_stay_in_front_of_a_large_one_of_the_same_read(
    sockets: Sockets, sizes: list[int]
) -> None:
    zeros = stuff(sockets[0])
    source, inbound = socket.socketpair()
    inbound.setblocking(False)
    bridge = CutThrough(inbound, Sender(sockets[0]), whole_up_to=50)
    source.send(b"".join(b"\1" + n.to_bytes(4, "big") + payload(i, n) for i, n in enumerate(sizes, 1)))
    await until(lambda: bridge.sender.stream.pending_bytes > sum(sizes))
    await drain_zeros(sockets[1], zeros)
    receiver = Receiver(sockets[1])
    await until(lambda: len(receiver.got) == len(sizes), receiver)
    assert receiver.got == [(1, n) for n in range(1, len(sizes) + 1)]
    source.close()


async def half_sent(sockets: Sockets) -> tuple[Sender, Receiver, Opened]:
    """A message of route 1 whose first 10,000 bytes had to wait, and have left; 30,000 are to come."""
    sender = Sender(sockets[0])
    zeros = stuff(sockets[0])
    opened = sender.open(1, 40_000)
    for _ in range(2):
        opened.extend(5000)
    await drain_zeros(sockets[1], zeros)
    receiver = Receiver(sockets[1])
    await until(lambda: not sender.stream.pending_bytes, receiver)
    assert sender.stream.outbox.waiting(1) == 1
    return sender, receiver, opened


# --- corked -------------------------------------------------------------------------------------------------------


class Corked:
    """Does something from within a read, as a data path does."""

    def __init__(self, action: Callable[[], None]) -> None:
        self.near, self.far = socket.socketpair()
        self.near.setblocking(False)
        self.action = action
        self.done = False
        self.stream = Stream(self.near, on_bytes=self.take, on_close=lambda _: None, outbox=Outbox(1, 1))

    def take(self, view: memoryview) -> tuple[int, int]:
        self.action()
        self.done = True
        return len(view), 0

    async def run(self) -> None:
        self.far.send(bytes(1000))  # a few bytes are not corked
        await until(lambda: self.done)
        self.stream.close()
        self.far.close()


async def test_corked_messages_follow_what_the_outbox_sends(sockets: Sockets) -> None:
    """A message that waits for its bytes, bytes for it, and others before and behind them, all in one read."""
    sender, receiver, opened = await half_sent(sockets)

    def action() -> None:
        sender.send(2, 100)
        opened.extend(30_000)
        sender.send(2, 9000)
        sender.send(3, 100)
        sender.mark(1)

    await Corked(action).run()
    await until(lambda: len(receiver.got) == len(sender.sent), receiver)
    assert by_key(receiver.got) == by_key(sender.sent)


async def test_route_closed_during_a_read_keeps_corked_messages(sockets: Sockets) -> None:
    sender, receiver, _ = await half_sent(sockets)

    def action() -> None:
        sender.send(2, 90_000)
        assert sender.stream.outbox.discard(1) == 1
        sender.stream.pump()
        sender.send(2, 9000)

    await Corked(action).run()
    await until(lambda: len(receiver.got) == 2, receiver)
    assert "data 1:1 aborted" in receiver.said


async def test_a_mark_stays_behind_what_is_corked(sockets: Sockets) -> None:
    sender, receiver = Sender(sockets[0]), Receiver(sockets[1])

    def action() -> None:
        for number in range(3):
            sender.send(1, 100 * number + 1)
            sender.mark(1)

    await Corked(action).run()
    await until(lambda: len(receiver.got) == 6, receiver)
    assert receiver.got == sender.sent


async def test_a_mark_that_has_to_wait_is_not_dropped(sockets: Sockets) -> None:
    zeros = stuff(sockets[0])
    box = Outbox(1, 1 << 20)
    sender = Sender(sockets[0], box)
    for number in (1, 2, 3, 5):
        sender.stream.send([whole(1, number, 100)], 1)
    sender.number = 5
    sender.mark(1)
    sender.stream.send([whole(1, 7, 100)], 1)
    await drain_zeros(sockets[1], zeros)
    receiver = Receiver(sockets[1])
    await until(lambda: not sender.stream.pending_bytes, receiver)
    await until(lambda: receiver.said[-1:] == ["data 1:7 whole"], receiver)
    assert "fence 1:6 whole" in receiver.said
    assert box.dropped[1] >= 3


async def test_parts_of_one_read_leave_in_one_call(sockets: Sockets) -> None:
    sizes: list[int] = []
    sender, receiver = Sender(sockets[0]), Receiver(sockets[1])
    real = sender.stream._sock

    class Counting:
        def sendmsg(self, parts: list[memoryview]) -> int:
            sizes.append(sum(map(len, parts)))
            return real.sendmsg(parts)

        def close(self) -> None:
            real.close()

    sender.stream._sock = Counting()  # type: ignore[assignment]
    opened = sender.open(1, 900)

    def action() -> None:
        sender.send(2, 50)
        for _ in range(3):
            opened.extend(300)
        sender.send(1, 50)
        assert sizes == []

    await Corked(action).run()
    assert sizes == [5 * 24 + 1000]
    await until(lambda: len(receiver.got) == 3, receiver)


# --- the end of a message that never comes ------------------------------------------------------------------------


async def test_abandoned_where_the_other_side_has_a_part_it_is_told(sockets: Sockets) -> None:
    sender, receiver = Sender(sockets[0]), Receiver(sockets[1])
    opened = sender.open(1, 900)
    opened.extend(300)
    assert sender.stream.abandon(opened.parcel) is False
    assert sender.stream.abandon(opened.parcel) is False
    opened.extend(300)
    sender.send(1, 10)
    await until(lambda: receiver.got == [(1, 2)], receiver)
    assert receiver.said == ["data 1:1 part", "data 1:1 aborted", "data 1:2 whole"]


async def test_abandoned_message_leaves_the_outbox(sockets: Sockets) -> None:
    """Its key was silent for ever: the dead message stood in front of all that followed."""
    sender, receiver, opened = await half_sent(sockets)
    assert sender.stream.abandon(opened.parcel) is False
    assert sender.stream.outbox.waiting(1) == 0
    for _ in range(50):
        sender.send(1, 4000)  # some of them have to wait
    await until(lambda: len(receiver.got) == 50, receiver)
    assert receiver.said[-51] == "data 1:1 aborted"
    assert by_key(receiver.got) == by_key(sender.sent)


async def test_one_whose_rest_waits_is_abandoned_behind_it(sockets: Sockets) -> None:
    sender = Sender(sockets[0])
    zeros = stuff(sockets[0])
    opened = sender.open(1, 900)
    for _ in range(2):
        opened.extend(300)
    assert sender.stream.abandon(opened.parcel) is False
    sender.send(1, 10)
    await drain_zeros(sockets[1], zeros)
    receiver = Receiver(sockets[1])
    await until(lambda: receiver.got == [(1, 2)], receiver)
    assert receiver.said[-2:] == ["data 1:1 aborted", "data 1:2 whole"]


@pytest.mark.parametrize("began", [0, 300])
async def test_without_headers_an_abandoned_message_costs_the_connection(sockets: Sockets, began: int) -> None:
    one = Stream(sockets[0], on_bytes=lambda view: (len(view), 0), on_close=lambda _: None, outbox=large_outbox(None))
    parcel = one.open(1, 900)
    if began:
        one.extend(parcel, bytes(began))
    assert one.abandon(parcel) is bool(began)
    whole_one = one.open(1, 100)
    one.extend(whole_one, bytes(100))
    assert one.abandon(whole_one) is False, "it is complete"
    one.close()
    assert one.abandon(parcel) is False


async def test_more_than_a_message_was_said_to_have_is_our_own_fault(sockets: Sockets) -> None:
    sender = Sender(sockets[0])
    stuff(sockets[0])
    opened = sender.open(1, 300)
    opened.extend(300)
    with pytest.raises(LocalProtocolError, match="300 bytes"):
        sender.stream.extend(opened.parcel, b"x")


# --- outboxes that outlive their stream ---------------------------------------------------------------------------


async def test_adopted_outbox_is_sent_behind_the_connections_own_bytes(sockets: Sockets) -> None:
    zeros = stuff(sockets[0])
    sender = Sender(sockets[0], Outbox(1, 1))
    sender.stream.send([Frame(FrameKind.HELLO, b"hello").serialize()], URGENT)
    box = large_outbox()
    for number in (1, 2):
        box.push(whole(7, number, 100), 7)
    big = QueuedMessage(8, 3 * limits.FRAGMENT_BYTES, 3, 3 * limits.FRAGMENT_BYTES)
    box.extend(big, payload(3, 3 * limits.FRAGMENT_BYTES))
    box.push_urgent(Frame(FrameKind.PING).serialize())
    sender.stream.adopt(box, pack_fragment_header)
    assert sender.stream.outbox is box
    sender.number = 3
    sender.send(7, 100)
    await drain_zeros(sockets[1], zeros)
    receiver = Receiver(sockets[1])
    await until(lambda: not box.pending_bytes, receiver)
    await until(lambda: len(receiver.got) == 6, receiver)
    assert receiver.said[:2] == ["hello 0:0 whole", "ping 0:0 whole"]
    assert by_key(receiver.got[2:]) == {7: [1, 2, 4], 8: [3]}
    assert receiver.said.index("data 7:4 whole") < receiver.said.index("data 8:3 whole"), "in turns"


async def test_outbox_adopted_during_a_read_is_sent_behind_it(sockets: Sockets) -> None:
    """As a welcome, which the lane's messages must not overtake."""
    sender, receiver = Sender(sockets[0], Outbox(1, 1)), Receiver(sockets[1])
    box = large_outbox()
    box.push(whole(7, 1, 100), 7)

    def action() -> None:
        sender.stream.send([Frame(FrameKind.HELLO, b"hello").serialize()], URGENT)
        sender.stream.adopt(box, pack_fragment_header)

    await Corked(action).run()
    await until(lambda: len(receiver.got) == 2, receiver)
    assert receiver.said == ["hello 0:0 whole", "data 7:1 whole"]


async def test_whole_entries_are_sent_by_the_next_connection(sockets: Sockets) -> None:
    box = large_outbox(fragment=1000)
    first = Sender(sockets[0], Outbox(1, 1))
    first.stream.adopt(box, pack_fragment_header)
    torn = first.open(1, 200_000)
    torn.extend(200_000)
    for key in (1, 2):
        first.send(key, 50)
        first.mark(key)
    await asyncio.sleep(0.01)
    sockets[1].close()
    await until(lambda: bool(first.ends))
    assert box.waiting(1) == box.waiting(2) == 2, "the stream leaves it alone"
    box.reset()
    near, far = socket.socketpair()
    near.setblocking(False)
    far.setblocking(False)
    second, receiver = Sender(near, Outbox(1, 1)), Receiver(far)
    second.stream.adopt(box, pack_fragment_header)
    await until(lambda: len(receiver.got) == 4, receiver)
    assert by_key(receiver.got) == {1: [2, 3], 2: [4, 5]}
    assert not box.pending_bytes


async def test_an_outbox_of_its_own_ends_with_the_stream(sockets: Sockets) -> None:
    sender = Sender(sockets[0], large_outbox())
    stuff(sockets[0])
    for _ in range(3):
        sender.send(1, 5000)
    sender.stream.close()
    assert not sender.stream.outbox
    assert sender.stream.pending_bytes == 0


async def test_a_stream_begins_with_what_waits_in_its_outbox(sockets: Sockets) -> None:
    box = large_outbox()
    box.push(whole(1, 1, 100), 1)
    Sender(sockets[0], box)
    receiver = Receiver(sockets[1])
    await until(lambda: receiver.got == [(1, 1)], receiver)


async def test_when_all_that_waited_was_too_old_the_stream_is_drained(sockets: Sockets) -> None:
    zeros = stuff(sockets[0])
    box = Outbox(10, 1 << 20)
    box.set_terms(1, 10, 0.02, strict=True)
    sender = Sender(sockets[0], box)
    sender.send(1, 100)
    sender.send(1, 100)
    # The first waits in part or whole; what is in the socket already is ours to read away.
    await asyncio.sleep(0.05)
    await drain_zeros(sockets[1], zeros)
    await sender.stream.drained(5)
    assert not sender.stream.pending_bytes
    assert box.expired == {1: 2}
    assert sender.stream.bytes_out == 0
    sender.send(1, 10)
    assert sender.stream.bytes_out == 34
