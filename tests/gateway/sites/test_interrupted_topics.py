"""What is counted of a topic while its site is away, and when it is back."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.gateway import limits
from rmpa.gateway.rules import ForeignSource, SourceKind
from rmpa.gateway.sites.keys import MessageSource, SiteModule, SiteSource
from rmpa.gateway.sites.plans import SiteImport
from rmpa.gateway.sites.topics import SiteTopics
from rmpa.gateway.zenoh.threads import ZenohQos
from tests.gateway.memory_graph import MemoryGraph
from tests.gateway.memory_zenoh import MemoryZenoh, eventually
from tests.gateway.sites.site_bed import MD5, site_context

if TYPE_CHECKING:
    import pytest


QOS = ZenohQos()
ARM = SiteModule("yard", "arm", "0" * 32)
ENTRY = SiteImport(
    ForeignSource(SourceKind.TOPIC, "yard", "arm", "/talker", "/scan", "std_msgs/String"),
    SiteSource(ARM, SourceKind.TOPIC, "std_msgs/String", "/talker", "/scan"),
)


class Hall:
    """The site that imports; the other one is a publisher of its key."""

    def __init__(self) -> None:
        network = MemoryZenoh()
        self.graph = MemoryGraph()
        self.topics = SiteTopics(site_context("hall", self.graph, network.session()))
        yard = network.session()
        self.wanted = asyncio.Event()
        self.yard = yard.publisher(ENTRY.announced.key(), QOS, self._matching)

    def _matching(self, there: bool) -> None:
        (self.wanted.set if there else self.wanted.clear)()

    def send(self, *numbers: int) -> None:
        write = MessageSource(MD5, "/talker", ("yard",), run=7).writer()
        for number in numbers:
            self.yard.put(b"x", write(number, 0))

    def subscribe(self) -> None:
        self.graph.topics["/scan", "/talker"].on_demand(True)

    async def end(self) -> None:
        self.topics.hide(ENTRY)
        await self.topics.close()

    async def counts(self, messages: int, lost: int) -> None:
        topic = self.topics.imported(ENTRY)
        assert topic is not None
        await eventually(lambda: (topic.messages, topic.lost) == (messages, lost))


async def test_what_is_lost_while_a_site_is_away_is_counted_once_it_is_back() -> None:
    hall = Hall()
    hall.topics.show(ENTRY)
    hall.subscribe()
    await hall.wanted.wait()
    hall.send(1, 2, 3)
    await hall.counts(3, 0)
    hall.topics.hide(ENTRY)
    hall.topics.show(ENTRY)  # the site is back
    hall.subscribe()
    await hall.wanted.wait()
    hall.send(104, 105)
    await hall.counts(5, 100)
    await hall.end()


async def test_a_subscriber_that_comes_much_later_has_lost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "RESUMED_WITHIN", -1.0)
    hall = Hall()
    hall.topics.show(ENTRY)
    hall.subscribe()
    await hall.wanted.wait()
    hall.send(1)
    await hall.counts(1, 0)
    hall.topics.hide(ENTRY)
    hall.topics.show(ENTRY)
    hall.subscribe()
    await hall.wanted.wait()
    hall.send(104)
    await hall.counts(2, 0)
    await hall.end()


async def test_the_counts_of_many_interrupted_topics_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "INTERRUPTED_TOPICS_MAX", 0)
    hall = Hall()
    hall.topics.show(ENTRY)
    hall.subscribe()
    hall.topics.hide(ENTRY)
    assert hall.topics._interrupted == {}
