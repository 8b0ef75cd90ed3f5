"""Fuzz target: what a peer sends on a route, whole or in parts, on its way to local subscribers."""

from __future__ import annotations

from typing import Any

from rmpa.bridge.data.reception import ImportFlow, LinkTime
from rmpa.core.contract import Contract, Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import Guid, Identity
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.core.statistics import Counters
from rmpa.mesh.frames import WHOLE, Frame, FrameKind, Hello
from rmpa.ros import limits
from tests.mesh.worlds import ACCEPTOR, AnyRoute, Side, Time
from tests.simulation.network import World
from tests.simulation.process import Process

_OURS = Identity(Guid.of("10.0.0.2", 40002, 1), b"O" * 16, "ours")
_THEIRS = Identity(Guid.of("10.0.0.1", 40001, 7), bytes(range(16)), "base")
_HELLO = Frame(FrameKind.HELLO, Hello.of(_THEIRS, lease=1.0, expected=_OURS.guid).serialize()).serialize()


def _wire(*frames: tuple[int, int, bytes]) -> bytes:
    return b"".join(Frame(FrameKind.DATA, part, 1, number, 9, flags).serialize() for number, flags, part in frames)


_WHOLE = (1, WHOLE, b"\x02\0\0\0ab")
_PARTS = ((2, FIRST, b"\x08\0\0\0ab"), (2, 0, b"cd"), (2, LAST, b"efgh"))

SEEDS: list[bytes] = [
    b"",
    b"B" + _wire(_WHOLE, *_PARTS, (3, WHOLE, b"\0\0\0\0")),
    b"R" + _wire(_WHOLE, *_PARTS, (3, WHOLE, b"\0\0\0\0")),
    b"B" + _wire(*_PARTS[:2], (2, LAST | ABORT, b""), (3, WHOLE, b"\x01\0\0\0x")),
    b"R" + _wire(*_PARTS[:2], (2, LAST | ABORT, b""), (3, WHOLE, b"\x01\0\0\0x")),
    b"B" + _wire((1, FIRST, b"\x04\0"), (1, LAST, b"\0\0abcd")),
    b"B" + _wire(*_PARTS[:2], _WHOLE, _PARTS[2], *_PARTS[:1], *_PARTS),
    b"R" + _wire(*_PARTS[:2], _WHOLE, _PARTS[2], *_PARTS[:1], *_PARTS),
    b"B" + _wire((0xFFFFFFFF, WHOLE, b"\0\0\0\0"), (0, FIRST, b"\xff\xff\xff\x0f"), (1, WHOLE, b"\0\0\0\0")),
    b"R" + _wire((0xFFFFFFFF, WHOLE, b"\0\0\0\0"), (0, FIRST, b"\xff\xff\xff\x0f"), (1, WHOLE, b"\0\0\0\0")),
]


class _Subscribers(Any):  # type: ignore[misc] # a double of what is much larger
    """What a publication must be able to rely on."""

    def __init__(self) -> None:
        self.size = 0
        # Bytes of the message that comes in parts; -1: none does.
        self.got = -1

    def publish_framed(self, framed: bytes | bytearray | memoryview) -> None:
        if self.got >= 0:
            raise AssertionError("a message in the middle of another one")
        self._check(len(framed), bytes(framed[:4]))

    def begin(self, size: int) -> None:
        if self.got >= 0:
            raise AssertionError("a message begins in the middle of another one")
        if not 4 <= size <= limits.MESSAGE_MAX:
            raise AssertionError(f"a message of {size} bytes")
        self.size, self.got = size, 0

    def extend(self, part: bytes | bytearray | memoryview) -> None:
        if self.got < 0:
            raise AssertionError("a part of no message")
        if self.got == 0:
            self._check(self.size, bytes(part[:4]))
        self.got += len(part)
        if self.got > self.size:
            raise AssertionError(f"{self.got} bytes of a message of {self.size}")
        if self.got == self.size:
            self.got = -1

    def abort(self) -> int:
        was, self.got = self.got, -1
        return int(was >= 0)

    def mark(self, kind: FrameKind, route: int, sequence: int) -> None:
        """Of the link: an acknowledgement."""

    def _check(self, size: int, head: bytes) -> None:
        if len(head) < 4 or int.from_bytes(head, "little") != size - 4:
            raise AssertionError("what a subscriber reads is not one message")


def fuzz(data: bytes) -> None:
    """Whole messages, one after the other, or a documented error; at the end nobody holds half of one."""
    Process(World(1), "fuzz").run(_fuzz, data)  # type: ignore[abstract]


def _fuzz(data: bytes) -> None:
    subscribers = _Subscribers()
    reliable = data[:1] == b"R"
    contract = Contract(reliability=Reliability.RELIABLE if reliable else Reliability.BEST_EFFORT)
    flow = ImportFlow(subscribers, contract, LinkTime(), Counters(), lambda _: None, lambda: None)
    flow.bind(subscribers, 1, int(reliable), 1)

    link = Side(ACCEPTOR, _OURS, Time())
    link.routes = AnyRoute(lambda _, *message: flow.message(*message), lambda _, *part: flow.part(*part))
    link.receive(memoryview(_HELLO), 0.0)
    wire = data[1:]
    try:
        taken, _ = link.receive(memoryview(wire[: len(wire) // 2]), 0.0)
        link.receive(memoryview(wire[taken:]), 0.0)
    except RemoteProtocolError as error:
        str(error)
    flow.torn()
    if subscribers.got >= 0:
        raise AssertionError("half a message stays where it is")
    flow.message(flow_next(flow, reliable), 9, memoryview(b"\0\0\0\0"))
    flow.close()


def flow_next(flow: ImportFlow, reliable: bool) -> int:
    """A number that the flow takes."""
    position = flow.position
    return ((position[1] if reliable and position else 0x40000000) + 1) & 0xFFFFFFFF
