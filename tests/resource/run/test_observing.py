"""What arrives at who asks counts at who is asked: of resources and of plain clients."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.resource.declare.requirements import at_least, at_most
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.client import ResourceClient
from rmpa.resource.run.resource_node import ResourceNode
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


@pytest.fixture
async def camera(core: RosCore) -> AsyncIterator[ResourceNode]:
    one = Resource("camera", role="sensing", physical=False)
    frames = one.output("frames", "std_msgs/String")
    for name, cost in (("full", 2), ("small", 1)):
        one.profile(offers={"rate": 50}, cost=cost, name=name)(lambda: None)
    one.adaptation(window="200 ms", settle="200 ms", cool_down="60 s")
    one.task(rate=50, name="shoot")(lambda: frames.publish(data="x"))
    member = ResourceNode(one, core.uri)
    await member.start()
    yield member
    await member.close()


async def until(fits: Any) -> None:
    async with asyncio.timeout(30):
        while not fits():
            await asyncio.sleep(0.02)


async def test_observed_quality_of_inputs_is_reported(core: RosCore, camera: ResourceNode) -> None:
    one = Resource("viewer", role="controlling")
    one.input("/camera/frames", "std_msgs/String")
    one.input("/elsewhere", "std_msgs/String", required=False)
    one.asks("camera", rate=at_least("10 Hz"), frames__age=at_most("1 s"))
    one.profile(offers={}, name="look")(lambda: None)
    one.adaptation(window="200 ms")
    viewer = ResourceNode(one, core.uri)
    await viewer.start()
    seen = camera.adapter._observed_by
    await until(lambda: 20 < float(seen.observed("/viewer", "rate") or 0) < 100)
    assert float(seen.observed("/viewer", "frames.age") or 0) > 0
    assert seen.observed("/viewer", "latency") is None  # it did not ask for that
    await viewer.close()


async def test_adaptation_follows_the_clients_observation(core: RosCore, camera: ResourceNode) -> None:
    assert camera.adapter.loop.profile in ("", "small")
    async with Node("pilot", master_uri=core.uri) as node, ResourceClient(node, "camera") as client:
        await client.require(rate=at_least("20 Hz", hard=True))
        async with asyncio.timeout(30):
            while camera.adapter.loop.profile != "full":  # 50 Hz leave, and 5 arrive
                await client.observe(rate="5 Hz")
                await asyncio.sleep(0.05)
        assert camera.adapter.loop.alarm is not None
        await until(lambda: camera.adapter.loop.alarm is None)  # it says nothing more, so what leaves counts
        await client.observe(rat=5)
        await until(lambda: client.answer is not None and "did you mean rate" in client.answer.message)
