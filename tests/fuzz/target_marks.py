"""Fuzz target: acknowledgements, answers to fences and positions that a peer makes up, between real messages."""

from __future__ import annotations

import struct
from typing import Any

from rmpa.bridge.data.route_sender import ReliableRouteSender, RouteSender
from rmpa.core.contract import Contract, Priority, Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.outbox import QueuedMessage
from tests.simulation.network import World
from tests.simulation.process import Process

_MARK = struct.Struct(">cI")
_SMALL = bytes(100)
_LARGE = bytes(20_000)


def _marks(*marks: tuple[bytes, int]) -> bytes:
    return b"".join(_MARK.pack(*mark) for mark in marks)


SEEDS: list[bytes] = [
    b"",
    b"R" + _marks((b"s", 0), (b"s", 0), (b"a", 1), (b"l", 0), (b"f", 1), (b"a", 3), (b"s", 0), (b"a", 4)),
    b"B" + _marks((b"s", 0), (b"l", 0), (b"s", 0), (b"f", 1), (b"s", 0), (b"x", 0), (b"l", 0), (b"f", 2)),
    b"R" + _marks((b"l", 0), (b"f", 1), (b"x", 0), (b"r", 0), (b"f", 2), (b"a", 1), (b"r", 1), (b"f", 3)),
    b"L" + _marks((b"f", 1), (b"l", 0), (b"a", 1), (b"r", 0xFFFFFFFF), (b"s", 0), (b"f", 7), (b"r", 2)),
]


class _Lane:
    """Writes down what it is given."""

    def __init__(self) -> None:
        self.numbers: list[int] = []

    def send(self, route: int, sequence: int, stamp_ns: int, payload: bytes | bytearray | memoryview) -> int:
        self.numbers.append(sequence)
        return 0

    def open(self, route: int, size: int, sequence: int, stamp_ns: int) -> QueuedMessage:
        self.numbers.append(sequence)
        return QueuedMessage(route, size, sequence, stamp_ns)

    def extend(self, parcel: QueuedMessage, data: bytes | bytearray | memoryview) -> int:
        return 0

    def abandon(self, parcel: QueuedMessage) -> None:
        pass

    def fence(self, route: int, number: int) -> None:
        self.numbers.append(-number)

    def set_terms(self, *_: object, **__: object) -> None:
        pass

    def discard(self, route: int) -> None:
        pass


class _Link(Any):  # type: ignore[misc] # a double of what is much larger
    def __init__(self) -> None:
        self.express = _Lane()
        self.bulk = _Lane()


def fuzz(data: bytes) -> None:
    """Whatever is claimed: a documented error, or nothing but messages that were really published."""
    Process(World(1), "fuzz").run(_fuzz, data)  # type: ignore[abstract]


def _fuzz(data: bytes) -> None:
    reliable = data[:1] in b"RL"
    contract = Contract(
        reliability=Reliability.RELIABLE if reliable else Reliability.BEST_EFFORT,
        priority=Priority.LOW if data[:1] == b"L" else Priority.NORMAL,
        depth=5,
    )
    link = _Link()
    links = [link]
    leg = ReliableRouteSender(link, 7, contract, 1) if reliable else RouteSender(link, 7, contract)
    published = 0
    for start in range(1, len(data) - _MARK.size + 1, _MARK.size):
        what, number = _MARK.unpack_from(data, start)
        try:
            if what in b"sl":
                published += 1
                leg.message(published, _SMALL if what == b"s" else _LARGE)
            elif what == b"a":
                leg.acknowledged(number)
            elif what == b"f":
                leg.fenced(number)
            elif what == b"x":
                leg.lane_lost()
            elif what == b"r" and reliable:
                links.append(_Link())
                leg.suspend()
                leg.resume(links[-1], 7, number)
        except RemoteProtocolError as error:
            str(error)
    sent = [n for one in links for lane in (one.express, one.bulk) for n in lane.numbers if n > 0]
    if sent and max(sent) > published:
        raise AssertionError(f"message {max(sent)} was sent, of {published}")
    if isinstance(leg, ReliableRouteSender) and leg.sender.confirmed > published:
        raise AssertionError(f"message {leg.sender.confirmed} counts as acknowledged, of {published}")
    if len(leg._held) > contract.queue_depth:
        raise AssertionError(f"{len(leg._held)} messages are held, of {contract.queue_depth} that may be")
    leg.close()
