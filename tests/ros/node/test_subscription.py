from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import AsyncIterator, Mapping
from typing import ClassVar

import pytest

from rmpa.core import limits as core_limits
from rmpa.ros import limits
from rmpa.ros.node.slave_node import SlaveNode, Subscription
from rmpa.ros.node.subscription import PartsTaker, PublisherConnection
from rmpa.ros.wire.tcpros import ANYTHING, TopicDescription, encode_header, frame_message, publisher_header
from tests.ros.node.peers import MD5, STRING, RawPublisher, RawServer
from tests.waiting import until


@pytest.fixture(autouse=True)
async def impatient(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[None]:
    monkeypatch.setattr("rmpa.ros.node.subscription.TCPROS_RETRY_FIRST", 0.001)
    monkeypatch.setattr("rmpa.ros.node.subscription.TCPROS_RETRY_MAX", 0.01)
    yield
    while Said.made:
        Said.made.pop().close()


@pytest.fixture
async def publisher() -> AsyncIterator[RawPublisher]:
    async with RawPublisher() as made:
        yield made


class Said:
    """One connection to one publisher, and what it said."""

    made: ClassVar[list[Said]] = []

    def __init__(self, uri: str, *, on_parts: PartsTaker | None = None, wanted: TopicDescription = ANYTHING) -> None:
        self.headers: list[Mapping[str, str]] = []
        self.messages: list[bytes] = []
        self.refused: list[str] = []
        self.lost: list[str] = []
        self.oversized: list[int] = []
        self.link = PublisherConnection(
            "/t",
            uri,
            "/s",
            on_header=self.headers.append,
            on_message=lambda framed: self.messages.append(bytes(framed)),
            on_parts=on_parts,
            on_refused=self.refused.append,
            on_lost=self.lost.append,
            on_oversized=self.oversized.append,
            wanted=wanted,
        )
        self.link.start()
        self.made.append(self)

    def close(self) -> None:
        self.link.close()


@pytest.mark.trap(3, 11)
async def test_it_asks_for_tcpros_only_and_sends_its_header_at_once(publisher: RawPublisher) -> None:
    said = Said(publisher.uri)
    _link, fields = await publisher.serve()
    assert publisher.asked == [("/s", "/t", [["TCPROS"]])]
    assert fields == {"callerid": "/s", "md5sum": "*", "tcp_nodelay": "1", "topic": "/t", "type": "*"}
    await until(lambda: said.headers)
    assert said.headers[0]["message_definition"] == "string data\n"


@pytest.mark.trap(8)
async def test_header_and_messages_in_one_segment_or_byte_by_byte(publisher: RawPublisher) -> None:
    wire = encode_header(publisher_header("/t", "/p", STRING)) + frame_message(b"one") + frame_message(b"")
    for chunk in (len(wire), 1):
        said = Said(publisher.uri)
        link = await publisher.accept()
        await link.header()
        for start in range(0, len(wire), chunk):
            await link.send(wire[start : start + chunk])
        await until(lambda: len(said.messages) == 2)  # noqa: B023 - awaited within the turn
        assert said.messages == [b"\x03\x00\x00\x00one", b"\x00\x00\x00\x00"]


@pytest.mark.trap(14, 17)
@pytest.mark.parametrize("half", [b"\x10\x00\x00\x00half", (1001).to_bytes(4, "little") + bytes(500)])
async def test_a_lost_publisher_is_found_again_and_half_a_message_is_dropped(
    publisher: RawPublisher, monkeypatch: pytest.MonkeyPatch, half: bytes
) -> None:
    monkeypatch.setattr(limits, "TCPROS_MESSAGE_MAX", 1000)
    said = Said(publisher.uri)
    link, _ = await publisher.serve()
    await link.send(frame_message(b"whole") + half)
    link.close()
    again, _ = await publisher.serve()
    await again.send(frame_message(b"after"))
    await until(lambda: len(said.messages) == 2)
    assert [m[4:] for m in said.messages] == [b"whole", b"after"]
    assert said.lost == ["the publisher closed the connection"]
    assert len(said.headers) == 2


@pytest.mark.trap(21)
@pytest.mark.parametrize(
    "answer",
    [
        [-1, "Not a publisher of [/t]", []], [0, "no supported protocol", []], [1, "ok", []],
        [1, "ok", ["TCPROS", "127.0.0.1", "80"]], [1, "ok", ["TCPROS", "127.0.0.1", 70000]],
        [1, "ok", ["UDPROS", "127.0.0.1", 80]], [1, "ok"], "nonsense",
    ],
)  # fmt: skip
async def test_a_publisher_that_is_not_ready_is_asked_again(
    publisher: RawPublisher, answer: list[object] | str
) -> None:
    publisher.answer = answer  # type: ignore[assignment]  # what peers send has any shape
    said = Said(publisher.uri)
    await until(lambda: len(said.lost) > 2)
    publisher.answer = None
    _link, _ = await publisher.serve()
    await until(lambda: said.headers)


@pytest.mark.trap(15)
async def test_an_error_header_is_final(publisher: RawPublisher) -> None:
    said = Said(publisher.uri)
    link = await publisher.accept()
    await link.header()
    await link.send(encode_header({"error": "go away"}) + b"junk behind")
    await until(lambda: said.refused)
    await until(lambda: said.link._task is None)
    assert (said.refused, said.lost, said.messages) == (["go away"], [], [])
    assert said.link.refused == "go away"


@pytest.mark.trap(1)
async def test_a_publisher_with_another_md5_sum_is_not_believed(publisher: RawPublisher) -> None:
    publisher.description = TopicDescription("std_msgs/Int32", "0" * 32, "int32 data")
    said = Said(publisher.uri, wanted=TopicDescription("std_msgs/String", MD5, ""))
    link, _ = await publisher.serve()
    await link.send(frame_message(b"poison"))
    await until(lambda: said.refused)
    assert f"not [std_msgs/String/{MD5}]" in said.refused[0]
    assert said.messages == []


@pytest.mark.parametrize("junk", [b"GET / HTTP/1.1\r\n", struct.pack("<II", 9, 5) + b"topic"])
async def test_a_malformed_reply_is_a_loss(publisher: RawPublisher, junk: bytes) -> None:
    said = Said(publisher.uri)
    link = await publisher.accept()
    await link.send(junk)
    await until(lambda: said.lost)
    assert "connection header" in said.lost[0]
    assert not said.headers


@pytest.mark.trap(17)
@pytest.mark.parametrize("parts", [False, True])
async def test_what_cannot_be_a_length_ends_the_connection(publisher: RawPublisher, parts: bool) -> None:
    said = InParts(publisher.uri) if parts else Said(publisher.uri)
    link, _ = await publisher.serve()
    before = LARGE if parts else b"before"
    await link.send(frame_message(before) + b"\xff\xff\xff\xff")
    await until(lambda: said.lost)
    assert "a message's length of 4294967295 bytes cannot be" in said.lost[0]
    assert [m[4:] for m in said.messages] == [before]
    assert (said.oversized, said.link.malformed) == ([], True)
    assert not isinstance(said, InParts) or (said.aborts, said.half) == (0, b"")


@pytest.mark.trap(17)
@pytest.mark.parametrize("parts", [False, True])
@pytest.mark.parametrize("chunk", [1, 7, 1000, 1 << 20])
async def test_a_message_beyond_the_limit_is_left_out_and_others_come(
    publisher: RawPublisher, monkeypatch: pytest.MonkeyPatch, parts: bool, chunk: int
) -> None:
    monkeypatch.setattr(limits, "TCPROS_MESSAGE_MAX", 1000)
    monkeypatch.setattr(core_limits, "CUT_THROUGH_BYTES", 500)
    said = InParts(publisher.uri) if parts else Said(publisher.uri)
    link, _ = await publisher.serve()
    sent = [b"one", bytes(1001), b"two", bytes(700), bytes(5000), bytes(1002), bytes(1000), b"3", bytes(9000), b""]
    wire = b"".join(len(body).to_bytes(4, "little") + body for body in sent)
    for start in range(0, len(wire), chunk):
        await link.send(wire[start : start + chunk])
    wanted = [body for body in sent if len(body) <= 1000]
    await until(lambda: len(said.messages) == len(wanted))
    assert [m[4:] for m in said.messages] == wanted
    assert said.oversized == [1001, 5000, 1002, 9000]
    connection = said.link.connection()
    assert (connection.messages, connection.bytes) == (len(wanted), len(wire))
    assert not said.lost


async def test_a_message_beyond_the_limit_takes_no_memory(
    publisher: RawPublisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "TCPROS_MESSAGE_MAX", 1 << 20)
    said = Said(publisher.uri)
    link, _ = await publisher.serve()
    await link.send((64 << 20).to_bytes(4, "little"))
    for _ in range(64):
        await link.send(bytes(1 << 20))
    await link.send(frame_message(b"behind"))
    await until(lambda: said.messages)
    assert len(said.link._stream._buffer) <= 8 << 20  # type: ignore[union-attr] # it is connected


@pytest.mark.trap(18)
async def test_one_that_never_answers_is_given_up_after_the_time_of_rospy(
    publisher: RawPublisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert limits.TCPROS_CONNECT_TIMEOUT == 60
    monkeypatch.setattr(limits, "TCPROS_CONNECT_TIMEOUT", 0.05)
    said = Said(publisher.uri)
    await publisher.accept()
    await until(lambda: said.lost)
    assert said.lost[0] == "no header from the publisher in 0.05 s"
    with contextlib.closing(RawServer()) as silent:
        said = Said(f"http://127.0.0.1:{silent.port}/")
        await until(lambda: said.lost)
        assert "no answer to requestTopic in 0.05 s" in said.lost[0]


async def test_closed_from_within_a_message_no_other_comes(publisher: RawPublisher) -> None:
    got: list[bytes] = []

    def take(framed: memoryview) -> None:
        got.append(bytes(framed))
        connection.close()

    connection = PublisherConnection("/t", publisher.uri, "/s", on_message=take)
    connection.start()
    link, _ = await publisher.serve()
    await link.send(frame_message(b"one") + frame_message(b"two"))
    assert await link.ended()
    assert got == [b"\x03\x00\x00\x00one"]


class Followed:
    def __init__(self, own_uri: str = "") -> None:
        self.messages: list[tuple[str, bytes]] = []
        self.refused: list[str] = []
        node = SlaveNode("/s", "127.0.0.1", "")
        node.uri = own_uri
        self.subscription = Subscription(
            "/t",
            node,
            on_message=lambda link, framed: self.messages.append((link.uri, bytes(framed[4:]))),
            on_refused=lambda _, text: self.refused.append(text),
        )

    def close(self) -> None:
        self.subscription.close()


@pytest.mark.trap(16)
async def test_a_subscription_follows_the_list_of_publishers() -> None:
    followed = Followed(own_uri="http://127.0.0.1:1/")
    async with RawPublisher() as one, RawPublisher() as two:
        followed.subscription.update([one.uri, two.uri, two.uri, "http://127.0.0.1:1/"])
        first, second = (await one.serve())[0], (await two.serve())[0]
        await first.send(frame_message(b"1"))
        await second.send(frame_message(b"2"))
        await until(lambda: len(followed.messages) == 2)
        assert set(followed.messages) == {(one.uri, b"1"), (two.uri, b"2")}
        assert followed.subscription.publishers == 2
        followed.subscription.update([two.uri])
        assert await first.ended()
        followed.subscription.update([one.uri], keep=True)
        _third, _ = await one.serve()
        await second.send(frame_message(b"still"))
        await until(lambda: len(followed.messages) == 3)
        assert len(one.asked) == 2
        assert len(two.asked) == 1
        followed.close()


@pytest.mark.trap(15)
async def test_refusing_publisher_is_tried_again_when_listed_again() -> None:
    followed = Followed()
    async with RawPublisher() as one:
        followed.subscription.update([one.uri])
        link = await one.accept()
        await link.header()
        await link.send(encode_header({"error": "not yet"}))
        await until(lambda: followed.refused == ["not yet"])
        followed.subscription.update([one.uri])
        again, _ = await one.serve()
        await again.send(frame_message(b"now"))
        await until(lambda: followed.messages == [(one.uri, b"now")])
        followed.close()


@pytest.mark.trap(18)
async def test_half_a_message_holds_up_no_other(publisher: RawPublisher) -> None:
    async with RawPublisher() as other:
        stuck, fine = Said(publisher.uri), Said(other.uri)
        half, _ = await publisher.serve()
        whole, _ = await other.serve()
        await half.send(frame_message(b"first") + b"\x10\x00\x00\x00half")
        await until(lambda: stuck.messages)
        for _ in range(3):
            await whole.send(frame_message(b"whole"))
        await until(lambda: len(fine.messages) == 3)
        assert len(stuck.messages) == 1
        assert stuck.link._stream is not None
        assert isinstance(stuck.link._stream._sock, socket.socket)
        assert stuck.link._stream._sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
        await half.send(b" a minute ago")


# --- messages in parts ------------------------------------------------------------------------------------------

LARGE = bytes(range(256)) * (core_limits.CUT_THROUGH_BYTES // 256 + 40)


class InParts(Said):
    """A connection that wants large messages in parts."""

    def __init__(self, uri: str) -> None:
        self.sizes: list[int] = []
        self.parts: list[int] = []
        self.aborts = 0
        self.half = b""
        super().__init__(uri, on_parts=self)

    def begin(self, size: int) -> None:
        assert not self.half
        self.sizes.append(size)

    def part(self, part: memoryview) -> None:
        self.half += part
        self.parts.append(len(part))
        assert len(self.half) <= self.sizes[-1]
        if len(self.half) == self.sizes[-1]:
            self.messages.append(self.half)
            self.half = b""

    def abort(self) -> None:
        self.aborts += 1
        self.half = b""


@pytest.mark.parametrize("chunk", [1, 3, 4097, 100_003])
async def test_any_pieces_make_the_same_messages(publisher: RawPublisher, chunk: int) -> None:
    """Fed by hand: a socket would join the pieces again."""
    said = InParts(publisher.uri)
    _link, _ = await publisher.serve()
    await until(lambda: said.headers)
    edge = [bytes(core_limits.CUT_THROUGH_BYTES - 4), bytes(core_limits.CUT_THROUGH_BYTES - 3)]
    payloads = [b"one", b"", LARGE, LARGE[::-1], b"two", *edge, b""]
    wire = b"".join(map(frame_message, payloads))
    assert said.link._stream is not None
    if chunk == 1:
        wire = wire[: len(frame_message(b"one")) + 4 + len(frame_message(LARGE))]
        payloads = payloads[:3]
    for start in range(0, len(wire), chunk):
        said.link._stream.feed(wire[start : start + chunk])
    assert [m[4:] for m in said.messages] == payloads
    assert all(size > core_limits.CUT_THROUGH_BYTES for size in said.sizes)
    assert said.link.messages == len(payloads)
    assert said.link.bytes == len(wire)


@pytest.mark.trap(14, 17)
async def test_publisher_lost_within_parts_aborts_and_reconnects(publisher: RawPublisher) -> None:
    said = InParts(publisher.uri)
    link, _ = await publisher.serve()
    await link.send(frame_message(LARGE) + frame_message(LARGE)[:5000])
    await until(lambda: sum(said.parts) > len(LARGE) + 4)
    link.close()
    again, _ = await publisher.serve()
    await again.send(frame_message(b"after") + frame_message(LARGE))
    await until(lambda: len(said.messages) == 3)
    assert [m[4:] for m in said.messages] == [LARGE, b"after", LARGE]
    assert (said.aborts, len(said.lost), said.link.messages) == (1, 1, 3)
    said.close()
    assert said.aborts == 1
