from __future__ import annotations

import socket
import struct
from typing import TYPE_CHECKING

import pytest

from rmpa.core import limits
from rmpa.ros.aio.publication import Publication
from rmpa.ros.aio.tcpros_server import TcprosServer
from rmpa.ros.tcpros import Description, frame_message
from tests.ros.aio.peers import LATCHED, STRING, RawSubscriber, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

OTHER = Description("std_msgs/Int32", "da5909fbe378aeaf85e547e830cc1bb7", "int32 data\n")


class Owner:
    """A server with one publication of /t, and what it said."""

    def __init__(self, description: Description | None, **options: int) -> None:
        self.said: list[str] = []
        self.publication = Publication(
            "/t",
            "/p",
            description,
            on_first_subscriber=lambda: self.said.append("first"),
            on_last_subscriber=lambda: self.said.append("last"),
            on_mismatch=self.mismatch,
            **options,
        )
        self.server = TcprosServer("/p", {"/t": self.publication})
        self.server.start()

    def mismatch(self, fields: Mapping[str, str], text: str) -> None:
        self.said.append(f"refused {fields['callerid']}: {text}")

    async def subscriber(self, *, buffer: int = 0, **fields: str) -> RawSubscriber:
        before = self.publication.subscribers
        link = await RawSubscriber.connect(self.server.address, buffer=buffer, **fields)
        await until(lambda: self.publication.subscribers > before)
        return link

    def close(self) -> None:
        self.publication.withdraw()
        self.server.close()


@pytest.fixture
async def held() -> AsyncIterator[Owner]:
    owner = Owner(None)
    yield owner
    owner.close()


@pytest.fixture
async def known() -> AsyncIterator[Owner]:
    owner = Owner(STRING)
    yield owner
    owner.close()


@pytest.fixture
async def latched() -> AsyncIterator[Owner]:
    owner = Owner(LATCHED)
    yield owner
    owner.close()


async def test_a_subscriber_gets_the_header_and_then_every_message(known: Owner) -> None:
    link = await known.subscriber()
    assert await link.header() == {
        "callerid": "/p",
        "latching": "0",
        "md5sum": STRING.md5sum,
        "message_definition": "string data\n",
        "topic": "/t",
        "type": "std_msgs/String",
    }
    for payload in (b"one", b"", b"x" * 3_000_000, b"last"):
        known.publication.publish_framed(frame_message(payload))
    for payload in (b"one", b"", b"x" * 3_000_000, b"last"):
        assert await link.message() == payload
    link.close()


async def test_demand_is_told_once_each_way(known: Owner) -> None:
    one, two = await known.subscriber(), await known.subscriber()
    one.close()
    await until(lambda: known.publication.subscribers == 1)
    assert known.said == ["first"]
    two.close()
    await until(lambda: known.said == ["first", "last"])


@pytest.mark.trap(15, 38)
async def test_a_subscriber_is_held_until_the_type_is_known(held: Owner) -> None:
    link = await held.subscriber()
    assert held.said == ["first"]
    assert held.publication.connections()[0].connected is False
    held.publication.describe(STRING)
    assert (await link.header())["type"] == "std_msgs/String"
    held.publication.publish_framed(frame_message(b"now"))
    assert await link.message() == b"now"
    assert held.said == ["first"]
    link.close()


async def test_a_held_subscriber_that_does_not_fit_is_refused_and_reported(held: Owner) -> None:
    wrong, right = await held.subscriber(callerid="/wrong", md5sum="0" * 32), await held.subscriber()
    held.publication.describe(STRING)
    error = (await wrong.header())["error"]
    assert "client [/wrong] wants topic /t to have type/md5sum [std_msgs/String/00000000" in error
    assert await wrong.ended()
    assert "error" not in await right.header()
    assert held.said == ["first", f"refused /wrong: {error}"]
    wrong.close()
    right.close()


async def test_demand_ends_when_all_held_subscribers_are_refused(held: Owner) -> None:
    link = await held.subscriber(md5sum="0" * 32)
    held.publication.describe(STRING)
    assert [text.split()[0] for text in held.said] == ["first", "refused", "last"]
    link.close()


async def test_a_mismatch_is_no_demand(known: Owner) -> None:
    link = await RawSubscriber.connect(known.server.address, md5sum="0" * 32)
    assert "error" in await link.header()
    assert [text.split()[0] for text in known.said] == ["refused"]
    link.close()


async def test_any_md5_sum_gets_the_real_one(known: Owner) -> None:
    link = await known.subscriber(md5sum="*", type="*")
    fields = await link.header()
    assert (fields["type"], fields["md5sum"]) == (STRING.type, STRING.md5sum)
    link.close()


@pytest.mark.trap(10)
async def test_the_latched_message_goes_to_each_new_connection_once_and_first(latched: Owner) -> None:
    early = await latched.subscriber()
    latched.publication.publish_framed(memoryview(bytearray(frame_message(b"old"))))
    latched.publication.publish_framed(memoryview(bytearray(frame_message(b"kept"))))
    late = await latched.subscriber(callerid="/late")
    latched.publication.publish_framed(frame_message(b"new"))
    await early.header()
    assert (await late.header())["latching"] == "1"
    assert [await early.message() for _ in range(3)] == [b"old", b"kept", b"new"]
    assert [await late.message() for _ in range(2)] == [b"kept", b"new"]
    early.close()
    late.close()


async def test_the_latched_message_can_be_forgotten(latched: Owner) -> None:
    latched.publication.publish_framed(frame_message(b"old"))
    latched.publication.forget_latched()
    link = await latched.subscriber()
    await link.header()
    latched.publication.publish_framed(frame_message(b"new"))
    assert await link.message() == b"new"
    link.close()


async def test_without_latching_nothing_is_kept(known: Owner) -> None:
    known.publication.publish_framed(frame_message(b"old"))
    link = await known.subscriber()
    await link.header()
    known.publication.publish_framed(frame_message(b"new"))
    assert await link.message() == b"new"
    link.close()


async def test_another_definition_closes_those_who_were_promised_the_old_one(latched: Owner) -> None:
    link = await latched.subscriber(md5sum="*")
    latched.publication.publish_framed(frame_message(b"old"))
    latched.publication.describe(LATCHED)
    assert latched.publication.subscribers == 1
    latched.publication.describe(OTHER)
    await link.header()
    assert await link.message() == b"old"
    assert await link.ended()
    assert latched.said == ["first", "last"]
    again = await latched.subscriber(md5sum="*")
    assert (await again.header())["type"] == "std_msgs/Int32"
    latched.publication.publish_framed(frame_message(b"new"))
    assert await again.message() == b"new"
    link.close()
    again.close()


@pytest.mark.trap(2)
async def test_a_wildcard_is_never_described(held: Owner) -> None:
    with pytest.raises(ValueError, match="cannot have the type"):
        held.publication.describe(Description("*", "*", ""))


@pytest.mark.trap(9)
@pytest.mark.parametrize(("asked", "given"), [("1", 1), ("0", 0), ("true", 0), ("", 0)])
async def test_tcp_nodelay_is_honoured_on_our_socket(known: Owner, asked: str, given: int) -> None:
    link = await known.subscriber(tcp_nodelay=asked)
    (inbound,) = known.publication._open
    assert inbound._sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == given
    link.close()


@pytest.mark.trap(13)
async def test_a_half_closed_subscriber_is_gone(known: Owner) -> None:
    link = await known.subscriber()
    link.sock.shutdown(socket.SHUT_WR)
    await until(lambda: known.said == ["first", "last"])
    link.close()


@pytest.mark.trap(20)
async def test_junk_from_a_subscriber_is_read_away(known: Owner) -> None:
    link = await known.subscriber()
    for _ in range(40):
        await link.send(b"j" * 100_000)
    (inbound,) = known.publication._open
    await until(lambda: inbound.stream.bytes_in > 4_000_000)
    assert len(inbound.stream._buffer) <= 1 << 18
    known.publication.publish_framed(frame_message(b"still here"))
    await link.header()
    assert await link.message() == b"still here"
    link.close()
    await until(lambda: known.said == ["first", "last"])


async def test_a_reset_is_gone_too(known: Owner) -> None:
    link = await known.subscriber()
    link.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    link.close()
    await until(lambda: known.said == ["first", "last"])
    known.publication.publish_framed(frame_message(b"nobody"))


@pytest.mark.trap(19)
async def test_a_slow_subscriber_loses_the_oldest_and_delays_nobody() -> None:
    owner = Owner(STRING, queue_messages=10, queue_bytes=1 << 30)
    slow = await owner.subscriber(callerid="/slow", buffer=4096)
    fast = await owner.subscriber(callerid="/fast")
    await slow.header()
    await fast.header()
    size = 200_000
    sent = [struct.pack("<I", n) + bytes(size) for n in range(100)]
    dropped = 0
    for payload in sent:
        dropped += owner.publication.publish_framed(frame_message(payload))
        assert await fast.message() == payload
    assert dropped == owner.publication.dropped > 50
    stats = {c.other: c for c in owner.publication.connections()}
    assert (stats["/slow"].dropped, stats["/fast"].dropped) == (dropped, 0)
    assert stats["/slow"].messages == stats["/fast"].messages == 100
    got = [await slow.message() for _ in range(100 - dropped)]
    assert set(got) <= set(sent)
    assert got == sorted(got)
    assert got[-10:] == sent[-10:]
    slow.close()
    fast.close()
    await until(lambda: owner.publication.subscribers == 0)
    assert owner.publication.dropped == dropped
    owner.close()


@pytest.mark.trap(19)
async def test_a_slow_subscriber_holds_no_more_than_its_bytes() -> None:
    owner = Owner(STRING, queue_messages=1000, queue_bytes=1_000_000)
    slow = await owner.subscriber(buffer=4096)
    for _ in range(200):
        owner.publication.publish_framed(frame_message(bytes(100_000)))
    (inbound,) = owner.publication._open
    assert inbound.stream.pending_bytes <= 1_000_000 + 100_004
    slow.close()
    owner.close()


@pytest.mark.trap(16)
async def test_withdrawn_all_connections_are_closed_and_nothing_is_said(known: Owner) -> None:
    link = await known.subscriber()
    await link.header()
    known.publication.withdraw()
    assert await link.ended()
    assert known.said == ["first"]
    link.close()


async def test_figures(known: Owner) -> None:
    link = await known.subscriber()
    await link.header()
    known.publication.publish_framed(frame_message(b"abc"))
    await link.message()
    (connection,) = known.publication.connections()
    assert (connection.other, connection.direction, connection.topic) == ("/s", "o", "/t")
    assert (connection.connected, connection.messages, connection.dropped) == (True, 1, 0)
    assert connection.bytes > 7
    assert connection.info.startswith("TCPROS connection on port ")
    assert (known.publication.messages, known.publication.bytes) == (1, 7)
    link.close()


async def test_what_was_published_can_be_waited_for(known: Owner) -> None:
    link = await known.subscriber(buffer=4096)
    for _ in range(20):
        known.publication.publish_framed(frame_message(bytes(100_000)))
    await link.header()
    reading = [len(await link.message()) for _ in range(20)]
    await known.publication.drained()
    assert reading == [100_000] * 20
    assert limits.SUBSCRIBER_QUEUE_MESSAGES > 20
    link.close()


@pytest.mark.trap(18)
async def test_a_machine_that_was_switched_off_is_noticed_by_the_kernel(known: Owner) -> None:
    link = await known.subscriber()
    (inbound,) = known.publication._open
    for level, option, value in (
        (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
        (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 60),
        (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 10),
        (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 9),
    ):
        assert inbound._sock.getsockopt(level, option) == value
    link.close()
