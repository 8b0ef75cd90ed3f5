"""Messages that go between gateways together: golden bytes, what is no batch, both ways, older gateways, counts."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.config.gateway_rules import CrossingRule
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.sites.attachment import AttachmentReader, AttachmentWriter, SiteAttachment
from rmpa.gateway.sites.batch import join_batch, split_batch
from rmpa.gateway.sites.io.exported_topic import ExportedTopic
from rmpa.gateway.sites.io.imported_topic import ImportedTopic
from rmpa.gateway.sites.sequence import SequenceCounter
from rmpa.gateway.sites.topic_header import TopicHeader
from rmpa.gateway.zenoh_api import ZenohQos
from tests.gateway.sites.site_bed import MD5, Site, described, site_bed
from tests.gateway.zenoh_bed import until

if TYPE_CHECKING:
    from rmpa.gateway.neighbour import MeshSource

WRITER = AttachmentWriter(MD5, "/talker", ("yard",), run=7)
GOLDEN_PAYLOAD = bytes.fromhex("02000000 6869 00000000 01000000 21")
GOLDEN_ATTACHMENT = (
    bytes.fromhex("01 02 2a00000000000000 15cd5b0700000000 992ce8a1687cec8c8bd883ec73ca41d1")
    + b"\x07/talker\x01\x04yard"
    + bytes.fromhex("0700000000000000")
)


def test_golden_bytes() -> None:
    assert WRITER.batch([b"hi", b"", b"!"], 42, 123456789) == (GOLDEN_PAYLOAD, GOLDEN_ATTACHMENT)
    assert [bytes(each) for each in split_batch(GOLDEN_PAYLOAD)] == [b"\2\0\0\0hi", b"\0\0\0\0", b"\1\0\0\0!"]
    sequence, stamp, source = AttachmentReader().read(GOLDEN_ATTACHMENT)
    assert (sequence, stamp, source.batch, source.latched, source.run) == (42, 123456789, True, False, 7)
    assert SiteAttachment.parse(GOLDEN_ATTACHMENT).serialize() == GOLDEN_ATTACHMENT


def test_the_attachment_of_a_single_message_is_as_before() -> None:
    assert WRITER.write(42, 123456789) == GOLDEN_ATTACHMENT.replace(b"\x01\x02", b"\x01\x00", 1)


@pytest.mark.parametrize("length", [0, *(n for n in range(1, len(GOLDEN_PAYLOAD)) if n not in (6, 10))])
def test_a_batch_that_ends_within_a_message_is_refused(length: int) -> None:
    with pytest.raises(RemoteProtocolError, match="whole number"):
        split_batch(GOLDEN_PAYLOAD[:length])


def test_a_batch_of_too_many_messages_is_refused() -> None:
    assert len(split_batch(bytes(4 * limits.BATCH_READ_MAX))) == limits.BATCH_READ_MAX
    with pytest.raises(RemoteProtocolError, match="1024"):
        split_batch(bytes(4 * limits.BATCH_READ_MAX + 4))


@given(st.lists(st.binary(max_size=80), min_size=1, max_size=20))
def test_any_messages_come_back(messages: list[bytes]) -> None:
    assert [bytes(each[4:]) for each in split_batch(join_batch(messages))] == messages


@given(st.binary(max_size=60))
def test_any_bytes_are_a_batch_or_refused(data: bytes) -> None:
    with contextlib.suppress(RemoteProtocolError):
        assert b"".join(split_batch(data)) == data


@given(
    st.lists(st.tuples(st.integers(1, 2), st.integers(1, 12), st.integers(1, 6)), max_size=8),
    st.none() | st.tuples(st.integers(1, 2), st.integers(0, 12)),
)
def test_messages_together_are_counted_as_one_by_one(
    batches: list[tuple[int, int, int]], announced: tuple[int, int] | None
) -> None:
    together, singly = SequenceCounter(), SequenceCounter()
    if announced is not None:
        together.announced(*announced)
        singly.announced(*announced)
    for run, first, count in batches:
        new = [singly.take(run, number) for number in range(first, first + count)]
        old = together.take_batch(run, first, count)
        assert new == [False] * old + [True] * (count - old)
        assert (together.received, together.old, together.lost) == (singly.received, singly.old, singly.lost)


def test_a_header_without_the_word_has_no_batches() -> None:
    header = TopicHeader(described(), "/talker", batches=True)
    assert TopicHeader.parse(header.serialize()) == header
    assert not TopicHeader.parse(header.serialize().replace(b', "batches": true', b"")).batches
    assert not TopicHeader.parse(header.serialize().replace(b'"batches": true', b'"batches": 1')).batches


# --- between gateways ---------------------------------------------------------------------------------------------


class Flood:
    """Sends numbered messages, some in each turn of the loop, until it is stopped."""

    def __init__(self, site: Site, source: MeshSource) -> None:
        self.sent = 0
        self._site, self._source = site, source
        self._stopped = False
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def _run(self) -> None:
        while not self._stopped:
            for _ in range(20):
                self.sent += self._site.graph.send(self._source, b"%d" % self.sent)
            await asyncio.sleep(0.005)

    async def stop(self) -> int:
        """Returns the number of messages that were sent."""
        self._stopped = True
        await self._task
        return self.sent


async def test_a_quick_topic_comes_in_batches_without_a_loss_at_the_change_and_counts_the_same() -> None:
    async with site_bed() as bed:
        yard, hall = await bed.pair()
        source = yard.graph.add("/fast", described())
        topic = await hall.subscribed("/fast")
        flood = Flood(yard, source)
        exported = next(iter(next(iter(yard.topic_part._exported.values())).values()))
        await until(lambda: topic.batches and not exported._matched, 30)
        batches = len(topic.batches)
        await until(lambda: len(topic.batches) > batches + 20)
        sent = await flood.stop()
        await until(lambda: len(topic.messages) >= sent)
        assert topic.messages == [b"%d" % number for number in range(sent)]
        (row,) = hall.topics("in")
        assert (row["messages"], row["lost"], row["old"], row["dropped"]) == (sent, 0, 0, 0)
        assert yard.topics("out")[0]["messages"] == sent


async def test_a_plain_program_has_each_message_for_itself_beside_a_gateway_that_has_batches() -> None:
    async with site_bed() as bed:
        yard, hall = await bed.pair()
        source = yard.graph.add("/fast", described())
        program = await bed.zenoh.session()
        got: list[bytes] = []
        program.subscribe("rmpa/1/yard/**", lambda sample: got.append(sample.payload))
        topic = await hall.subscribed("/fast")
        flood = Flood(yard, source)
        await until(lambda: len(topic.batches) > 20, 30)
        sent = await flood.stop()
        await until(lambda: len(topic.messages) >= sent and len(got) >= sent)
        assert topic.messages == got[-sent:] == [b"%d" % number for number in range(sent)]


async def test_a_gateway_that_knows_no_batches_goes_on_with_single_messages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[bool] = []

    def older(topic: ImportedTopic, header: TopicHeader) -> None:
        asked.append(topic._wants_batches)
        known(topic, TopicHeader.parse(header.serialize().replace(b', "batches": true', b"")))

    known = ImportedTopic._described
    monkeypatch.setattr(ExportedTopic, "offer_batches", lambda _: None)
    monkeypatch.setattr(ImportedTopic, "_described", older)
    async with site_bed() as bed:
        yard, hall = await bed.pair()
        source = yard.graph.add("/fast", described())
        topic = await hall.subscribed("/fast")
        flood = Flood(yard, source)
        await until(lambda: True in asked, 30)
        sent = flood.sent
        await until(lambda: len(topic.messages) > sent + 500)
        sent = await flood.stop()
        await until(lambda: len(topic.messages) >= sent)
        assert topic.messages == [b"%d" % number for number in range(sent)]
        assert not topic.batches


async def test_the_limits_of_a_rule_count_each_message_of_a_batch() -> None:
    async with site_bed() as bed:
        yard = await bed.site("yard", rules=(CrossingRule(names=("/fast",), rate=1500.0),))
        hall = await bed.site("hall")
        source = yard.graph.add("/fast", described())
        topic = await hall.subscribed("/fast")
        flood = Flood(yard, source)
        await until(lambda: len(topic.batches) > 20, 30)
        sent = await flood.stop()
        limited = int(str(yard.topics("out")[0]["limited"]))
        await until(lambda: len(topic.messages) >= sent - limited)
        (row,) = hall.topics("in")
        assert (row["messages"], row["lost"]) == (sent - limited, 0) == (len(topic.messages), 0)


async def test_what_is_no_batch_is_counted_and_the_next_one_is_read() -> None:
    async with site_bed() as bed:
        hall = await bed.site("hall")
        yard = await bed.site("yard")
        yard.graph.add("/fast", described())
        topic = await hall.subscribed("/fast")
        await until(lambda: topic.description is not None)
        program = await bed.zenoh.session()
        publisher = program.publisher("rmpa/1/yard/arm/t/odd_msgs%Odd/fast", ZenohQos(), lambda _: None)
        publisher.put(b"\xff\xff\xff\xff", GOLDEN_ATTACHMENT)
        publisher.put(GOLDEN_PAYLOAD, GOLDEN_ATTACHMENT)
        await until(lambda: len(topic.messages) == 3)
        assert topic.messages == [b"hi", b"", b"!"]
        counters = hall.topic_part.counters
        assert counters["site.message.malformed"] == 1
