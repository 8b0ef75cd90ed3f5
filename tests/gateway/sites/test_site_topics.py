"""Topics between two sites: demand, types, latched messages, losses, several gateways."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

import rmpa
from rmpa.config.rules import Crossing, CrossingRule
from rmpa.gateway import limits
from rmpa.gateway.rules import ForeignSource, SourceKind
from rmpa.gateway.sites.keys import MessageSource, SiteModule, SiteSource, token_keys
from rmpa.gateway.sites.plans import SiteImport
from rmpa.gateway.sites.topics import ImportedTopic, SiteTopics
from rmpa.gateway.zenoh.threads import ZenohQos
from tests.gateway.memory_graph import MemoryGraph
from tests.gateway.memory_zenoh import MemoryPublisher, MemoryZenoh, eventually
from tests.gateway.sites.site_bed import MD5, SiteBed, described, site_bed, site_context


@pytest.fixture
async def bed() -> AsyncIterator[SiteBed]:
    async with site_bed() as made:
        yield made


async def test_nothing_is_read_at_one_site_until_a_node_subscribes_at_the_other(bed: SiteBed) -> None:
    yard, hall = await bed.pair()
    source = yard.graph.add("/scan", described())
    await eventually(lambda: hall.shows("/scan"))
    assert hall.topic("/scan").source.module == "arm"
    assert yard.graph.send(source, b"early") == 0
    topic = await hall.subscribed("/scan")
    assert topic.description == described()
    yard.graph.send(source, b"one")
    yard.graph.send(source, b"two")
    await eventually(lambda: topic.messages == [b"one", b"two"])
    topic.on_demand(False)
    await eventually(lambda: not yard.graph.taps)


async def test_a_subscriber_that_comes_back_gets_the_present_latched_message_alone() -> None:
    """By a real router, whose sessions keep the latched message."""
    zenoh_bed = pytest.importorskip("tests.gateway.zenoh_bed")
    async with zenoh_bed.bed() as zenoh, site_bed(zenoh) as bed:
        yard, hall = await bed.pair()
        source = yard.graph.add("/map", described(latching=True))
        yard.graph.send(source, b"first")
        topic = await hall.subscribed("/map")
        await eventually(lambda: topic.messages)
        topic.on_demand(False)
        await eventually(lambda: not yard.graph.taps)
        async with asyncio.timeout(20):  # a thread undeclares the cache that has the first message
            while await hall.session.get("rmpa/*/yard/arm/t/odd_msgs%Odd/map/@adv/**?_anyke"):
                pass
        yard.graph.send(source, b"second")
        topic.on_demand(True)
        await eventually(lambda: topic.messages[-1] == b"second")
        assert topic.messages == [b"first", b"forgotten", b"second"]


async def test_two_latched_publishers_of_one_topic_each_keep_their_last_message(bed: SiteBed) -> None:
    yard, hall = await bed.pair()
    for node in ("/one", "/two"):
        yard.graph.send(yard.graph.add("/map", described(latching=True), node), node.encode())
    topics = [await hall.subscribed("/map", node) for node in ("/one", "/two")]
    await eventually(lambda: [topic.messages for topic in topics] == [[b"/one"], [b"/two"]])


async def test_a_loss_at_the_end_is_counted_although_no_message_follows(
    bed: SiteBed, monkeypatch: pytest.MonkeyPatch
) -> None:
    yard, hall = await bed.pair()
    source = yard.graph.add("/burst", described())
    topic = await hall.subscribed("/burst")
    await eventually(lambda: yard.graph.send(source, b"first"))
    await eventually(lambda: topic.messages)
    monkeypatch.setattr(MemoryPublisher, "put_all", lambda *_: 0)
    for _ in range(3):
        yard.graph.send(source, b"swallowed by the network")
    await eventually(lambda: hall.imported("/burst").lost == 3)
    assert hall.imported("/burst").messages == 1


async def test_the_last_message_of_a_latched_topic_is_sent_when_its_limit_lets_it(bed: SiteBed) -> None:
    yard, hall = await bed.site("yard", rules=(CrossingRule(rate=4.0),)), await bed.site("hall")
    source = yard.graph.add("/state", described(latching=True))
    topic = await hall.subscribed("/state")
    for number in range(20):
        yard.graph.send(source, str(number).encode())
    await eventually(lambda: topic.messages and topic.messages[-1] == b"19")
    assert len(topic.messages) < 10


async def test_a_gateway_of_another_release_is_told(bed: SiteBed, caplog: pytest.LogCaptureFixture) -> None:
    await bed.site("yard")
    other = await bed.session()
    other.token(f"rmpa/2/hall/-gateway/005/{'0' * 32}")
    told = f"the gateway of site hall speaks rmpa/2, we speak rmpa/1 (rmpa {rmpa.__version__}): install the same"
    await eventually(lambda: told in caplog.text)
    assert caplog.text.count("we speak") == 1


async def test_a_topic_that_a_rule_keeps_from_one_site_is_neither_sent_nor_announced_there(bed: SiteBed) -> None:
    rules = (CrossingRule(names=("/secret",), sites=("hall",), crossing=Crossing.NONE),)
    yard, hall, cellar = await bed.site("yard", rules=rules), await bed.site("hall"), await bed.site("cellar")
    eavesdropped: list[bytes] = []
    told: list[str] = []
    listener = await bed.session()
    listener.subscribe("rmpa/1/*/*/t/**", lambda sample: eavesdropped.append(sample.payload))
    for key in token_keys("hall"):
        listener.watch_tokens(key, lambda key, _alive: told.append(key))
    secret, scan = yard.graph.add("/secret", described()), yard.graph.add("/scan", described())
    topic, other = await cellar.subscribed("/secret"), await hall.subscribed("/scan")
    yard.graph.send(secret, b"plan")
    yard.graph.send(scan, b"ranges")
    await eventually(lambda: topic.messages and other.messages and eavesdropped)
    assert (topic.messages, other.messages) == ([b"plan"], [b"ranges"])
    assert not hall.shows("/secret")
    assert eavesdropped == [b"ranges"]
    assert not [key for key in told if "secret" in key]
    assert yard.exported("/secret", "cellar").messages == 1


async def test_each_site_has_the_limits_of_the_first_rule_that_fits_it(bed: SiteBed) -> None:
    yard = await bed.site("yard", rules=(CrossingRule(sites=("thin*",), rate=1.0),))
    thin, hall = await bed.site("thin7"), await bed.site("hall")
    source = yard.graph.add("/scan", described())
    slow, fast = await thin.subscribed("/scan"), await hall.subscribed("/scan")
    for _ in range(50):
        yard.graph.send(source, b"ranges")
    await eventually(lambda: len(fast.messages) == 50 and slow.messages)
    assert len(slow.messages) < 10


async def test_a_publisher_with_another_definition_is_described_anew(bed: SiteBed) -> None:
    yard, hall = await bed.pair()
    source = yard.graph.add("/odd", described())
    topic = await hall.subscribed("/odd")
    other = described(md5sum="f" * 32)
    yard.graph.describe_anew(source, other)
    await eventually(lambda: yard.graph.taps[0].description == other)
    yard.graph.send(source, b"new form")
    await eventually(lambda: topic.messages == [b"new form"])
    assert topic.description == other


async def test_another_gateway_takes_over_and_the_other_site_keeps_its_topics(bed: SiteBed) -> None:
    first = await bed.site("yard", 1)
    await eventually(lambda: first.neighbour.leads)
    second, hall = await bed.site("yard", 2, graph=first.graph), await bed.site("hall")
    source = first.graph.add("/scan", described())
    topic = await hall.subscribed("/scan")
    await eventually(lambda: first.graph.send(source, b"0") == 1)
    await eventually(lambda: topic.messages)
    assert not second.neighbour.leads
    await first.session.close()
    await eventually(lambda: second.neighbour.leads)
    await first.neighbour.close()
    await eventually(lambda: first.graph.send(source, b"1") == 1)
    await eventually(lambda: topic.messages[-1] == b"1")
    assert hall.topic("/scan") is topic, "a takeover must not take the topic down and up"


async def test_two_topics_of_one_node_that_a_rule_gives_one_name_come_and_go(
    bed: SiteBed, caplog: pytest.LogCaptureFixture
) -> None:
    yard, hall = await bed.site("yard"), await bed.site("hall", rules=(CrossingRule(name="/pose"),))
    sources = [yard.graph.add(name, described()) for name in ("/odom", "/fused")]
    await eventually(lambda: len(hall.neighbour.imported) == 2)
    for source in sources:
        yard.graph.remove(source)
    await eventually(lambda: not hall.neighbour.imported)
    assert "failed" not in caplog.text


async def test_a_definition_is_answered_by_its_md5_sum(bed: SiteBed) -> None:
    yard, hall = await bed.pair()
    yard.graph.add("/odd", described())
    await hall.subscribed("/odd")
    [reply] = await hall.session.get(f"rmpa/1/yard/arm/d/m/{MD5}")
    assert reply.payload == b"string data\n"
    [unknown] = await hall.session.get(f"rmpa/1/yard/arm/d/m/{'0' * 32}")
    assert not unknown.ok


async def test_a_message_without_a_true_attachment_is_counted_and_dropped(bed: SiteBed) -> None:
    yard, hall = await bed.pair()
    yard.graph.add("/scan", described())
    topic = await hall.subscribed("/scan")
    stranger = await bed.session()
    publisher = stranger.publisher("rmpa/1/yard/arm/t/odd_msgs%Odd/scan", ZenohQos(), lambda _there: None)
    publisher.put(b"x", b"nonsense")
    await eventually(lambda: hall.neighbour.context.counters["site.message.malformed"])
    assert topic.messages == []


# --- What is counted of a topic while its site is away, and when it is back -----------------------------------------

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
        self.topic = ImportedTopic(ENTRY, self.topics)
        self.graph.topics["/scan", "/talker"].on_demand(True)
        await self.wanted.wait()

    async def counts(self, messages: int, lost: int) -> None:
        await eventually(lambda: (self.topic.messages, self.topic.lost) == (messages, lost))


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
    hall.topic.close()
    await hall.subscribe()  # the site is back
    hall.send(104, 105)
    await hall.counts(messages, lost)
    hall.topic.close()
    await hall.topics.close()
