"""``why`` between whole agents: facts that only one side has. A topic's whole way is walked in ``interop``."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge.peer_offers import CONFLICT
from rmpa.config.peer_rules import PeerRule, PolicySettings
from rmpa.core.errors import ConfigError
from rmpa.observe import limits as observe_limits
from tests.agent.test_agent import DEADLINE, node, running, until

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings
    from rmpa.observe.why.diagnosis import Diagnosis


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observe_limits, "WHY_WINDOW", 0.2)


async def ask(agent: Agent, name: str, peer: str | None = None) -> tuple[Diagnosis, ...]:
    return await agent.why.answer({"name": name, "peer": peer})


async def flowing(agent: Agent, name: str, peer: str | None = None) -> Diagnosis:
    """Ask until the only way is open: a busy machine may let a link fall for a moment."""
    async with asyncio.timeout(DEADLINE):
        while True:
            found = await ask(agent, name, peer)
            if len(found) == 1 and found[0].flows and not found[0].unasked:
                return found[0]
            await asyncio.sleep(0.05)


def stopped_at(found: tuple[Diagnosis, ...]) -> tuple[str, str]:
    """Name and text of the stage at which the only way ends."""
    (diagnosis,) = found
    assert diagnosis.failed is not None, diagnosis
    assert diagnosis.failed is diagnosis.stages[-1]
    assert not diagnosis.flows
    assert diagnosis.failed.remedy
    return diagnosis.failed.name, diagnosis.failed.text


@pytest.mark.parametrize("where", ["there", "here"])
async def test_policy_of_either_side(settings: Callable[..., Settings], where: str) -> None:
    deny = PolicySettings(deny=("/secret",))
    a, b = (settings("a", deny), settings("b")) if where == "there" else (settings("a"), settings("b", deny))
    async with running(a, b) as (first, second), node("talker", first) as talker:
        await talker.advertise("/secret", "std_msgs/String")
        if where == "here":
            await until(lambda: next(iter(second.bridge.topics.imports), None))
        for found in (await ask(second, "/secret", "a"), await ask(second, "/secret")):
            stage, text = stopped_at(found)
            assert stage == f"policy {where}"
            assert "bridge.deny has '/secret'" in text


async def test_built_in_rules_and_other_types(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b), node("one", a) as one, node("two", b) as two:
        await one.advertise("/clock", "rosgraph_msgs/Clock")
        stage, text = stopped_at(await ask(b, "/clock", "a"))
        assert stage == "policy there"
        assert "time does not cross" in text
        await one.advertise("/x", "std_msgs/String")
        await two.advertise("/x", "std_msgs/Bool")
        await until(lambda: any(entry.cause == CONFLICT for entry in b.bridge.topics.imports))
        stage, text = stopped_at(await ask(b, "/x", "a"))
        assert stage == "type"
        assert "std_msgs/String" in text
        assert "std_msgs/Bool" in text


async def test_unknown_peers_and_names(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (_, b):
        (found,) = await ask(b, "/x", "aa")
        assert found.failed is not None
        assert found.failed.name == "peer"
        assert found.failed.remedy.startswith("did you mean a?")
        with pytest.raises(ConfigError, match="not a topic"):
            await ask(b, "x y")
    async with running(settings("lonely")) as (lonely,), node("talker", lonely) as talker:
        await talker.advertise("/robot1/x", "std_msgs/String")
        (found,) = await ask(lonely, "/x")
        assert stopped_at((found,))[0] == "publisher"
        assert found.failed is not None
        assert found.failed.remedy == "did you mean /robot1/x?"


async def test_names_of_a_peer_with_a_prefix(settings: Callable[..., Settings]) -> None:
    pc = replace(settings("pc"), peers=(PeerRule("robot", prefix="/robot1"),))
    async with (
        running(settings("robot"), pc) as (robot, base),
        node("driver", robot) as driver,
        node("pilot", base) as pilot,
    ):
        odom = await driver.advertise("/odom", "std_msgs/String")
        heard = await pilot.subscribe("/robot1/odom", "std_msgs/String", lambda _: None)
        await until(lambda: odom.subscribers and heard.publishers)
        odom.publish(odom.make({"data": "here"}))
        for name in ("/robot1/odom", "/odom"):  # as it is called here, and as the robot calls it
            found = await flowing(base, name, "robot")
            assert (found.name, found.flows) == ("/robot1/odom", True)
            assert any(stage.text.endswith("as /robot1/odom (its /odom)") for stage in found.stages)
        command = await pilot.advertise("/robot1/cmd_vel", "std_msgs/String")
        obeyed = await driver.subscribe("/cmd_vel", "std_msgs/String", lambda _: None)
        await until(lambda: command.subscribers and obeyed.publishers)
        command.publish(command.make({"data": "go"}))
        there = await flowing(base, "/robot1/cmd_vel")
        assert (there.name, there.peer, there.to, there.flows) == ("/cmd_vel", "pc", "robot", True)
        assert there.stages[2].text == "/pilot on pc publishes /cmd_vel (/robot1/cmd_vel there)"
