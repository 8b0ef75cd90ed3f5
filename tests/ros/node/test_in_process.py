"""A subscription within the process: what it gets, what it counts as, and how it ends."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from rmpa.core import limits as core_limits
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.subscription import InProcessConnection
from rmpa.ros.wire.tcpros import LENGTH, Header, TopicDescription
from tests.ros.node.peers import STRING

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
