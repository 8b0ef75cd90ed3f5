"""Recordings are played into a core."""

from __future__ import annotations

import asyncio
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from rmpa.core.errors import RmpaError
from rmpa.record.format import ModuleRecord, RecordedSource, SegmentWriter
from rmpa.record.merge import Timeline
from rmpa.record.play import Player, PlayOptions
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.endpoints import Received
from rmpa.ros.node.node import Node
from rmpa.ros.types.messages import MessageType
from tests.record.conftest import SECOND, START, Record, source

SCAN, MAP = source("/scan", "/laser", module="arm"), source("/map", "/map_server", latching=True, module="base")


@pytest.fixture(autouse=True)
def _warm() -> None:
    """Compile what a test would block with."""
    for name in ("std_msgs/String", "rosgraph_msgs/Clock"):
        kind = MessageType(name)
        kind.deserialize(kind.serialize(kind.make()))


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


async def test_a_node_that_comes_while_it_plays_stands_in_until_it_goes(core: RosCore, recording: Record) -> None:
    path = recording("run", {SCAN: [(n / 100, f"{n}") for n in range(6000)], MAP: [(0.0, "map")]})
    told: list[str] = []
    async with Node("player", master_uri=core.uri) as node, asyncio.timeout(30):
        player = Player(node, Timeline([path]), PlayOptions(), told.append)
        task = asyncio.create_task(player.run())
        async with Node("laser_under_test", master_uri=core.uri) as live:
            await live.advertise("/scan", "std_msgs/String")
            while told != ["not played: /scan: /laser_under_test publishes it"]:
                await asyncio.sleep(0.02)
            count = player.count
            await asyncio.sleep(0.1)  # ten messages are due
            assert player.count == count
        while told[1:] != ["played again: /scan"]:
            await asyncio.sleep(0.02)
        assert player.left_out == {}
        while player.count == count:
            await asyncio.sleep(0.02)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_a_node_stands_in_for_itself_where_several_share_a_topic(core: RosCore, recording: Record) -> None:
    left, right = source("/tf", "/left"), source("/tf", "/right")
    path = recording("arm", {left: [(0.0, "l")], right: [(0.1, "r")]})
    async with Node("left", master_uri=core.uri) as live:
        await live.advertise("/tf", "std_msgs/String")
        player, heard = await played(core, path, ["/tf"])
        assert (texts(heard["/tf"]), player.left_out) == (["r"], {"/tf": "/left publishes it"})
    async with Node("/rmpa/arm/right", master_uri=core.uri) as proxy:
        await proxy.advertise("/tf", "std_msgs/String")
        _, heard = await played(core, path, ["/tf"])
        assert texts(heard["/tf"]) == ["l"]


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"modules": ("leg",)}, "the recording has nothing of leg"),
        ({"remap": {"/sacn": "/x"}}, "no topic /sacn is played"),
        ({"remap": {"/scan": "/map"}}, "two topics are played as /map"),
    ],
)
async def test_a_name_that_fits_nothing_is_an_error(
    core: RosCore, recording: Record, options: dict[str, Any], error: str
) -> None:
    path = recording("run", {SCAN: [(0.0, "a")], MAP: [(0.0, "map")]})
    with pytest.raises(RmpaError, match=error):
        await played(core, path, [], **options)


async def test_it_is_played_again_and_again_latched_ones_first(core: RosCore, recording: Record) -> None:
    path = recording("run", {MAP: [(0.0, "map")], SCAN: [(0.1, "a"), (0.2, "b")]})
    heard: list[str] = []
    async with Node("listener", master_uri=core.uri) as ears, Node("player", master_uri=core.uri) as node:
        for topic in ("/scan", "/map"):
            await ears.subscribe(topic, "std_msgs/String", lambda received: heard.append(received.message.data))
        task = asyncio.create_task(Player(node, Timeline([path]), PlayOptions(loop=True, start=0.15)).run())
        async with asyncio.timeout(30):
            while len(heard) < 6:
                await asyncio.sleep(0.02)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    assert [one for one in heard[:6] if one == "b"] == ["b", "b", "b"]
    assert sorted(heard[:6]) == ["b", "b", "b", "map", "map", "map"]


@pytest.mark.parametrize("before", [None, True, False])
async def test_sim_time_is_as_before_after_any_end(core: RosCore, recording: Record, before: bool | None) -> None:
    """Ended as by Ctrl-C; and killed, after which the next player sets it as it was."""
    path = recording("run", {SCAN: [(float(n), f"{n}") for n in range(60)]})
    async with Node("asker", master_uri=core.uri) as asker, asyncio.timeout(30):
        if before is not None:
            await asker.set_param("/use_sim_time", before)
        async with Node("first", master_uri=core.uri) as node:
            player = Player(node, Timeline([path]), PlayOptions(clock=True))
            task = asyncio.create_task(player.run())
            while not player.count:
                await asyncio.sleep(0.02)
            assert await asker.get_param("/use_sim_time") is True
            left = await asker.get_param("/rmpa_play/use_sim_time")
            with pytest.raises(RmpaError, match="/first publishes /clock: end it, or play without --clock"):
                await played(core, path, [], clock=True, remap={"/scan": "/other"})
            assert await asker.get_param("/use_sim_time") is True, "it is the first one's"
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        assert await asker.get_param("/use_sim_time", default=None) is before
        assert not await asker.has_param("/rmpa_play")
        await asker.set_param("/use_sim_time", True)
        await asker.set_param("/rmpa_play/use_sim_time", left)
        await played(core, path, [], duration=0.5)
        assert await asker.get_param("/use_sim_time", default=None) is before


async def test_the_time_of_a_simulation_is_played_as_it_was(core: RosCore, recording: Record) -> None:
    kind = MessageType("rosgraph_msgs/Clock")
    path = recording("run", {SCAN: [(0.0, "a"), (1.0, "b")]})
    clock = RecordedSource("/clock", kind.name, kind.md5sum, kind.definition, "/gazebo")
    with path.with_name("2.mcap").open("wb") as file:
        writer = SegmentWriter(file, ModuleRecord(name="run"))
        for number in range(3):
            at = START + number * SECOND // 10
            writer.write(clock, at, at, kind.serialize(kind.given(None, {"clock": 7.0 + number})))
        writer.finish()
    _, heard = await played(core, path.parent, ["/clock"], clock=True, rate=2.0)
    assert [message.clock.sec for message in heard["/clock"]] == [7, 8, 9]


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
