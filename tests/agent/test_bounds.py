"""What is beyond ``[limits]``, of whole agents in one process: both ends say so, and a reload brings it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from rmpa.bridge import limits as bridge_limits
from rmpa.config.settings import LimitSettings, Settings
from rmpa.ros import limits as ros_limits
from tests.agent.test_agent import node, running, until
from tests.agent.test_diagnostics import Statuses

if TYPE_CHECKING:
    from collections.abc import Callable

    import pytest

    from rmpa.agent.agent import Agent
    from rmpa.core.facts import BoundInfo
    from rmpa.observe.snapshot import Snapshot
    from rmpa.observe.why.diagnosis import Diagnosis


def beyond(agent: Agent) -> tuple[BoundInfo, ...]:
    (peer,) = agent.snapshots.build().peers
    return peer.beyond


async def why(agent: Agent, topic: str) -> Diagnosis:
    (found,) = await agent.why.answer({"name": topic})
    return found


def register(agent: Agent, nodes: range) -> None:
    """Publishers whose nodes nobody calls."""
    for number in nodes:
        uri = "http://127.0.0.1:9/"
        assert agent.core.call("registerPublisher", f"/n{number}", f"/t{number}", "std_msgs/String", uri)[0] == 1


def stands(agent: Agent, *topics: int) -> bool:
    return {f"/t{n}" for n in topics} == {topic for topic in agent.core.state().publishers if topic.startswith("/t")}


async def test_hidden_nodes_are_told_and_come_with_a_reload(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bridge_limits, "RECONCILE_INTERVAL", 0.2)
    monkeypatch.setattr(ros_limits, "NODE_CHECK_INTERVAL", 1e6)  # the nodes are made up
    few = replace(settings("near"), limits=LimitSettings(nodes=2))
    async with running(few, settings("far")) as (near, far), node("watcher", near) as watcher:
        statuses = Statuses()
        await watcher.subscribe("/diagnostics", "diagnostic_msgs/DiagnosticArray", statuses)
        register(far, range(4))
        await until(lambda: stands(near, 0, 1))
        await until(lambda: "nodes hidden here (limit 2)" in statuses.found.get("rmpa: far", (0, "", {}))[2])
        level, text, _ = statuses.found["rmpa: far"]
        assert (level, "2 nodes with 2 topics of far stay hidden here" in text) == (1, True)
        (here,) = beyond(near)
        assert (here.kind, here.limit, here.hidden) == ("nodes", 2, 2)
        for agent in (near, far):  # asked at either end
            found = await why(agent, "/t3")
            assert found.failed is not None
            assert (found.failed.name, "limits.nodes = 2" in found.failed.text) == ("limit", True)

        near.apply_settings(replace(few, limits=LimitSettings(nodes=4)))
        await until(lambda: stands(near, 0, 1, 2, 3))
        assert beyond(near) == ()


async def test_topics_beyond_the_limit_of_either_side_are_told(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bridge_limits, "RECONCILE_INTERVAL", 0.2)
    monkeypatch.setattr(ros_limits, "NODE_CHECK_INTERVAL", 1e6)
    few = replace(settings("near"), limits=LimitSettings(topics=2))
    more = replace(settings("far"), limits=LimitSettings(topics=3))
    async with running(few, more) as (near, far):
        register(far, range(5))
        await until(lambda: stands(near, 0, 1))
        (here,) = beyond(near)
        assert (here.kind, here.hidden) == ("topics", 1)
        (note,) = [note for note in far.snapshots.build().notes if "limits.topics" in note]
        assert note.startswith("2 topics of this module are offered to no peer: more than limits.topics = 3")
        one_there, none_told = await why(near, "/t2"), await why(near, "/t4")
        assert one_there.failed is not None
        assert none_told.failed is not None
        assert (one_there.failed.name, "limits.topics = 2" in one_there.failed.text) == ("limit", True)
        assert (none_told.failed.name, "limits.topics = 3" in none_told.failed.text) == ("offer", True)


async def test_a_snapshot_with_a_bound_has_what_is_used_and_else_what_is_asked_for(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros_limits, "NODE_CHECK_INTERVAL", 1e6)  # the nodes are made up
    async with running(settings("near"), settings("far")) as (near, far):
        register(far, range(8))
        for number in range(8):
            uris = ("rosrpc://127.0.0.1:9", "http://127.0.0.1:9/")
            assert far.core.call("registerService", f"/n{number}", f"/s{number}", *uris)[0] == 1
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

        def ask(**args: object) -> Snapshot:
            return near.operations.snapshot(args)

        none = ask(topics=[])
        assert (none.services, none.topics, [peer.name for peer in none.peers]) == ((), (), ["far"])
        agent = ask(topics=[], peers=False)
        assert (agent.peers, agent.agent.name) == ((), "near")
        assert [info.name for info in ask(topics=[], services=["/s2"]).services] == ["/s2"]
        for services in (ask(topics=[], services=True).services, ask().services):
            assert {"/s1", "/s2"} <= {info.name for info in services}
