from __future__ import annotations

import logging
import struct
from typing import TYPE_CHECKING

import pytest

from rmpa.core.counters import Counters
from rmpa.core.errors import StartError
from rmpa.ros import limits
from rmpa.ros.node.listeners import TcprosServer
from rmpa.ros.node.publication import Publication
from rmpa.ros.wire.tcpros import encode_header, frame_message
from tests.ros.node.peers import STRING, RawSubscriber, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


class Served:
    def __init__(self) -> None:
        self.counters = Counters()
        self.publication = Publication("/t", "/p", STRING)
        self.server = TcprosServer("/p", {"/t": self.publication}, counters=self.counters)
        self.server.start()

    def close(self) -> None:
        self.publication.withdraw()
        self.server.close()


@pytest.fixture
async def served() -> AsyncIterator[Served]:
    made = Served()
    yield made
    made.close()


@pytest.mark.trap(7)
async def test_a_header_may_come_byte_by_byte(served: Served) -> None:
    link = await RawSubscriber.dial(served.server.address)
    for byte in encode_header({"topic": "/t", "callerid": "/s", "md5sum": "*"}):
        await link.send(bytes([byte]))
    assert (await link.header())["callerid"] == "/p"
    link.close()


@pytest.mark.trap(4, 5, 23)
@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"topic": "/other"}, "[/p] is not a publisher of [/other]"),
        ({"topic": "t"}, "[/p] is not a publisher of [t]"),
        ({"topic": "", "service": "/add"}, "[/p] does not offer the service [/add]"),
        ({"topic": ""}, "neither a 'topic' nor a 'service' field in the connection header"),
        ({"callerid": ""}, "required field 'callerid' is missing in the connection header"),
        ({"md5sum": ""}, "required field 'md5sum' is missing in the connection header"),
    ],
)
async def test_what_is_refused(served: Served, fields: dict[str, str], error: str) -> None:
    link = await RawSubscriber.connect(served.server.address, buffer=0, **fields)
    assert await link.header() == {"error": error}
    assert await link.ended()
    link.close()


@pytest.mark.trap(6, 7)
@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        struct.pack("<II", 4, 0),
        struct.pack("<II", 9, 5) + b"topic",
        struct.pack("<II", 12, 900) + b"topic=/t",
        b"\xff" * 64,
    ],
)
async def test_malformed_headers_are_counted_and_closed(
    served: Served, data: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    link = await RawSubscriber.dial(served.server.address)
    await link.send(data)
    assert await link.ended()
    await until(lambda: served.counters["tcpros.refused.malformed"] == 1)
    assert "a connection from 127.0.0.1" in caplog.text
    link.close()


@pytest.mark.trap(7)
async def test_an_empty_header_is_refused_instead_of_held(served: Served) -> None:
    link = await RawSubscriber.dial(served.server.address)
    await link.send(bytes(4))
    assert "error" in await link.header()
    link.close()


@pytest.mark.trap("16a")
async def test_leaving_before_the_header_is_no_error(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    for data in (b"", b"\x10\x00"):
        link = await RawSubscriber.dial(served.server.address)
        await link.send(data)
        link.close()
    await until(lambda: len(served.server._accepted) == 2)
    await until(lambda: not served.server._waiting)
    assert served.counters.as_dict() == {}
    assert caplog.text == ""


@pytest.mark.trap(6, 11, 18)
async def test_silent_connection_blocks_no_other_and_is_closed(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "TCPROS_HANDSHAKE_TIMEOUT", 0.2)
    silent = await RawSubscriber.dial(served.server.address)
    other = await RawSubscriber.connect(served.server.address)
    assert "error" not in await other.header()
    assert await silent.ended()
    assert served.counters["tcpros.refused.silent"] == 1
    assert served.publication.subscribers == 1
    silent.close()
    other.close()


async def test_connections_without_a_header_are_bounded(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "TCPROS_HANDSHAKES_MAX", 3)
    links = [await RawSubscriber.dial(served.server.address) for _ in range(4)]
    assert await links[3].ended()
    assert served.counters["tcpros.refused.full"] == 1
    for link in links:
        link.close()
    await until(lambda: not served.server._waiting)


async def test_all_connections_are_bounded_and_closed_ones_do_not_count(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "TCPROS_CONNECTIONS_MAX", 3)
    for _ in range(2):
        links = [await RawSubscriber.connect(served.server.address) for _ in range(3)]
        for link in links:
            await link.header()
        surplus = await RawSubscriber.connect(served.server.address)
        assert await surplus.ended()
        for link in (*links, surplus):
            link.close()
        await until(lambda: served.publication.subscribers == 0)
    assert served.counters["tcpros.refused.full"] == 2


async def test_an_address_in_use_is_a_clear_error(served: Served) -> None:
    with pytest.raises(StartError, match=r"TCPROS server of /q at 127.0.0.1:\d+: "):
        TcprosServer("/q", {}).start(*served.server.address)


@pytest.mark.trap(3)
@pytest.mark.parametrize("definition", ["", "another text\n", "string data\n"])
async def test_a_subscriber_may_or_may_not_send_its_definition(served: Served, definition: str) -> None:
    link = await RawSubscriber.connect(served.server.address, message_definition=definition)
    assert (await link.header())["message_definition"] == "string data\n"
    link.close()


@pytest.mark.trap(8)
async def test_what_comes_in_one_segment_with_the_header_does_no_harm(served: Served) -> None:
    link = await RawSubscriber.dial(served.server.address)
    header = encode_header({"topic": "/t", "callerid": "/s", "md5sum": "*"})
    await link.send(header + b"a request that should have waited for the reply")
    assert (await link.header())["callerid"] == "/p"
    served.publication.publish_framed(frame_message(b"served"))
    assert await link.message() == b"served"
    link.close()


@pytest.mark.trap(23)
async def test_a_probe_for_a_service_that_is_gone_is_answered_and_not_logged(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    probe = {"topic": "", "service": "/add", "probe": "1"}
    for _ in range(5):
        hasty = await RawSubscriber.connect(served.server.address, buffer=0, **probe)
        hasty.close()  # wait_for_service does not read the reply
    patient = await RawSubscriber.connect(served.server.address, buffer=0, **probe)
    assert await patient.header() == {"error": "[/p] does not offer the service [/add]"}
    assert await patient.ended()
    patient.close()
    await until(lambda: not served.server._waiting)
    assert served.counters.as_dict() == {}
    assert caplog.records == []
