"""Nodes of a module and a robot with zenoh-bridge-ros1, by a gateway with its agent and a real router."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from rmpa.gateway.ros1_bridge.io.joining import make_ros1_bridge_neighbour
from tests.agent.test_agent import Sink, node, settings, until
from tests.agent.test_services import connect
from tests.gateway.graph.gateways import joined, string
from tests.gateway.ros1_bridge.test_neighbour import STRING_KEY, TRIGGER_KEY, Bridge, open_bridge
from tests.gateway.zenoh_bed import bed

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.agent import Agent
    from rmpa.config.settings import Settings

__all__ = ["settings"]
pytest.importorskip("zenoh")


@asynccontextmanager
async def bridged(settings: Callable[..., Settings]) -> AsyncIterator[tuple[Agent, Bridge]]:
    """A module whose gateway speaks the format, and a bridge."""
    gateway = settings("g")
    async with bed() as net, joined([settings("a")], [gateway]) as mesh:
        neighbour = make_ros1_bridge_neighbour(mesh.graphs[0], await net.session(), gateway, mesh.agents[1])
        bridge = await open_bridge(net)
        try:
            neighbour.start()
            yield mesh.agents[0], bridge
        finally:
            await neighbour.close()
            await asyncio.to_thread(bridge.session.close)


async def test_topics_cross_both_ways_between_a_node_and_a_bridge(settings: Callable[..., Settings]) -> None:
    async with bridged(settings) as (a, bridge), node("talker", a) as talker, node("hearer", a) as hearer:
        chatter = await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: bridge.announced("pub", f"{STRING_KEY}/chatter"))
        assert chatter.subscribers == 0, "nothing crosses unless it is wanted"
        bridge.bridge_from_zenoh(f"{STRING_KEY}/chatter")
        await until(lambda: chatter.subscribers)
        for number in range(100):
            chatter.publish(chatter.make({"data": f"number {number}"}))
        await until(lambda: len(bridge.samples) == 100)
        assert bridge.samples == [string(f"number {number}") for number in range(100)]

        bridge.announce("pub", f"{STRING_KEY}/robot/state")
        sink = Sink()
        subscriber = await hearer.subscribe("/robot/state", "std_msgs/String", sink)
        publisher = bridge.bridge_to_zenoh(f"{STRING_KEY}/robot/state")

        def there() -> bool:
            bridge.beat()
            return bool(subscriber.publishers and publisher.matching_status.matching)

        await until(there)
        assert set(a.core.publishers("/robot/state")) == {"/rmpa/ros1_bridge/zenoh_bridge_ros1"}
        for number in range(100):
            publisher.put(string(f"state {number}"))
        await until(lambda: sink.count(100))
        assert sink.heard == [f"state {number}" for number in range(100)]
        own = [heard for heard in bridge.heard if heard.startswith("ros1_discovery_info/rmpa/pub/")]
        assert own
        assert not any(heard.endswith("/robot/state") for heard in own), (
            "what is of a bridge is not offered to bridges"
        )


async def test_a_bridge_s_service_stands_in_the_module_and_answers(settings: Callable[..., Settings]) -> None:
    async with bridged(settings) as (a, bridge):
        key = f"{TRIGGER_KEY}/robot/stop"
        bridge.serve(key, lambda request: b"\x01\x02\x00\x00\x00ok" + request)
        bridge.announce("srv", key)

        def there() -> bool:
            bridge.beat()
            return "/robot/stop" in a.core.state().services

        await until(there)
        connection = await connect(a, "/robot/stop")
        assert await connection.call(b"") == (True, b"\x01\x02\x00\x00\x00ok")
        connection.close()
