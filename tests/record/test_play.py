"""Recordings are played into a core."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from rmpa.core.errors import RmpaError
from rmpa.record.merge import Timeline
from rmpa.record.play import Player, PlayOptions
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.endpoints import Received
from rmpa.ros.node.node import Node
from rmpa.ros.types.messages import MessageType
from tests.record.conftest import Record, source

SCAN, MAP = source("/scan", "/laser", module="arm"), source("/map", "/map_server", latching=True, module="base")


@pytest.fixture(autouse=True)
def _warm() -> None:
    """Compile what a test would block with."""
    for name in ("std_msgs/String", "rosgraph_msgs/Clock"):
        kind = MessageType(name)
        kind.deserialize(kind.serialize(kind.make()))


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


def _hear(found: list[Any], received: Received) -> None:
    found.append(received.message)


async def played(
    core: RosCore, path: Path, listened: list[str], **options: Any
) -> tuple[Player, dict[str, list[Any]]]:
    """What subscribers hear of a recording that is played."""
    heard: dict[str, list[Any]] = {topic: [] for topic in listened}
    async with Node("listener", master_uri=core.uri) as ears, Node("player", master_uri=core.uri) as node:
        for topic, found in heard.items():
            kind = "rosgraph_msgs/Clock" if topic == "/clock" else "std_msgs/String"
            await ears.subscribe(topic, kind, partial(_hear, found))
        player = Player(node, Timeline([path]), PlayOptions(**options))
        async with asyncio.timeout(30):
            await player.run()
            while options.get("wait") and not all(heard.values()):
                await asyncio.sleep(0.02)
        await asyncio.sleep(0.1)
    return player, heard


def texts(found: list[Any]) -> list[str]:
    return [message.data for message in found]


async def test_all_is_played_at_its_pace(core: RosCore, recording: Record) -> None:
    path = recording("run", {SCAN: [(0.0, "a"), (0.5, "b"), (1.0, "c")], MAP: [(0.0, "map")]})
    loop = asyncio.get_running_loop()
    began = loop.time()
    _, heard = await played(core, path, ["/scan", "/map"], rate=2.0)
    assert loop.time() - began >= 0.5
    assert (texts(heard["/scan"]), texts(heard["/map"])) == (["a", "b", "c"], ["map"])


async def test_what_latched_before_the_start_comes_first(core: RosCore, recording: Record) -> None:
    path = recording("run", {SCAN: [(0.0, "a"), (1.0, "b"), (2.0, "c")], MAP: [(0.1, "old"), (0.2, "map")]})
    player, heard = await played(core, path, ["/scan", "/map"], start=0.9, duration=0.5, rate=10.0)
    assert (texts(heard["/scan"]), texts(heard["/map"])) == (["b"], ["map"])
    assert player.count == 2


async def test_only_some_topics_and_modules_under_other_names(core: RosCore, recording: Record) -> None:
    path = recording("run", {SCAN: [(0.0, "a")], MAP: [(0.0, "map")]})
    _, heard = await played(core, path, ["/other", "/scan", "/map"], modules=("arm",), remap={"/scan": "/other"})
    assert {topic: texts(found) for topic, found in heard.items()} == {"/other": ["a"], "/scan": [], "/map": []}
    with pytest.raises(RmpaError, match="nothing is played"):
        await played(core, path, [], topics=("/none",))


async def test_a_node_under_test_stands_in_for_the_recorded_one(core: RosCore, recording: Record) -> None:
    path = recording("run", {SCAN: [(0.0, "a")], MAP: [(0.0, "map")]})
    async with Node("laser_under_test", master_uri=core.uri) as node:
        await node.advertise("/scan", "std_msgs/String")
        player, heard = await played(core, path, ["/scan", "/map"])
        assert (texts(heard["/scan"]), texts(heard["/map"])) == ([], ["map"])
        assert player.left_out == {"/scan": "/laser_under_test publishes it"}
        player, _ = await played(core, path, [], over=True)
        assert player.count == 2


async def test_its_time_is_that_of_the_recording(core: RosCore, recording: Record) -> None:
    path = recording("run", {SCAN: [(n / 10, f"{n}") for n in range(10)]})
    async with Node("asker", master_uri=core.uri) as asker:
        task = asyncio.create_task(played(core, path, ["/clock"], clock=True, rate=2.0))
        async with asyncio.timeout(30):
            while not await asker.get_param("/use_sim_time", default=False):
                await asyncio.sleep(0.02)
        _, heard = await task
        assert not await asker.has_param("/use_sim_time")
    times = [message.clock.sec + message.clock.nanosec / 1e9 for message in heard["/clock"]]
    assert times == sorted(times)
    assert len(times) > 10
    assert 1_795_000_000 <= times[0] <= times[-1] <= 1_795_000_002


async def test_it_pauses_and_goes_step_by_step(core: RosCore, recording: Record) -> None:
    path = recording("run", {SCAN: [(0.0, "a"), (0.1, "b"), (0.2, "c")]})
    heard: list[str] = []
    async with Node("listener", master_uri=core.uri) as ears, Node("player", master_uri=core.uri) as node:
        await ears.subscribe("/scan", "std_msgs/String", lambda received: heard.append(received.message.data))
        player = Player(node, Timeline([path]), PlayOptions())
        player.pause()
        task = asyncio.create_task(player.run())
        async with asyncio.timeout(30):
            for count in (1, 2):
                player.step()
                while len(heard) < count:
                    await asyncio.sleep(0.01)
            assert (heard, player.paused) == (["a", "b"], True)
            player.pause()
            await task
    assert player.count == 3


async def test_a_topic_that_changes_its_type_is_played_as_it_was_first(core: RosCore, recording: Record) -> None:
    other = source("/scan", "/other")._replace(type="std_msgs/Int8", md5sum="27ffa0c9c4b8fb8492252bcad9e5c57b")
    path = recording("run", {SCAN: [(0.0, "a")], other: [(0.1, "b")]})
    player, _ = await played(core, path, [])
    assert player.left_out == {"/scan as std_msgs/Int8": "it is std_msgs/String at first"}
    assert player.count == 1
