"""A subscription within the process: what it gets, what it counts as, and how it ends."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from rmpa.core import limits as core_limits
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.subscription import InProcessConnection
from rmpa.ros.wire.tcpros import LENGTH, Header, TopicDescription
from tests.ros.node.peers import LATCHED, STRING

OTHER = TopicDescription("std_msgs/Int8", "27ffa0c9c4b8fb8492252bcad9e5c57b", "int8 data\n")
LARGE = core_limits.CUT_THROUGH_BYTES * 3


def framed(text: str, size: int = 0) -> bytes:
    body = text.encode().ljust(size, b".")
    return LENGTH.pack(len(body)) + body


class Parts:
    """Takes large messages in parts."""

    def __init__(self, got: list[bytes]) -> None:
        self.got = got
        self.sizes: list[int] = []
        self.now = bytearray()
        self.aborted = 0

    def begin(self, size: int) -> None:
        self.sizes.append(size)
        self.now = bytearray()

    def part(self, part: memoryview) -> None:
        self.now += part
        if len(self.now) == self.sizes[-1]:
            self.got.append(bytes(self.now))

    def abort(self) -> None:
        self.aborted += 1


class Bed(PublicationEvents):
    """A publication, and a subscription to it."""

    def __init__(self, description: TopicDescription | None = STRING, *, parts: bool = False) -> None:
        self.demand: list[bool] = []
        self.there: Publication | None = None
        self.publish(description)
        self.got: list[bytes] = []
        self.headers: list[Header] = []
        self.refused: list[str] = []
        self.lost: list[str] = []
        self.parts = Parts(self.got) if parts else None
        self.connection = InProcessConnection(
            "/chatter",
            "http://127.0.0.1:1/",
            "/rmpa",
            find=self.found,
            on_message=lambda message: self.got.append(bytes(message)),
            on_parts=self.parts,
            on_header=self.headers.append,
            on_refused=self.refused.append,
            on_lost=self.lost.append,
            number=7,
        )

    def publish(self, description: TopicDescription | None) -> Publication:
        self.publication = self.there = Publication("/chatter", "/talker", description, events=self)
        return self.publication

    def found(self) -> Callable[[InProcessConnection], None] | None:
        return self.there.attach if self.there is not None else None

    def first_subscriber(self) -> None:
        self.demand.append(True)

    def last_subscriber(self) -> None:
        self.demand.append(False)

    async def connect(self) -> None:
        self.connection.start()
        await asyncio.sleep(0)


async def test_it_gets_each_message_in_order_and_counts_as_a_subscriber() -> None:
    bed = Bed()
    await bed.connect()
    assert bed.demand == [True]
    assert bed.publication.listeners == ("/rmpa",)
    assert bed.headers[0]["type"] == "std_msgs/String"
    messages = [framed(f"number {i}") for i in range(100)] + [framed("large", LARGE), framed("last")]
    for message in messages:
        assert bed.publication.publish_framed(message) == 0
    assert bed.got == messages
    assert bed.connection.messages == 102
    (row,) = bed.publication.connections()
    assert (row.number, row.other, row.messages, row.connected) == (7, "/rmpa", 102, True)
    assert row.bytes == sum(map(len, messages)) == bed.connection.connection().bytes
    bed.connection.close()
    assert bed.demand == [True, False]
    bed.publication.publish_framed(framed("after"))
    assert len(bed.got) == 102


async def test_it_waits_until_the_type_is_known() -> None:
    bed = Bed(None)
    await bed.connect()
    assert bed.demand == [True]
    assert bed.headers == []
    bed.publication.publish_framed(framed("early"))
    bed.publication.describe(STRING)
    assert bed.connection.connected
    bed.publication.publish_framed(framed("late"))
    assert bed.got == [framed("late")]


async def test_a_message_in_parts_is_whole_for_those_that_take_no_parts() -> None:
    bed = Bed()
    await bed.connect()
    for text in ("first", "second"):
        whole = framed(text, LARGE)
        bed.publication.begin(len(whole))
        for start in range(0, len(whole), 1000):
            bed.publication.extend(memoryview(whole)[start : start + 1000])
        bed.publication.publish_framed(framed("small"))
    assert bed.got == [framed("first", LARGE), framed("small"), framed("second", LARGE), framed("small")]
    assert bed.connection.messages == 4


async def test_parts_are_passed_on_while_they_come() -> None:
    bed = Bed(parts=True)
    assert bed.parts is not None
    await bed.connect()
    whole = framed("image", LARGE)
    bed.publication.begin(len(whole))
    bed.publication.extend(whole[:1000])
    assert bytes(bed.parts.now) == whole[:1000]
    bed.publication.extend(whole[1000:])
    assert bed.got == [whole]
    bed.publication.publish_framed(whole)
    small = framed("small")
    bed.publication.begin(len(small))
    bed.publication.extend(small)
    assert bed.got == [whole, whole, small]
    assert bed.parts.sizes == [len(whole), len(whole)]


async def test_what_may_be_sent_on_is_not_overwritten_by_the_next_message() -> None:
    bed = Bed(parts=True)
    views: list[memoryview] = []
    keeping = InProcessConnection(
        "/chatter", "http://127.0.0.1:1/", "/a", find=bed.found, on_message=views.append, on_parts=bed.parts
    )
    keeping.start()
    await asyncio.sleep(0)
    for text in ("first", "other"):
        small = framed(text)
        bed.publication.begin(len(small))
        bed.publication.extend(small)
    assert [bytes(view) for view in views] == [framed("first"), framed("other")]


async def test_an_aborted_message_does_not_end_the_connection() -> None:
    for parts in (False, True):
        bed = Bed(parts=parts)
        await bed.connect()
        bed.publication.begin(LARGE)
        bed.publication.extend(bytes(1000))
        assert bed.publication.abort() == 0
        bed.publication.publish_framed(framed("next"))
        assert bed.got == [framed("next")]
        assert bed.parts is None or bed.parts.aborted == 1


async def test_it_connects_again_once_the_publication_is_back() -> None:
    bed = Bed()
    await bed.connect()
    bed.publication.withdraw()
    bed.there = None
    bed.got.clear()
    async with asyncio.timeout(20):
        while not bed.lost:
            await asyncio.sleep(0)
        assert bed.connection.fields == {}
        bed.publish(STRING)
        while not bed.connection.connected:
            await asyncio.sleep(0.001)
    bed.publication.publish_framed(framed("again"))
    assert bed.got == [framed("again")]


async def test_another_definition_is_told_by_another_header() -> None:
    bed = Bed()
    await bed.connect()
    assert bed.publication.describe(OTHER) == 1
    async with asyncio.timeout(20):
        while len(bed.headers) < 2:
            await asyncio.sleep(0.001)
    assert bed.headers[1]["type"] == "std_msgs/Int8"
    assert bed.lost


async def test_nothing_is_called_after_close() -> None:
    bed = Bed(None)
    await bed.connect()
    bed.connection.close()
    assert bed.demand == [True, False]
    bed.publication.describe(LATCHED)
    bed.publication.publish_framed(framed("late"))
    bed.publication.withdraw()
    await asyncio.sleep(0)
    assert (bed.headers, bed.got, bed.lost, bed.refused) == ([], [], [], [])


async def test_a_subscriber_may_close_while_it_gets_a_message() -> None:
    bed = Bed()
    closing: InProcessConnection = InProcessConnection(
        "/chatter", "http://127.0.0.1:1/", "/a", find=bed.found, on_message=lambda _: closing.close()
    )
    closing.start()
    await bed.connect()
    assert bed.publication.subscribers == 2
    bed.publication.publish_framed(framed("one"))
    assert bed.publication.listeners == ("/rmpa",)
    bed.publication.publish_framed(framed("two"))
    assert bed.got == [framed("one"), framed("two")]


async def test_a_wrong_topic_is_refused_once() -> None:
    bed = Bed()
    other = InProcessConnection(
        "/other",
        "http://127.0.0.1:1/",
        "/a",
        find=bed.found,
        on_message=lambda _: None,
        on_refused=bed.refused.append,
        on_lost=bed.lost.append,
    )
    other.start()
    await asyncio.sleep(0)
    assert "/other" in bed.refused[0]
    assert other.refused == bed.refused[0]
    assert not bed.lost
