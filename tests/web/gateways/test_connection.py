"""The sign of life of a client, with a transport that the test plays."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from rmpa.web.gateways.connection import Session
from rmpa.web.gateways.frame_writer import FrameWriter
from rmpa.web.hub.node_link import READ_ONLY
from tests.ros.node.peers import DEADLINE

if TYPE_CHECKING:
    import pytest


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
