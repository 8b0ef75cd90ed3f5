"""Frames find the handlers of their routes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.bridge.data.reception import DataReceiver
from rmpa.core.counters import Counters
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.outbox import FIRST
from rmpa.mesh.frames import FrameKind

if TYPE_CHECKING:
    from rmpa.mesh.io.link import PeerLink

LINK = cast("PeerLink", object())
MESSAGE = memoryview(b"\x02\x00\x00\x00hi")


class Handler:
    """Notes what it gets, as the handler and the sender of a route."""

    def __init__(self) -> None:
        self.got: list[tuple[Any, ...]] = []

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        self.got.append((sequence, stamp_ns, bytes(framed)))

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        self.got.append((sequence, stamp_ns, flags, bytes(part)))

    def acknowledged(self, sequence: int) -> None:
        self.got.append(("ack", sequence))

    def fenced(self, sequence: int) -> None:
        self.got.append(("fenced", sequence))


def receiver(handler: Handler) -> tuple[DataReceiver, Counters]:
    counters = Counters()
    made = DataReceiver(counters, lambda peer, route: cast("Any", handler) if (peer, route) == (1, 7) else None)
    made.link_up(LINK, 1, {7: handler})
    return made, counters


def test_messages_parts_and_marks_reach_their_route() -> None:
    handler = Handler()
    made, counters = receiver(handler)
    made.data(LINK, 7, 1, 2, MESSAGE)
    made.part(LINK, 7, 2, 3, FIRST, MESSAGE)
    made.mark(LINK, FrameKind.ACK, 7, 5)
    made.mark(LINK, FrameKind.FENCED, 7, 6)
    assert handler.got == [(1, 2, bytes(MESSAGE)), (2, 3, FIRST, bytes(MESSAGE)), ("ack", 5), ("fenced", 6)]
    assert counters["route.unknown"] == 0


def test_frames_of_closed_routes_and_ended_links_are_dropped() -> None:
    handler = Handler()
    made, counters = receiver(handler)
    made.data(LINK, 8, 1, 2, MESSAGE)
    made.part(LINK, 8, 1, 2, FIRST, MESSAGE)
    made.mark(LINK, FrameKind.ACK, 8, 1)
    assert counters["route.unknown"] == 2
    made.link_down(LINK)
    made.data(LINK, 7, 1, 2, MESSAGE)
    made.part(LINK, 7, 1, 2, FIRST, MESSAGE)
    made.mark(LINK, FrameKind.ACK, 7, 1)
    assert handler.got == []


@pytest.mark.parametrize("payload", [b"", b"\x00\x00\x00", b"\x03\x00\x00\x00hi", b"\x01\x00\x00\x00hi"])
def test_a_frame_that_does_not_hold_one_message_breaks_the_protocol(payload: bytes) -> None:
    made, _ = receiver(Handler())
    with pytest.raises(RemoteProtocolError, match="does not hold one message"):
        made.data(LINK, 7, 1, 2, memoryview(payload))
