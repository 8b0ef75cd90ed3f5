"""Topics between two sites over a real Zenoh router: demand, types, latched messages, losses, several gateways."""

from __future__ import annotations

import asyncio

import pytest

import rmpa
from rmpa.config.rules import Crossing, CrossingRule
from rmpa.gateway.sites.keys import token_keys
from rmpa.gateway.zenoh.threads import QueuedPublisher
from tests.gateway.sites.site_bed import MD5, described, site_bed
from tests.gateway.zenoh_bed import until

pytest.importorskip("zenoh")


async def test_nothing_is_read_at_one_site_until_a_node_subscribes_at_the_other() -> None:
    async with site_bed() as bed:
        yard, hall = await bed.pair()
        source = yard.graph.add("/scan", described())
        await until(lambda: hall.shows("/scan"))
        assert hall.topic("/scan").source.module == "arm"
        assert yard.graph.send(source, b"early") == 0
        topic = await hall.subscribed("/scan")
        assert topic.description == described()
        yard.graph.send(source, b"one")
        yard.graph.send(source, b"two")
        await until(lambda: len(topic.messages) == 2)
        assert topic.messages == [b"one", b"two"]
        topic.on_demand(False)
        await until(lambda: not yard.graph.taps)


async def test_a_subscriber_that_comes_back_gets_the_present_latched_message_alone() -> None:
    async with site_bed() as bed:
        yard, hall = await bed.pair()
        source = yard.graph.add("/map", described(latching=True))
        yard.graph.send(source, b"first")
        topic = await hall.subscribed("/map")
        await until(lambda: topic.messages)
        topic.on_demand(False)
        await until(lambda: not yard.graph.taps)
        async with asyncio.timeout(20):  # a thread undeclares the cache that has the first message
            while await hall.session.get("rmpa/*/yard/arm/t/odd_msgs%Odd/map/@adv/**?_anyke"):
                pass
        yard.graph.send(source, b"second")
        topic.on_demand(True)
        await until(lambda: topic.messages[-1] == b"second")
        assert topic.messages == [b"first", b"forgotten", b"second"]


async def test_two_latched_publishers_of_one_topic_each_keep_their_last_message() -> None:
    async with site_bed() as bed:
        yard, hall = await bed.pair()
        for node in ("/one", "/two"):
            yard.graph.send(yard.graph.add("/map", described(latching=True), node=node), node.encode())
        topics = [await hall.subscribed("/map", node) for node in ("/one", "/two")]
        await until(lambda: all(topic.messages for topic in topics))
        assert [topic.messages for topic in topics] == [[b"/one"], [b"/two"]]


async def test_a_loss_at_the_end_is_counted_although_no_message_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    async with site_bed() as bed:
        yard, hall = await bed.pair()
        source = yard.graph.add("/burst", described())
        topic = await hall.subscribed("/burst")
        await until(lambda: yard.graph.send(source, b"first"))
        await until(lambda: topic.messages)
        monkeypatch.setattr(QueuedPublisher, "put_all", lambda *_: 0)
        for _ in range(3):
            yard.graph.send(source, b"swallowed by the network")
        await until(lambda: hall.imported("/burst").lost == 3)
        assert hall.imported("/burst").messages == 1


async def test_the_last_message_of_a_latched_topic_is_sent_when_its_limit_lets_it() -> None:
    async with site_bed() as bed:
        yard = await bed.site("yard", rules=(CrossingRule(rate=4.0),))
        hall = await bed.site("hall")
        source = yard.graph.add("/state", described(latching=True))
        topic = await hall.subscribed("/state")
        for number in range(20):
            yard.graph.send(source, str(number).encode())
        await until(lambda: topic.messages and topic.messages[-1] == b"19")
        assert len(topic.messages) < 10


async def test_a_gateway_of_another_release_is_told(caplog: pytest.LogCaptureFixture) -> None:
    async with site_bed() as bed:
        await bed.site("yard")
        other = await bed.zenoh.session()
        other.token(f"rmpa/2/hall/-gateway/005/{'0' * 32}")
        told = f"the gateway of site hall speaks rmpa/2, we speak rmpa/1 (rmpa {rmpa.__version__}): install the same"
        await until(lambda: told in caplog.text)
    assert caplog.text.count("we speak") == 1


async def test_a_topic_that_a_rule_keeps_from_one_site_is_neither_sent_nor_announced_there() -> None:
    async with site_bed() as bed:
        rules = (CrossingRule(names=("/secret",), sites=("hall",), crossing=Crossing.NONE),)
        yard = await bed.site("yard", rules=rules)
        hall, cellar = await bed.site("hall"), await bed.site("cellar")
        eavesdropped: list[str] = []
        told: list[str] = []
        listener = await bed.zenoh.session()
        listener.subscribe("rmpa/1/*/*/t/**", lambda sample: eavesdropped.append(sample.key))
        for key in token_keys("hall"):
            listener.watch_tokens(key, lambda key, _alive: told.append(key))
        secret, scan = yard.graph.add("/secret", described()), yard.graph.add("/scan", described())
        topic, other = await cellar.subscribed("/secret"), await hall.subscribed("/scan")
        yard.graph.send(secret, b"plan")
        yard.graph.send(scan, b"ranges")
        await until(lambda: topic.messages and other.messages and eavesdropped)
        assert (topic.messages, other.messages) == ([b"plan"], [b"ranges"])
        assert not hall.shows("/secret")
        assert not [key for key in (*eavesdropped, *told) if "secret" in key]
        assert yard.exported("/secret", "cellar").messages == 1


async def test_each_site_has_the_limits_of_the_first_rule_that_fits_it() -> None:
    async with site_bed() as bed:
        yard = await bed.site("yard", rules=(CrossingRule(sites=("thin*",), rate=1.0),))
        thin, hall = await bed.site("thin7"), await bed.site("hall")
        source = yard.graph.add("/scan", described())
        slow, fast = await thin.subscribed("/scan"), await hall.subscribed("/scan")
        for _ in range(50):
            yard.graph.send(source, b"ranges")
        await until(lambda: len(fast.messages) == 50 and slow.messages)
        assert len(slow.messages) < 10


async def test_a_site_that_is_addressed_and_was_away_counts_what_it_lost() -> None:
    async with site_bed() as bed:
        yard = await bed.site("yard", rules=(CrossingRule(sites=("street",), crossing=Crossing.NONE),))
        hall = await bed.site("hall")
        source = yard.graph.add("/scan", described())
        topic = await hall.subscribed("/scan")
        yard.graph.send(source, b"1")
        await until(lambda: topic.messages)
        await bed.zenoh.stop_router()
        await until(lambda: not hall.shows("/scan"))
        yard.graph.send(source, b"2")
        await bed.zenoh.start_router()
        again = await hall.subscribed("/scan")
        await until(lambda: yard.exported("/scan", "hall").wanted)
        yard.graph.send(source, b"3")
        await until(lambda: b"3" in again.messages)
        await until(lambda: hall.imported("/scan").lost == 1 or b"2" in again.messages)


async def test_a_publisher_with_another_definition_is_described_anew() -> None:
    async with site_bed() as bed:
        yard, hall = await bed.pair()
        source = yard.graph.add("/odd", described())
        topic = await hall.subscribed("/odd")
        other = described(md5sum="f" * 32)
        yard.graph.describe_anew(source, other)
        await until(lambda: yard.graph.taps[0].description == other)
        yard.graph.send(source, b"new form")
        await until(lambda: topic.messages == [b"new form"])
        assert topic.description == other


async def test_another_gateway_takes_over_and_the_other_site_keeps_its_topics() -> None:
    async with site_bed() as bed:
        first = await bed.site("yard", 1)
        await until(lambda: first.neighbour.leads)
        second = await bed.site("yard", 2, graph=first.graph)
        hall = await bed.site("hall")
        source = first.graph.add("/scan", described())
        topic = await hall.subscribed("/scan")
        await until(lambda: first.graph.send(source, b"0") == 1)
        await until(lambda: topic.messages)
        assert not second.neighbour.leads
        loop = asyncio.get_running_loop()
        lost_at = loop.time()
        await first.session.close()
        await until(lambda: second.neighbour.leads)
        assert loop.time() - lost_at < 10
        await first.neighbour.close()
        await until(lambda: first.graph.send(source, b"1") == 1)
        await until(lambda: topic.messages[-1] == b"1")
        assert hall.topic("/scan") is topic, "a takeover must not take the topic down and up"


async def test_a_definition_is_answered_by_its_md5_sum() -> None:
    async with site_bed() as bed:
        yard, hall = await bed.pair()
        yard.graph.add("/odd", described())
        await hall.subscribed("/odd")
        [reply] = await hall.session.get(f"rmpa/1/yard/arm/d/m/{MD5}", timeout=5)
        assert reply.payload == b"string data\n"
        [unknown] = await hall.session.get(f"rmpa/1/yard/arm/d/m/{'0' * 32}", timeout=5)
        assert not unknown.ok


async def test_a_message_without_a_true_attachment_is_counted_and_dropped() -> None:
    async with site_bed() as bed:
        yard, hall = await bed.pair()
        yard.graph.add("/scan", described())
        topic = await hall.subscribed("/scan")
        from rmpa.gateway.zenoh.threads import ZenohQos

        stranger = await bed.zenoh.session()
        publisher = stranger.publisher("rmpa/1/yard/arm/t/odd_msgs%Odd/scan", ZenohQos(), lambda _there: None)

        def malformed() -> int:
            publisher.put(b"x", b"nonsense")
            return hall.neighbour.context.counters["site.message.malformed"]

        await until(malformed)
        assert topic.messages == []
