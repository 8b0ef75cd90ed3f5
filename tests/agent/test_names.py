"""Two agents whose names differ, and rules that change while they are linked."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.config.peer_rules import PeerRule
from rmpa.config.settings import Settings, TimeSettings
from tests.agent.test_agent import node, running, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.agent.agent import Agent
    from rmpa.core.facts import TopicInfo

PREFIX = (PeerRule("robot", "/{peer}"),)


@pytest.fixture
async def agents(settings: Callable[..., Settings]) -> AsyncIterator[tuple[Agent, Agent]]:
    """The computer, which has a prefix for the robot, and the robot."""
    async with running(replace(settings("pc"), peers=PREFIX), settings("robot")) as (pc, robot):
        yield pc, robot


def publishers(agent: Agent, topic: str) -> list[str]:
    return list(agent.core.state().publishers.get(topic, {}))


def info(agent: Agent, topic: str) -> TopicInfo:
    return next(found for found in agent.snapshots.build().topics if found.name == topic)


async def test_a_mismatch_has_each_sides_names(agents: tuple[Agent, Agent]) -> None:
    pc, robot = agents
    async with node("base", robot) as base, node("driver", pc) as driver:
        cmd = await driver.advertise("/robot/cmd", "std_msgs/String")
        wrong = await base.subscribe("/cmd", "std_msgs/Int32")
        await until(lambda: wrong.refusals and pc.bridge.counters["mismatch.remote"])
        assert "md5" in next(iter(wrong.refusals.values()))
        assert robot.bridge.counters["mismatch.md5"] == 1
        for agent, topic in ((pc, "/robot/cmd"), (robot, "/cmd")):
            [text] = info(agent, topic).mismatches
            assert "std_msgs/Int32" in text
        await until(lambda: cmd.subscribers == 0)


# --- what is said of a /clock that is followed --------------------------------------------------------------------


async def test_a_followed_clock_does_not_stay_home(settings: Callable[..., Settings]) -> None:
    shares = replace(settings("a"), time=TimeSettings(share=True))
    follows = replace(settings("b"), time=TimeSettings(follow="a"))
    async with running(shares, follows) as (a, b), node("simulator", a) as simulator, node("user", b) as user:
        await simulator.advertise("/clock", "rosgraph_msgs/Clock")
        await user.subscribe("/clock", "rosgraph_msgs/Clock", lambda _: None)
        await until(lambda: "/rmpa/a/simulator" in b.core.publishers("/clock"))
        (here,) = b.snapshots.build(frozenset({"/clock"})).topics
        assert [route.direction for route in here.routes] == ["in"]
        text = 'time.follow = "a": that module\'s comes here; one of this module does not cross'
        assert (here.crosses, here.policy) == (True, text)
        (there,) = a.snapshots.build(frozenset({"/clock"})).topics
        assert (there.crosses, there.policy) == (True, "time.share = true: peers may follow this module's time")


async def test_a_clock_without_followers_stays_home(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, _), node("simulator", a) as simulator:
        await simulator.advertise("/clock", "rosgraph_msgs/Clock")
        (shown,) = a.snapshots.build(frozenset({"/clock"})).topics
        assert (shown.crosses, shown.policy.startswith("built in: time does not cross")) == (False, True)
