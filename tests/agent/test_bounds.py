"""What is beyond ``[limits]``, of whole agents in one process: both ends say so, and a reload brings it."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge import limits as bridge_limits
from rmpa.config.settings import LimitSettings
from rmpa.core.errors import ConfigError
from rmpa.observe.control_client import ControlClient
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.ros import limits as ros_limits
from tests.agent.test_agent import node, running, until
from tests.agent.test_diagnostics import Statuses, settings

if TYPE_CHECKING:
    from pathlib import Path

    from rmpa.agent.agent import Agent
    from rmpa.observe.peer_info import BoundInfo
    from rmpa.observe.snapshot import Snapshot


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


async def test_hidden_nodes_are_told_and_come_with_a_reload(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
        assert (here.kind, here.limit, here.hidden) == ("nodes", 2, 2)
        for name in ("near", "far"):  # asked at either end
            found = await why(name, tmp_path, "/t3")
            assert found.failed is not None
            assert (found.failed.name, "limits.nodes = 2" in found.failed.text) == ("limit", True)

        near.apply_settings(replace(few, limits=LimitSettings(nodes=4)))
        await until(lambda: stands(near, 0, 1, 2, 3))
        assert await beyond("near", tmp_path) == ()


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
        (note,) = [note for note in (await snapshot("far", tmp_path)).notes if "limits.topics" in note]
        assert note.startswith("2 topics of this module are offered to no peer: more than limits.topics = 3")
        one_there, none_told = await why("near", tmp_path, "/t2"), await why("near", tmp_path, "/t4")
        assert one_there.failed is not None
        assert none_told.failed is not None
        assert (one_there.failed.name, "limits.topics = 2" in one_there.failed.text) == ("limit", True)
        assert (none_told.failed.name, "limits.topics = 3" in none_told.failed.text) == ("offer", True)


async def test_a_snapshot_with_a_bound_has_what_is_used_and_counts_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros_limits, "NODE_CHECK_INTERVAL", 1e6)  # the nodes are made up
    async with running(settings("near", tmp_path), settings("far", tmp_path)) as (near, far):
        register(far, range(8))
        for number in range(8):
            assert (
                far.core.call(
                    "registerService", f"/n{number}", f"/s{number}", "rosrpc://127.0.0.1:9", "http://127.0.0.1:9/"
                )[0]
                == 1
            )
        await until(lambda: stands(near, *range(8)) and near.services.imports.shown("/s7") is not None)
        near.core.call("registerSubscriber", "/own", "/t6", "std_msgs/String", "http://127.0.0.1:9/")
        near.core.call("registerPublisher", "/own", "/mine", "std_msgs/String", "http://127.0.0.1:9/")
        await until(lambda: "/mine" in near.core.state().publishers)
        whole = near.snapshots.build()
        assert (whole.topics_left, whole.services_left) == (0, 0)
        enough = near.snapshots.build(most=len(whole.topics))
        assert [topic.name for topic in enough.topics] == [topic.name for topic in whole.topics]
        part = near.snapshots.build(most=0)
        shown = {topic.name for topic in part.topics}
        assert {"/t6", "/mine"} <= shown, "a node of this module subscribes to the one and publishes the other"
        assert not {"/t0", "/t7"} & shown
        assert len(part.topics) + part.topics_left == len(whole.topics)
        assert len(part.services) + part.services_left == len(whole.services)
        assert part.services_left == 8
        some = near.snapshots.build(most=len(part.topics) + 2)
        assert {topic.name for topic in some.topics} == shown | {"/t0", "/t1"}


async def test_a_snapshot_has_the_parts_that_are_asked_for(tmp_path: Path) -> None:
    async with running(settings("near", tmp_path), settings("far", tmp_path)) as (near, far):
        for name in ("/s1", "/s2"):
            assert far.core.call("registerService", "/n", name, "rosrpc://127.0.0.1:9", "http://127.0.0.1:9/")[0] == 1
        await until(lambda: near.services.imports.shown("/s2") is not None)
        ask = near.operations.snapshot
        assert ask({"topics": []}).services == ()
        assert ask({"topics": []}).topics == ()
        assert [peer.name for peer in ask({"topics": []}).peers] == ["far"]
        agent = ask({"topics": [], "peers": False})
        assert (agent.peers, agent.agent.name) == ((), "near")
        assert {"/s1", "/s2"} <= {info.name for info in ask({"topics": [], "services": True}).services}
        assert [info.name for info in ask({"topics": [], "services": ["/s2"]}).services] == ["/s2"]
        assert {"/s1", "/s2"} <= {info.name for info in ask({}).services}
        with pytest.raises(ConfigError, match="is not a number of topics"):
            ask({"most": "many"})
