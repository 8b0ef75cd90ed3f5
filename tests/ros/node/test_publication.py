from __future__ import annotations

import socket
import struct
from collections.abc import AsyncIterator, Callable, Mapping

import pytest

from rmpa.ros import limits
from rmpa.ros.node.publication import AcceptedConnection, Publication, PublicationEvents
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.tcpros import TopicDescription, frame_message, publisher_header
from tests.ros.node.peers import LATCHED, STRING, RawSubscriber
from tests.waiting import until

OTHER = TopicDescription("std_msgs/Int32", "da5909fbe378aeaf85e547e830cc1bb7", "int32 data\n")


class Owner(PublicationEvents):
    """A node with one publication of /t, and what it said."""

    def __init__(self, description: TopicDescription | None, **options: int) -> None:
        self.said: list[str] = []
        self.publication = Publication("/t", "/p", description, events=self, **options)
        self.node = SlaveNode("/p", "127.0.0.1", "")
        self.node.add_publication(self.publication)

    def first_subscriber(self) -> None:
        self.said.append("first")

    def last_subscriber(self) -> None:
        self.said.append("last")

    def mismatch(self, fields: Mapping[str, str], text: str) -> None:
        self.said.append(f"refused {fields['callerid']}: {text}")

    async def subscriber(self, *, buffer: int = 0, **fields: str) -> RawSubscriber:
        if not self.node.uri:
            await self.node.start()
        before = self.publication.subscribers
        address = self.node.address_of("/t")
        assert address is not None
        link = await RawSubscriber.connect(address, buffer=buffer, **fields)
        await until(lambda: self.publication.subscribers > before)
        return link


@pytest.fixture
async def make() -> AsyncIterator[Callable[..., Owner]]:
    """Makes owners, which end with the test."""
    made: list[Owner] = []

    def make(description: TopicDescription | None, **options: int) -> Owner:
        made.append(Owner(description, **options))
        return made[-1]

    yield make
    for owner in made:
        await owner.node.close()


@pytest.fixture
async def held(make: Callable[..., Owner]) -> Owner:
    return make(None)


@pytest.fixture
async def known(make: Callable[..., Owner]) -> Owner:
    return make(STRING)


@pytest.fixture
async def latched(make: Callable[..., Owner]) -> Owner:
    return make(LATCHED)


async def test_a_subscriber_gets_the_header_and_then_every_message(known: Owner) -> None:
    link = await known.subscriber()
    assert await link.header() == publisher_header("/t", "/p", STRING)
    for payload in (b"one", b"", b"x" * 3_000_000, b"last"):
        known.publication.publish_framed(frame_message(payload))
    for payload in (b"one", b"", b"x" * 3_000_000, b"last"):
        assert await link.message() == payload


async def test_demand_is_reported_once_each_way(known: Owner) -> None:
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


async def test_a_held_subscriber_that_does_not_fit_is_refused_and_reported(held: Owner) -> None:
    wrong, right = await held.subscriber(callerid="/wrong", md5sum="0" * 32), await held.subscriber()
    held.publication.describe(STRING)
    error = (await wrong.header())["error"]
    assert "client [/wrong] wants topic /t to have type/md5sum [std_msgs/String/00000000" in error
    assert await wrong.ended()
    assert "error" not in await right.header()
    assert held.said == ["first", f"refused /wrong: {error}"]


async def test_demand_ends_when_all_held_subscribers_are_refused(held: Owner) -> None:
    await held.subscriber(md5sum="0" * 32)
    held.publication.describe(STRING)
    assert [text.split()[0] for text in held.said] == ["first", "refused", "last"]


@pytest.mark.trap(10)
async def test_latched_message_is_first_on_each_connection(latched: Owner) -> None:
    early = await latched.subscriber()
    latched.publication.publish_framed(memoryview(bytearray(frame_message(b"old"))))
    latched.publication.publish_framed(memoryview(bytearray(frame_message(b"kept"))))
    late = await latched.subscriber(callerid="/late")
    latched.publication.publish_framed(frame_message(b"new"))
    await early.header()
    assert (await late.header())["latching"] == "1"
    assert [await early.message() for _ in range(3)] == [b"old", b"kept", b"new"]
    assert [await late.message() for _ in range(2)] == [b"kept", b"new"]


async def test_another_definition_disconnects_subscribers(latched: Owner) -> None:
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


@pytest.mark.trap(2)
async def test_a_wildcard_is_never_described(held: Owner) -> None:
    with pytest.raises(ValueError, match="cannot have the type"):
        held.publication.describe(TopicDescription("*", "*", ""))


@pytest.mark.trap(9)
@pytest.mark.parametrize(("asked", "given"), [("1", 1), ("0", 0), ("true", 0), ("", 0)])
async def test_tcp_nodelay_is_honoured_on_our_socket(known: Owner, asked: str, given: int) -> None:
    await known.subscriber(tcp_nodelay=asked)
    (inbound,) = known.publication._connections
    assert isinstance(inbound, AcceptedConnection)
    assert inbound._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == given


@pytest.mark.trap(13)
async def test_a_half_closed_subscriber_is_gone(known: Owner) -> None:
    link = await known.subscriber()
    link.sock.shutdown(socket.SHUT_WR)
    await until(lambda: known.said == ["first", "last"])


@pytest.mark.trap(20)
async def test_junk_from_a_subscriber_is_read_away(known: Owner) -> None:
    link = await known.subscriber()
    for _ in range(40):
        await link.send(b"j" * 100_000)
    (inbound,) = known.publication._connections
    assert isinstance(inbound, AcceptedConnection)
    await until(lambda: inbound.bytes_in == 4_000_000)
    assert len(inbound._buffer) <= 1 << 18
    known.publication.publish_framed(frame_message(b"still here"))
    await link.header()
    assert await link.message() == b"still here"
    link.close()
    await until(lambda: known.said == ["first", "last"])


@pytest.mark.trap(19)
async def test_slow_subscriber_loses_the_oldest_and_delays_no_other(make: Callable[..., Owner]) -> None:
    owner = make(STRING, queue_messages=10)
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


@pytest.mark.trap(19)
async def test_a_slow_subscriber_holds_no_more_than_its_bytes(make: Callable[..., Owner]) -> None:
    owner = make(STRING)
    await owner.subscriber(buffer=4096)
    (inbound,) = owner.publication._connections
    assert isinstance(inbound, AcceptedConnection)
    inbound.bound(1000, 1_000_000)
    for _ in range(200):
        owner.publication.publish_framed(frame_message(bytes(100_000)))
    assert inbound.pending_bytes <= 1_000_000 + 100_004


@pytest.mark.trap(16)
async def test_withdrawal_closes_all_connections_silently(known: Owner) -> None:
    link = await known.subscriber()
    await link.header()
    known.publication.withdraw()
    assert await link.ended()
    assert known.said == ["first"]


@pytest.mark.trap(18)
async def test_a_machine_that_was_switched_off_is_noticed_by_the_kernel(known: Owner) -> None:
    await known.subscriber()
    (inbound,) = known.publication._connections
    assert isinstance(inbound, AcceptedConnection)
    for level, option, value in (
        (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
        (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 60),
        (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 10),
        (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 9),
    ):
        assert inbound._socket.getsockopt(level, option) == value  # fmt: skip


# --- messages in parts ------------------------------------------------------------------------------------------

PARTS = [bytes([n]) * 100_000 for n in range(1, 11)]
WHOLE = b"".join(PARTS)


def begin(publication: Publication, payload: bytes = WHOLE) -> None:
    publication.begin(4 + len(payload))
    publication.extend(memoryview(len(payload).to_bytes(4, "little")))


def extend(publication: Publication, *parts: bytes) -> None:
    for part in parts:
        buffer = bytearray(part)
        publication.extend(memoryview(buffer))
        buffer[:] = bytes(len(buffer))  # the stream's buffer is used again


async def test_a_slow_subscriber_among_fast_ones_gets_whole_messages_or_none(make: Callable[..., Owner]) -> None:
    owner = make(STRING, queue_messages=2)
    slow = await owner.subscriber(callerid="/slow", buffer=4096)
    fast = [await owner.subscriber(callerid=f"/fast{n}") for n in range(2)]
    for link in (slow, *fast):
        await link.header()
    sent = []
    for number in range(30):
        parts = [bytes([number]) * 150_000, bytes([255 - number]) * 100_000]
        sent.append(b"".join(parts))
        begin(owner.publication, sent[-1])
        extend(owner.publication, *parts)
        for link in fast:
            assert await link.message() == sent[-1]
    dropped = owner.publication.dropped
    assert dropped > 10
    got = [await slow.message() for _ in range(30 - dropped)]
    assert got == [message for message in sent if message in got], "in order, none torn, none twice"
    # The one that was on its way when the rest came may be one of the two that the queue holds.
    assert got[-1] == sent[-1]


@pytest.mark.trap(10)
async def test_late_subscriber_gets_latched_message_whole(latched: Owner) -> None:
    """A map is published once: there is no next one to begin with."""
    early = await latched.subscriber(callerid="/early")
    latched.publication.publish_framed(frame_message(b"old map"))
    begin(latched.publication)
    extend(latched.publication, *PARTS[:5])
    late = await latched.subscriber(callerid="/late")
    extend(latched.publication, *PARTS[5:])
    latest = await latched.subscriber(callerid="/latest")
    latched.publication.publish_framed(frame_message(b"next"))
    for link, messages in ((early, [b"old map", WHOLE]), (late, [b"old map", WHOLE]), (latest, [WHOLE])):
        await link.header()
        assert [await link.message() for _ in range(len(messages) + 1)] == [*messages, b"next"]


async def test_abort_disconnects_only_subscribers_with_the_beginning(make: Callable[..., Owner]) -> None:
    owner = make(STRING, queue_messages=100)
    half = await owner.subscriber(callerid="/half")
    stuck = await owner.subscriber(callerid="/stuck", buffer=4096)
    await stuck.header()
    (blocked,) = [link for link in owner.publication._connections if link.caller_id == "/stuck"]
    fills = 0
    while not blocked.pending_bytes:
        owner.publication.publish_framed(frame_message(bytes(100_000)))
        fills += 1
    owner.publication.publish_framed(frame_message(b"last"))
    begin(owner.publication)
    extend(owner.publication, *PARTS[:3])
    late = await owner.subscriber(callerid="/late")
    assert owner.publication.abort() == 1
    assert {link.caller_id for link in owner.publication._connections} == {"/stuck", "/late"}
    assert owner.said == ["first"]
    await half.header()
    assert [len(await half.message()) for _ in range(fills + 1)] == [100_000] * fills + [4]
    with pytest.raises(EOFError):
        await half.message()
    assert 0 < len(half.data) < len(WHOLE)
    owner.publication.publish_framed(frame_message(b"next"))
    assert [len(await stuck.message()) for _ in range(fills + 2)] == [100_000] * fills + [4, 4]
    await late.header()
    assert await late.message() == b"next"


async def test_abort_of_the_last_subscriber_ends_the_demand(known: Owner) -> None:
    await known.subscriber()
    begin(known.publication)
    assert known.publication.abort() == 1
    assert known.said == ["first", "last"]
    assert known.publication.abort() == 0
    again = await known.subscriber()
    known.publication.publish_framed(frame_message(b"next"))
    await again.header()
    assert await again.message() == b"next"


async def test_subscriber_leaving_midway_disturbs_no_other(known: Owner) -> None:
    leaves, stays = await known.subscriber(callerid="/leaves"), await known.subscriber(callerid="/stays")
    begin(known.publication)
    extend(known.publication, *PARTS[:2])
    leaves.close()
    await until(lambda: known.publication.subscribers == 1)
    extend(known.publication, *PARTS[2:])
    await stays.header()
    assert await stays.message() == WHOLE


def test_no_contract_keeps_more_than_the_limit() -> None:
    publication = Publication("/t", "/p", LATCHED)
    publication.keep(limits.LATCHED_MAX * 10)
    for n in range(limits.LATCHED_MAX * 2):
        publication.publish_framed(frame_message(b"%d" % n))
    assert len(publication.latched) == limits.LATCHED_MAX


@pytest.mark.trap(19)
async def test_contract_depth_bounds_each_subscribers_queue(make: Callable[..., Owner]) -> None:
    owner = make(STRING)
    await owner.subscriber(callerid="/early", buffer=4096)
    owner.publication.bound(3)
    await owner.subscriber(callerid="/late", buffer=4096)
    for _ in range(100):
        owner.publication.publish_framed(frame_message(bytes(200_000)))
    links = [link for link in owner.publication._connections if isinstance(link, AcceptedConnection)]
    assert len(links) == 2
    assert all(link.dropped > 50 and link.outbox.waiting_entries <= 4 for link in links)
    owner.publication.bound(10**6)
    assert owner.publication._queue_messages == limits.SUBSCRIBER_QUEUE_MESSAGES


@pytest.mark.trap(42)
async def test_one_subscriber_is_hung_up_on_and_the_others_stay(known: Owner) -> None:
    links = {name: await known.subscriber(callerid=name) for name in ("/one", "/two")}
    for link in links.values():
        await link.header()
    assert known.publication.hang_up("/one")
    assert await links["/one"].ended()
    assert known.publication.callers == {"/two"}
    known.publication.publish_framed(frame_message(b"still"))
    assert await links["/two"].message() == b"still"
    assert not known.publication.hang_up("/one")
    assert known.publication.hang_up("/two")
    assert known.said == ["first", "last"]
