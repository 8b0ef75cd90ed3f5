"""Messages in parts through a real socket with next to no room, and outboxes that outlive their stream."""

from __future__ import annotations

import asyncio
import random
import socket
from typing import TYPE_CHECKING

import pytest

from rmpa.core import limits
from rmpa.core.aio.stream import Stream
from rmpa.core.outbox import URGENT, Outbox, Parcel
from rmpa.mesh.frames import Frame, Kind, pack_fragment_header
from tests.core.outbox_model import Reader, fence, payload, whole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.core.outbox import Framer

Sockets = tuple[socket.socket, socket.socket]
FRAGMENT = limits.FRAGMENT_BYTES


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not condition():
            await asyncio.sleep(0.001)


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    """Two ends with room for a few KB between them."""
    pair = socket.socketpair()
    for sock in pair:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4608)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4608)
        sock.setblocking(False)
    yield pair
    for sock in pair:
        sock.close()


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

    def take(self, view: memoryview) -> tuple[int, int]:
        for kind, route, number, _, what in self.reader.feed(bytes(view)):
            if what == "whole":
                self.got.append((route, number))
            self.said.append(f"{Kind(kind).name.lower()} {route}:{number} {what}")
        return len(view), 0


class Sender:
    """What a lane does with a stream, and what it has said so far."""

    def __init__(self, sock: socket.socket, outbox: Outbox | None = None) -> None:
        self.ends: list[Exception | None] = []
        box = large_outbox() if outbox is None else outbox
        self.stream = Stream(
            sock,
            on_bytes=lambda view: (len(view), 0),
            on_close=self.ends.append,
            outbox=box,
            frame=pack_fragment_header,
        )
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

    def __init__(self, sender: Sender, parcel: Parcel) -> None:
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
            sender.stream.send([Frame(Kind.PING).serialize()], URGENT)
        if rng.random() < 0.5:
            await asyncio.sleep(rng.choice([0, 0, 0.0005]))
    for opened in open_now.values():
        while not opened.done:
            opened.extend(60_000)
    await until(lambda: not sender.stream.pending_bytes and receiver.stream.bytes_in == sender.stream.bytes_out)
    assert by_key([m for m in receiver.got if m[0]]) == by_key(sender.sent)
    assert not receiver.reader.begun
    assert not receiver.reader.pending
    sender.stream.close()
    receiver.stream.close()


class CutThrough:
    """As a bridge: takes ``[key, size, bytes]`` from one socket and hands large ones on while they arrive."""

    def __init__(self, inbound: socket.socket, sender: Sender, whole_up_to: int) -> None:
        self.sender = sender
        self.whole_up_to = whole_up_to
        self.open: tuple[Parcel, int] | None = None
        self.ends: list[Exception | None] = []
        self.into = Stream(inbound, on_bytes=self.take, on_close=self.ends.append, outbox=Outbox(1, 1))

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
    await until(lambda: len(receiver.got) == len(sizes))
    assert by_key(receiver.got) == by_key([(key, number) for number, (key, _) in enumerate(sizes, 1)])
    assert bridge.ends == receiver.ends == []
    for stream in (bridge.into, bridge.sender.stream, receiver.stream):
        stream.close()
    source.close()


async def test_small_messages_in_front_of_a_large_one_of_the_same_read_stay_in_front(sockets: Sockets) -> None:
    with pytest.raises(BlockingIOError):
        while True:
            sockets[0].send(bytes(100))
    source, inbound = socket.socketpair()
    inbound.setblocking(False)
    bridge = CutThrough(inbound, Sender(sockets[0]), whole_up_to=50)
    sizes = [10, 20, 300, 30, 400, 40]
    source.send(b"".join(b"\1" + n.to_bytes(4, "big") + payload(i, n) for i, n in enumerate(sizes, 1)))
    await until(lambda: bridge.sender.stream.pending_bytes > sum(sizes))
    sockets[1].setblocking(False)
    with pytest.raises(BlockingIOError):
        while True:
            await asyncio.sleep(0)
            if not sockets[1].recv(100).strip(b"\0"):
                continue
            raise AssertionError("the bytes in front were zeros")
    receiver = Receiver(sockets[1])
    await until(lambda: len(receiver.got) == len(sizes))
    assert receiver.got == [(1, n) for n in range(1, 7)]
    for stream in (bridge.into, bridge.sender.stream, receiver.stream):
        stream.close()
    source.close()
