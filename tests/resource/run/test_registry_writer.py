from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from rmpa.resource import limits
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.descriptor import describe
from rmpa.resource.run.registry_writer import FILE
from rmpa.resource.run.resource_node import ResourceNode, run_all
from rmpa.resource.run.resource_registry import ResourceRegistry
from rmpa.resource.run.store import ResourceStore, read_state
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

PROXY = "/rmpa/base/lidar"


@pytest.fixture
async def core(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[RosCore]:
    monkeypatch.setattr(limits, "KNOWN_LOOK", 0.05)
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


def declared(name: str) -> Resource:
    one = Resource(name, role="sensing")
    one.profile(offers={}, name="plain")(lambda: None)
    return one


def seen(path: Path) -> dict[tuple[str, str], str]:
    rows = ResourceRegistry(read_state(path)).all if path.exists() else []
    return {(each.path, each.caller): each.descriptor.name for each in rows}


async def until_seen(path: Path, wanted: dict[tuple[str, str], str]) -> None:
    async with asyncio.timeout(30):
        while await asyncio.to_thread(seen, path) != wanted:
            await asyncio.sleep(0.02)


async def test_registry_keeps_resources_that_are_gone(core: RosCore, tmp_path: Path) -> None:
    stop, ready = asyncio.Event(), asyncio.Event()
    running = asyncio.create_task(run_all([declared("ear"), declared("eye")], core.uri, stop, ready.set, tmp_path))
    await asyncio.wait_for(ready.wait(), 30)
    both = {("/ear", "/ear"): "ear", ("/eye", "/eye"): "eye"}
    await until_seen(tmp_path / FILE, both)
    async with Node(PROXY, master_uri=core.uri) as node:
        for topic, text in (("/lidar", describe(declared("lidar"), "/lidar").serialize()), ("/strange", "{}")):
            publisher = await node.advertise(f"{topic}/descriptor", "std_msgs/String", latch=True)
            publisher.publish(publisher.make({"data": text}))
        await node.advertise("/other/descriptor", "std_msgs/Bool", latch=True)
        await until_seen(tmp_path / FILE, {**both, ("/lidar", PROXY): "lidar"})
        # A topic of another type is left alone: whoever published it would be told of a mismatch.
        assert not any(topic == "/other/descriptor" for topic in core.state().subscribers)
    async with asyncio.timeout(30):
        while any(topic.startswith(("/lidar", "/strange")) for topic in core.state().subscribers):
            await asyncio.sleep(0.02)
    stop.set()
    await running
    rows = ResourceRegistry(await asyncio.to_thread(read_state, tmp_path / FILE)).all
    times = {each.path: each.last_ns for each in rows}
    assert times["/lidar"] < times["/ear"]
    # They are there again for the next one, although only one of them runs.
    again = ResourceNode(declared("ear"), core.uri, registry=ResourceStore(tmp_path / FILE))
    await again.start()
    assert again.registry is not None
    assert again.registry.registry is not None
    assert {each.path for each in again.registry.registry.all} == {"/ear", "/eye", "/lidar"}
    await again.close()


async def test_registry_shares_the_subscription_of_demands(core: RosCore, tmp_path: Path) -> None:
    """What it asks listens to that descriptor already, and a node listens to a topic once."""
    eye, keeper = ResourceNode(declared("eye"), core.uri), declared("keeper")
    await eye.start()
    keeper.input("/eye/picture", "std_msgs/String")
    keeper.asks("eye")
    member = ResourceNode(keeper, core.uri, registry=ResourceStore(tmp_path / FILE))
    await member.start()
    await until_seen(tmp_path / FILE, {("/keeper", "/keeper"): "keeper", ("/eye", "/eye"): "eye"})
    await member.close()
    await eye.close()


async def test_unusable_registry_is_reported(core: RosCore, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    member = ResourceNode(declared("ear"), core.uri, registry=ResourceStore(tmp_path / "file" / FILE))
    await member.start()
    assert "other resources are not kept: " in member.problems()[1][0]
    await member.close()
