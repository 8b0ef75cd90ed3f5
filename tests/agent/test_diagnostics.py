"""/diagnostics and the figures behind it, of whole agents in one process on loopback."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

from rmpa.core.contract import ContractRule
from rmpa.observe.control_client import ControlClient
from rmpa.observe.health import TOPIC
from rmpa.observe.snapshot import Snapshot
from rmpa.ros.types.definitions import ARRAY_TYPE, known_description
from tests.agent.test_agent import node, running, until

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rmpa.config.settings import Settings
    from rmpa.observe.snapshot import RouteInfo
    from rmpa.ros.node.endpoints import Publisher, Received


async def shown(name: str, place: Path, topic: str) -> RouteInfo:
    def ask() -> Snapshot:
        with ControlClient(place / f"{name}.sock") as client:
            return client.call("snapshot", Snapshot, topics=[topic])

    snapshot = await asyncio.to_thread(ask)
    assert [info.name for info in snapshot.topics] == [topic]
    (route,) = snapshot.topics[0].routes
    return route


async def send(publisher: Publisher, count: int, period: float) -> None:
    for number in range(count):
        publisher.publish(publisher.make({"data": f"number {number}"}))
        await asyncio.sleep(period)


class Statuses:
    """Keeps the last status of each name, by level, message and values."""

    def __init__(self) -> None:
        self.found: dict[str, tuple[int, str, dict[str, str]]] = {}
        self.headers: set[tuple[str, str]] = set()
        self.messages = 0

    def __call__(self, received: Received) -> None:
        self.messages += 1
        self.headers.add((received.header["type"], received.header["md5sum"]))
        for s in received.message.status:
            self.found[s.name] = (s.level, s.message, {v.key: v.value for v in s.values})


async def test_figures_of_a_topic_that_crosses(settings: Callable[..., Settings], tmp_path: Path) -> None:
    rule = ContractRule(("/chatter",), (), {"deadline": 30.0})
    async with (
        running(settings("a"), replace(settings("b"), contracts=(rule,))) as (a, b),
        node("talker", a) as talker,
        node("hearer", b) as hearer,
    ):
        publisher = await talker.advertise("/chatter", "std_msgs/String")
        subscriber = await hearer.subscribe("/chatter")
        await until(lambda: publisher.subscribers and subscriber.publishers)
        await until(lambda: all(at.link.clock_offset is not None for at in b.bridge.sessions.linked()))
        await send(publisher, 20, 0.01)
        await until(
            lambda: all(
                flow.quality.messages == 20
                for at in b.bridge.sessions.linked()
                for flow in b.bridge.topics.imports.flows(at.peer)
            )
        )
        route = await shown("b", tmp_path, "/chatter")
        assert (route.peer, route.direction, route.messages, route.lost) == ("a", "in", 20, 0)
        assert route.rate is not None
        assert 5 < route.rate < 200
        assert route.period is not None
        assert route.period.count == 19
        assert route.latency is not None
        assert route.latency.min > -route.latency.error
        assert route.latency.max < 1
        assert 0 < route.latency.error < 0.5
        assert route.contract == {"deadline": 30.0}
        there = await shown("a", tmp_path, "/chatter")
        assert (there.peer, there.direction, there.messages, there.rate) == ("b", "out", 20, None)


async def test_diagnostics_of_a_link_its_topics_and_their_end(settings: Callable[..., Settings]) -> None:
    async with (
        running(settings("a"), settings("b")) as (a, b),
        node("hearer", b) as hearer,
    ):
        statuses = Statuses()
        await hearer.subscribe(TOPIC, ARRAY_TYPE, statuses)
        async with node("talker", a) as talker:
            publisher = await talker.advertise("/chatter", "std_msgs/String")
            subscriber = await hearer.subscribe("/chatter")
            await until(lambda: publisher.subscribers and subscriber.publishers)
            await send(publisher, 10, 0.02)
            await until(lambda: statuses.found.get("rmpa: a: /chatter", (0, "", {}))[2].get("messages") == "10")
        level, _, values = statuses.found["rmpa: a: /chatter"]
        assert (level, "rate (Hz)" in values, values["node"]) == (0, True, "/talker")
        assert statuses.found["rmpa: a"][1].startswith("linked, round trip ")
        assert statuses.found["rmpa: this module"][0] == 0
        assert statuses.headers == {(ARRAY_TYPE, known_description(ARRAY_TYPE).md5sum)}
        # Our own node's topic stays in its graph, on either side.
        assert list(b.core.state().publishers[TOPIC]) == ["/rmpa"]
        assert list(a.core.state().publishers[TOPIC]) == ["/rmpa"]
        await a.close()
        await until(lambda: statuses.found["rmpa: a"][0] == 3)


async def test_nothing_is_made_for_nobody(settings: Callable[..., Settings]) -> None:
    async with running(settings("a")) as (a,), node("hearer", a) as hearer:
        statuses = Statuses()
        subscriber = await hearer.subscribe(TOPIC, ARRAY_TYPE, statuses)
        await until(lambda: statuses.messages)
        await subscriber.close()
        seen = statuses.messages
        await asyncio.sleep(1.2)
        assert statuses.messages == seen
    assert a.core.state().publishers.get(TOPIC) is None
