"""What is beyond ``[limits]``, of whole agents in one process: both ends say so, and a reload brings it."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

from rmpa.bridge import limits as bridge_limits
from rmpa.config.settings import LimitSettings
from rmpa.observe.io.control_client import ControlClient
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.ros import limits as ros_limits
from tests.agent.test_agent import node, running, until
from tests.agent.test_diagnostics import Statuses, settings

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from rmpa.agent import Agent
    from rmpa.observe.snapshot import BoundInfo, Snapshot


async def snapshot(name: str, place: Path) -> Snapshot:
    def ask() -> Snapshot:
        with ControlClient(place / f"{name}.sock") as client:
            return client.snapshot()

    return await asyncio.to_thread(ask)


async def beyond(name: str, place: Path) -> tuple[BoundInfo, ...]:
    (peer,) = (await snapshot(name, place)).peers
    return peer.beyond


async def why(name: str, place: Path, topic: str) -> Diagnosis:
    def ask() -> tuple[Diagnosis, ...]:
        with ControlClient(place / f"{name}.sock") as client:
            return client.call("why", tuple[Diagnosis, ...], name=topic)

    (found,) = await asyncio.to_thread(ask)
    return found


def register(agent: Agent, nodes: range) -> None:
    """Publishers whose nodes nobody calls."""
    for number in nodes:
        uri = "http://127.0.0.1:9/"
        assert agent.core.call("registerPublisher", f"/n{number}", f"/t{number}", "std_msgs/String", uri)[0] == 1


def stands(agent: Agent, *topics: int) -> bool:
    return {f"/t{n}" for n in topics} == {topic for topic in agent.core.state().publishers if topic.startswith("/t")}


async def test_hidden_nodes_are_told_at_both_ends_and_come_with_a_reload(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bridge_limits, "RECONCILE_INTERVAL", 0.2)
    monkeypatch.setattr(ros_limits, "NODE_CHECK_INTERVAL", 1e6)  # the nodes are made up
    few = replace(settings("near", tmp_path), limits=LimitSettings(nodes=2))
    async with running(few, settings("far", tmp_path)) as (near, far), node("watcher", near) as watcher:
        statuses = Statuses()
        await watcher.subscribe("/diagnostics", "diagnostic_msgs/DiagnosticArray", statuses)
        register(far, range(4))
        await until(lambda: stands(near, 0, 1))
        await until(lambda: "nodes hidden here (limit 2)" in statuses.found.get("rmpa: far", (0, "", {}))[2])
        level, text, _ = statuses.found["rmpa: far"]
        assert (level, "2 nodes with 2 topics of far stay hidden here" in text) == (1, True)
        (here,) = await beyond("near", tmp_path)
        assert (here.kind, here.limit, here.hidden, here.here) == ("nodes", 2, 2, True)
        while not (there := await beyond("far", tmp_path)):
            await asyncio.sleep(0.05)
        assert (there[0].kind, there[0].limit, there[0].hidden, there[0].here) == ("nodes", 2, 2, False)
        assert "of this module stay hidden at near" in there[0].text
        for name in ("near", "far"):  # asked at either end
            found = await why(name, tmp_path, "/t3")
            assert found.failed is not None
            assert (found.failed.name, "limits.nodes = 2" in found.failed.text) == ("limit", True)

        near.apply_settings(replace(few, limits=LimitSettings(nodes=4)))
        await until(lambda: stands(near, 0, 1, 2, 3))
        assert await beyond("near", tmp_path) == ()
        while await beyond("far", tmp_path):
            await asyncio.sleep(0.05)


async def test_topics_beyond_the_limit_of_either_side_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bridge_limits, "RECONCILE_INTERVAL", 0.2)
    monkeypatch.setattr(ros_limits, "NODE_CHECK_INTERVAL", 1e6)
    few = replace(settings("near", tmp_path), limits=LimitSettings(topics=2))
    more = replace(settings("far", tmp_path), limits=LimitSettings(topics=3))
    async with running(few, more) as (near, far):
        register(far, range(5))
        await until(lambda: stands(near, 0, 1))
        (here,) = await beyond("near", tmp_path)
        assert (here.kind, here.hidden) == ("topics", 1)
        topics = {topic.name: topic.routes for topic in (await snapshot("near", tmp_path)).topics}
        assert (topics["/t2"][0].state, topics["/t2"][0].limit) == ("hidden", "topics")
        (note,) = [note for note in (await snapshot("far", tmp_path)).notes if "limits.topics" in note]
        assert note.startswith("2 topics of this module are offered to no peer: more than limits.topics = 3")
        one_there, none_told = await why("near", tmp_path, "/t2"), await why("near", tmp_path, "/t4")
        assert one_there.failed is not None
        assert none_told.failed is not None
        assert (one_there.failed.name, "limits.topics = 2" in one_there.failed.text) == ("limit", True)
        assert (none_told.failed.name, "limits.topics = 3" in none_told.failed.text) == ("offer", True)
