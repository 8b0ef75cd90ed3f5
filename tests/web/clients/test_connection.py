"""The sign of life of a client, with a transport that the test plays, and the age of what it sends."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from rmpa.web import limits
from rmpa.web.clients.connection import CommandAge, MessageArrival, Session
from rmpa.web.clients.frame_writer import FrameWriter
from rmpa.web.hub.node_link import READ_ONLY
from tests.ros.node.peers import DEADLINE


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
    connection = Silent(hub, READ_ONLY, lambda _: 0, "here").connection
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


LONG = limits.MESSAGE_TIMEOUT


def test_a_message_whose_fragments_never_end_takes_too_long_whatever_comes_between_them() -> None:
    arrival, received = MessageArrival(), 0
    for now in range(0, int(LONG), 10):
        assert not arrival.takes_too_long(received, now)
        received += 7  # a fragment
        received += 6  # a pong
        arrival.control_frame(0)
    assert not arrival.takes_too_long(received, LONG + 9)
    assert arrival.takes_too_long(received, LONG + 10)


def test_messages_that_end_and_pongs_do_not() -> None:
    arrival, received = MessageArrival(), 0
    for now in range(0, int(5 * LONG), 10):
        received += 100
        assert not arrival.takes_too_long(received, now)  # it is on its way
        arrival.message_ended(received)
    for now in range(int(5 * LONG), int(10 * LONG), 10):
        received += 6 + 125
        arrival.control_frame(125)
        assert not arrival.takes_too_long(received, now)


def test_without_a_count_of_bytes_nothing_takes_too_long() -> None:
    arrival = MessageArrival()
    assert not arrival.takes_too_long(0, 0.0)
    assert not arrival.takes_too_long(0, 2 * LONG)


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
