"""Fuzz target: what a peer sends on the route of a service, whole or in parts: requests here, replies there."""

from __future__ import annotations

from typing import Final

from rmpa.bridge.services.bodies import BodyReceiver, Budget
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.outbox import ABORT, FIRST, LAST

_BUDGET: Final = 1 << 20
_HEAD: Final = 3


def _part(flags: int, sequence: int, part: bytes) -> bytes:
    return bytes((flags, sequence, len(part))) + part


SEEDS: list[bytes] = [
    b"",
    _part(FIRST, 1, b"\4\0\0\0ab") + _part(LAST, 1, b"cd"),
    _part(FIRST | LAST, 1, b"\2\0\0\0ab") + _part(8, 2, b"\2\0\0\0ab"),
    _part(FIRST, 1, b"\4\0\0\0ab")
    + _part(LAST | ABORT, 1, b"")
    + _part(FIRST, 2, b"\1\0\0\0")
    + _part(LAST, 2, b"x"),
    _part(FIRST, 1, b"\4\0\0\0ab") + _part(FIRST, 2, b"\0\0\0\0") + _part(LAST, 2, b""),
    _part(FIRST, 1, b"\xff\xff\xff\x03") + _part(0, 1, b"x" * 255) + _part(LAST, 1, b""),
    _part(FIRST, 1, b"\1\0\0\4"),
    _part(FIRST, 1, b"\1"),
]


class _Taker(BodyReceiver):
    """Checks that what is whole is as long as was said."""

    def __init__(self) -> None:
        super().__init__(Budget(_BUDGET))
        self.said = 0
        self.ended = 0

    def body(self, _sequence: int, body: bytes | bytearray) -> None:
        assert len(body) == self.said
        self.ended += 1

    def failed(self, _sequence: int, reason: str) -> None:
        assert reason
        self.ended += 1


def fuzz(data: bytes) -> None:
    """Take the parts; whatever came, nothing is held at the end."""
    taker = _Taker()
    view = memoryview(data)
    try:
        while len(view) >= _HEAD:
            flags, sequence, size = view[:_HEAD]
            part, view = view[_HEAD : _HEAD + size], view[_HEAD + size :]
            if flags & 8:
                taker.drop("the lane is lost")
                taker.said = max(0, len(part) - 4)
                taker.message(sequence, 0, part)
                continue
            if flags & FIRST and len(part) >= 4:
                taker.said = int.from_bytes(part[:4], "little")
            taker.part(sequence, 0, flags, part)
    except RemoteProtocolError:
        pass
    taker.drop("the link is gone")
    assert taker._budget.used == 0
