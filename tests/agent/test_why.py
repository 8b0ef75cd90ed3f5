"""``why`` between whole agents: each side tells what only it knows."""

from __future__ import annotations

import asyncio
import socket
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge.peer_offers import CONFLICT
from rmpa.config.peer_rules import PeerRule, PolicySettings
from rmpa.config.settings import ServiceSettings, Settings
from rmpa.core.errors import ConfigError
from rmpa.observe import limits as observe_limits
from rmpa.observe.peer_info import CheckLevel
from tests.agent.test_agent import DEADLINE, node, running, settings, until  # noqa: F401 - a fixture among them

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.agent.agent import Agent
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


async def test_each_stage_until_a_topic_flows(settings: Callable[..., Settings]) -> None:  # noqa: F811
    async with (
        running(settings("a"), settings("b")) as (a, b),
        node("talker", a) as talker,
        node("hearer", b) as hearer,
    ):
        assert stopped_at(await ask(b, "/chatter", "a")) == ("publisher", "no node of a publishes /chatter")
        assert stopped_at(await ask(b, "/chatter"))[0] == "publisher"
        publisher = await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: b.bridge.topics.imports.offered_by(next(iter(b.bridge.sessions.linked())).peer))
        (idle,) = await ask(b, "/chatter", "a")
        assert (idle.unasked, idle.failed) == (True, None)
        assert idle.stages[-1].text == "no node here subscribes to /chatter, so nothing is sent"
        (near,) = await ask(b, "/chater", "a")
        assert near.failed is not None
        assert near.failed.remedy == "did you mean /chatter?"
        subscriber = await hearer.subscribe("/chatter", "std_msgs/String", lambda _: None)
        await until(lambda: publisher.subscribers and subscriber.publishers)
        stage, text = stopped_at(await ask(b, "/chatter", "a"))
        assert (stage, text) == ("sent", "its publisher /talker is connected, and has published nothing since")
        publisher.publish(publisher.make({"data": "one"}))
        found = await flowing(b, "/chatter", "a")
        assert (found.peer, found.to, found.node) == ("a", "b", "/talker")
        assert [stage.level for stage in found.stages] == [CheckLevel.OK] * len(found.stages)
        assert found.stages[-1].text == "/hearer takes them"
        # Asked on the publisher's side, the subscriber's agent says the same.
        there = await flowing(a, "/chatter")
        assert (there.peer, there.to, there.flows) == ("a", "b", True)
        assert there.stages[-1].text == "/hearer takes them"
        there = await flowing(a, "/chatter", "b")
        assert (there.peer, there.to, there.flows) == ("a", "b", True)


@pytest.mark.parametrize("where", ["there", "here"])
async def test_policy_of_either_side(settings: Callable[..., Settings], where: str) -> None:  # noqa: F811
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


async def test_built_in_rules_and_other_types(settings: Callable[..., Settings]) -> None:  # noqa: F811
    async with running(settings("a"), settings("b")) as (a, b), node("one", a) as one, node("two", b) as two:
        await one.advertise("/clock", "rosgraph_msgs/Clock")
        stage, text = stopped_at(await ask(b, "/clock", "a"))
        assert stage == "policy there"
        assert "time stays home" in text
        await one.advertise("/x", "std_msgs/String")
        await two.advertise("/x", "std_msgs/Bool")
        await until(lambda: any(entry.cause == CONFLICT for _, _, entry in b.bridge.topics.imports))
        stage, text = stopped_at(await ask(b, "/x", "a"))
        assert stage == "type"
        assert "std_msgs/String" in text
        assert "std_msgs/Bool" in text


async def test_unknown_peers_and_names(settings: Callable[..., Settings]) -> None:  # noqa: F811
    async with running(settings("a"), settings("b")) as (_, b):
        (found,) = await ask(b, "/x", "aa")
        assert found.failed is not None
        assert found.failed.name == "peer"
        assert found.failed.remedy.startswith("did you mean a?")
        with pytest.raises(ConfigError, match="not a topic"):
            await ask(b, "x y")
    async with running(settings("lonely")) as (lonely,):
        assert stopped_at(await ask(lonely, "/x"))[0] == "publisher"


async def test_names_of_a_peer_with_a_prefix(settings: Callable[..., Settings]) -> None:  # noqa: F811
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
        assert there.stages[2].text == "/pilot on pc publishes /cmd_vel (/robot1/cmd_vel over there)"


async def test_policy_for_single_peers(settings: Callable[..., Settings]) -> None:  # noqa: F811
    rule = PeerRule("b", policy=PolicySettings(deny=("/secret",)))
    async with running(replace(settings("a"), peers=(rule,)), settings("b")) as (a, b), node("talker", a) as talker:
        await talker.advertise("/secret", "std_msgs/String")
        stage, text = stopped_at(await ask(b, "/secret", "a"))
        assert stage == "policy there"
        assert "peer \"b\".deny has '/secret'" in text


async def test_services(settings: Callable[..., Settings]) -> None:  # noqa: F811
    deny = ServiceSettings(deny=("/kept",))
    async with running(replace(settings("a"), services=deny), settings("b")) as (a, b), node("server", a) as server:
        stage, text = stopped_at(await b.why.answer({"name": "/ask", "peer": "a", "service": True}))
        assert (stage, text) == ("server", "no node of a provides /ask")

        def answer(_: object) -> dict[str, object]:
            return {"success": True, "message": "yes"}

        for name in ("/ask", "/kept"):
            await server.advertise_service(name, "std_srvs/Trigger", answer)
        await until(lambda: b.core.state().services.get("/ask"))
        for peer in ("a", None):
            found = await flowing(b, "/ask", peer)
            assert (found.kind, found.node, found.flows) == ("service", "/server", True), found
            texts = {stage.name: stage.text for stage in found.stages}
            assert texts["answer"].startswith("its server answers: std_srvs/Trigger, md5 ")
        stage, text = stopped_at(await ask(b, "/kept", "a"))
        assert stage == "policy there"
        assert "services.deny has '/kept'" in text
        (own,) = await ask(a, "/ask")
        assert own.flows  # that no peer is needed for it is no failure
        assert "of this module provides /ask" in own.stages[-1].text


async def test_a_server_that_is_stuck(settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    monkeypatch.setattr(observe_limits, "WHY_PROBE", 0.3)
    async with running(settings("a"), settings("b")) as (a, b):
        with socket.create_server(("127.0.0.1", 0)) as stuck:  # takes connections, and says nothing
            uri = f"rosrpc://127.0.0.1:{stuck.getsockname()[1]}"
            a.core.call("registerService", "/stuck", "/ask", uri, "http://127.0.0.1:1/")
            await until(lambda: b.core.state().services.get("/ask"))
            stage, text = stopped_at(await ask(b, "/ask", "a"))
        assert stage == "server"
        assert text.startswith("/stuck on a is registered for it, and does not answer: ")
