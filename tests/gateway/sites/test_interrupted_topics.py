"""What is counted of a topic while its site is away, and when it is back."""

from __future__ import annotations

import asyncio

import pytest

from rmpa.gateway import limits
from rmpa.gateway.rules import ForeignSource, SourceKind
from rmpa.gateway.sites.keys import MessageSource, SiteModule, SiteSource
from rmpa.gateway.sites.plans import SiteImport
from rmpa.gateway.sites.topics import SiteTopics
from rmpa.gateway.zenoh.threads import ZenohQos
from tests.gateway.memory_graph import MemoryGraph
from tests.gateway.memory_zenoh import MemoryZenoh, eventually
from tests.gateway.sites.site_bed import MD5, site_context

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
        self.yard = yard.publisher(ENTRY.announced.key(), ZenohQos(), self._matching)

    def _matching(self, there: bool) -> None:
        (self.wanted.set if there else self.wanted.clear)()

    def send(self, *numbers: int) -> None:
        write = MessageSource(MD5, "/talker", ("yard",), run=7).writer()
        for number in numbers:
            self.yard.put(b"x", write(number, 0))

    async def subscribe(self) -> None:
        self.topics.show(ENTRY)
        self.graph.topics["/scan", "/talker"].on_demand(True)
        await self.wanted.wait()

    async def counts(self, messages: int, lost: int) -> None:
        topic = self.topics.imported(ENTRY)
        assert topic is not None
        await eventually(lambda: (topic.messages, topic.lost) == (messages, lost))


@pytest.mark.parametrize(
    ("within", "most", "messages", "lost"),
    [(10.0, 10, 5, 100), (-1.0, 10, 5, 0), (10.0, 0, 2, 0)],
    ids=["at once", "much later: nothing was lost", "too many topics were interrupted: it begins anew"],
)
async def test_what_is_lost_while_a_site_is_away_is_counted_once_it_is_back(
    monkeypatch: pytest.MonkeyPatch, within: float, most: int, messages: int, lost: int
) -> None:
    monkeypatch.setattr(limits, "RESUMED_WITHIN", within)
    monkeypatch.setattr(limits, "INTERRUPTED_TOPICS_MAX", most)
    hall = Hall()
    await hall.subscribe()
    hall.send(1, 2, 3)
    await hall.counts(3, 0)
    hall.topics.hide(ENTRY)
    await hall.subscribe()  # the site is back
    hall.send(104, 105)
    await hall.counts(messages, lost)
    hall.topics.hide(ENTRY)
    await hall.topics.close()
