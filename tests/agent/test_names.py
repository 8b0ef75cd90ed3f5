"""Two agents whose names differ, and rules that change while they are linked."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import pytest

from rmpa.config.peer_rules import PeerRule, PolicySettings
from rmpa.config.settings import TimeSettings
from rmpa.core.contract import ContractRule
from tests.agent.test_agent import Sink, node, running, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.agent.agent import Agent
    from rmpa.bridge.topics.import_route import RemoteTopic
    from rmpa.config.settings import Settings
    from rmpa.observe.snapshot import TopicInfo

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


def imported(agent: Agent, topic: str) -> RemoteTopic:
    """A topic of the other module."""
    return next(entry for entry in agent.bridge.topics.imports if entry.wire.topic == topic)


async def test_topics_have_each_sides_names_both_ways(agents: tuple[Agent, Agent]) -> None:
    pc, robot = agents
    async with node("base", robot) as base, node("driver", pc) as driver:
        odom = await base.advertise("/odom", "std_msgs/String")
        cmd = await driver.advertise("/robot/cmd", "std_msgs/String")
        seen, obeyed = Sink(), Sink()
        here = await driver.subscribe("/robot/odom", "std_msgs/String", seen)
        there = await base.subscribe("/cmd", "std_msgs/String", obeyed)
        await until(lambda: here.publishers and there.publishers)
        odom.publish(odom.make({"data": "here"}))
        cmd.publish(cmd.make({"data": "go"}))
        await until(lambda: seen.heard and obeyed.heard)
        assert (seen.heard, obeyed.heard) == (["here"], ["go"])
        assert publishers(pc, "/robot/odom") == ["/rmpa/robot/base"]
        assert publishers(robot, "/cmd") == ["/rmpa/pc/driver"]
        assert not publishers(pc, "/odom")
        assert not publishers(robot, "/robot/cmd")
        assert [(r.direction, r.wire) for r in info(pc, "/robot/odom").routes] == [("in", "/odom")]
        assert [(r.direction, r.wire) for r in info(pc, "/robot/cmd").routes] == [("out", "/cmd")]
        assert [(r.direction, r.wire) for r in info(robot, "/odom").routes] == [("out", "")]


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


@pytest.mark.parametrize("far", [False, True], ids=["here", "there"])
async def test_a_reload_keeps_unchanged_routes_and_connections(agents: tuple[Agent, Agent], far: bool) -> None:
    pc, robot = agents
    async with node("base", robot) as base, node("driver", pc) as driver:
        names = ("steady", "named", "denied", "tuned")
        talkers = {name: await base.advertise(f"/{name}", "std_msgs/String") for name in names}
        heard = {name: Sink() for name in names}
        listeners = {name: await driver.subscribe(f"/robot/{name}", "std_msgs/String", heard[name]) for name in names}
        await until(lambda: all(listener.publishers for listener in listeners.values()))
        steady, talker = imported(pc, "/steady"), talkers["steady"]
        route = steady.route
        link = next(iter(pc.bridge.sessions.linked())).link
        for number in range(20):
            talker.publish(talker.make({"data": str(number)}))
        agent, prefix = (robot, "/") if far else (pc, "/robot/")
        near_rule = replace(PREFIX[0], remap_in=(("/named", "/robot/other"),))
        far_rule = PeerRule("pc", "", (), (("/named", "/other"),))
        agent.apply_settings(
            replace(
                agent.settings,
                policy=PolicySettings(deny=(f"{prefix}denied",)),
                peers=(far_rule if far else near_rule,),
                contracts=(ContractRule((f"{prefix}tuned",), (), {"depth": 3}),),
            )
        )
        for number in range(20, 40):
            talker.publish(talker.make({"data": str(number)}))
        await until(lambda: publishers(pc, "/robot/other") and not publishers(pc, "/robot/denied"))
        assert not publishers(pc, "/robot/named")
        again = Sink()
        renamed = await driver.subscribe("/robot/other", "std_msgs/String", again)
        await until(lambda: renamed.publishers and imported(pc, "/tuned").state == "open")
        await until(partial(heard["steady"].count, 40))
        assert heard["steady"].heard == [str(number) for number in range(40)]
        assert (steady.route, steady.state) == (route, "open")
        assert imported(pc, "/steady") is steady
        assert next(iter(pc.bridge.sessions.linked())).link is link
        tuned = imported(pc, "/tuned").contract
        assert tuned is not None
        assert tuned.depth == 3
        talkers["named"].publish(talkers["named"].make({"data": "x"}))
        await until(partial(again.count, 1))
        assert not listeners["named"].publishers
        assert not talkers["denied"].subscribers


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
