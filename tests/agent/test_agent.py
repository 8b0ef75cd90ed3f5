"""Whole agents in one process, on loopback, with our own nodes on either side."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

from rmpa.agent.agent import Agent
from rmpa.core.errors import StartError
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.node import Node
from rmpa.ros.node.service_client import ServiceConnection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.config.settings import Settings
    from rmpa.ros.node.endpoints import Received, Subscriber

DEADLINE = 20.0


async def until(condition: Callable[[], object]) -> None:
    """Wait for a condition that the loop's other work makes true."""
    async with asyncio.timeout(DEADLINE):
        while not condition():
            await asyncio.sleep(0.005)


class Sink:
    """A callback that keeps the text of std_msgs/String messages."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    def __call__(self, received: Received) -> None:
        self.heard.append(received.message.data)

    def count(self, number: int) -> bool:
        return len(self.heard) >= number


def hears(subscriber: Subscriber, publishers: int) -> bool:
    return subscriber.publishers == publishers


@asynccontextmanager
async def running(*all_settings: Settings) -> AsyncIterator[list[Agent]]:
    agents = [Agent(settings) for settings in all_settings]
    started = []
    try:
        for agent in agents:
            await agent.start()
            started.append(agent)
        wanted = len(agents) - 1
        await until(lambda: all(len(list(agent.bridge.sessions.linked())) == wanted for agent in agents))
        yield agents
    finally:
        for agent in reversed(started):
            await agent.close()


def node(name: str, agent: Agent) -> Node:
    return Node(name, master_uri=agent.core.uri)


async def test_a_topic_of_one_module_is_heard_in_another(settings: Callable[..., Settings]) -> None:
    async with (
        running(settings("a"), settings("b")) as (a, b),
        node("talker", a) as talker,
        node("hearer", b) as hearer,
    ):
        publisher = await talker.advertise("/chatter", "std_msgs/String")
        subscriber = await hearer.subscribe("/chatter")
        await until(lambda: publisher.subscribers and subscriber.publishers)
        for i in range(100):
            publisher.publish(publisher.make({"data": f"number {i}"}))
        got = []
        async with asyncio.timeout(DEADLINE):
            async for received in subscriber:
                got.append(received)
                if len(got) == 100:
                    break
        assert [received.message.data for received in got] == [f"number {i}" for i in range(100)]
        assert got[0].header["type"] == "std_msgs/String"
        assert got[0].header["md5sum"] == "992ce8a1687cec8c8bd883ec73ca41d1"
        assert "string data" in got[0].header["message_definition"]
        assert got[0].caller_id == "/rmpa/a/talker"
        nodes = b.core.state().nodes
        assert {"/rmpa", "/rosout", "/rmpa/a/talker", "/hearer"} <= nodes.keys()
        for api in nodes.values():
            assert (await call_api(api, "getMasterUri", "/rosnode")).value == b.core.uri


@asynccontextmanager
async def running_more(other: Agent, more: Settings) -> AsyncIterator[Agent]:
    agent = Agent(more)
    await agent.start()
    try:
        await until(lambda: list(agent.bridge.sessions.linked()) and list(other.bridge.sessions.linked()))
        yield agent
    finally:
        await agent.close()


async def test_data_crosses_only_with_a_subscriber_and_once_for_many(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b), node("talker", a) as talker:
        publisher = await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: "/chatter" in b.core.state().publishers)
        assert publisher.subscribers == 0
        async with node("one", b) as one, node("two", b) as two:
            subscribers = [await n.subscribe("/chatter") for n in (one, two)]
            await until(lambda: all(s.publishers for s in subscribers))
            assert publisher.subscribers == 1
            publisher.publish(publisher.make({"data": "x"}))
            for subscriber in subscribers:
                async with asyncio.timeout(DEADLINE):
                    async for received in subscriber:
                        assert received.message.data == "x"
                        break
            [flow] = a.bridge.topics.exports.flows.values()
            assert flow.messages == 1
        await until(lambda: publisher.subscribers == 0)


def core_port(agent: Agent) -> int:
    """The port of an agent's core."""
    return urlsplit(agent.core.uri).port or 0


async def test_a_second_agent_of_one_name_or_port_is_refused_and_leaves_nothing_open(
    settings: Callable[..., Settings],
) -> None:
    async with running(settings("a")) as (a,):
        with pytest.raises(StartError, match="a"):
            await Agent(settings("a")).start()
        said = (
            rf"rmpa up: a runs already \(pid {os.getpid()}\); .*ROS_MASTER_URI=http://localhost:{core_port(a)}; a sec"
        )
        for _ in range(3):
            with pytest.raises(StartError, match=said):
                await Agent(settings("b", core_port=core_port(a))).start()
        async with running_more(a, settings("b")):
            pass


async def test_another_program_that_has_the_cores_port_is_named(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmpa.agent.agent._ASKED", 0.2)
    core = RosCore(port=0)
    await core.start()
    said = rf"is already in use by .+ \(pid {os.getpid()}\); join its graph with `rmpa up --core external`"
    with pytest.raises(StartError, match=said):
        await Agent(settings("b", core_port=core.port)).start()
    await core.close()
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(
            StartError, match=rf"{port} is already in use by .+ \(pid {os.getpid()}\); end that program"
        ):
            await Agent(settings("b", core_port=port)).start()


async def test_bus_info_of_the_agents_own_node(settings: Callable[..., Settings]) -> None:
    """``rosnode info /rmpa`` and rqt_graph ask it for that."""
    async with (
        running(settings("a"), settings("b")) as (a, b),
        node("talker", a) as talker,
        node("hearer", b) as hearer,
    ):
        publisher = await talker.advertise("/chatter", "std_msgs/String")
        subscriber = await hearer.subscribe("/chatter")
        await until(lambda: publisher.subscribers and subscriber.publishers)
        uri = str(a.core.call("lookupNode", "/test", "/rmpa")[2])
        assert (await call_api(uri, "getSubscriptions", "/test")).value == [["/chatter", "std_msgs/String"]]
        match (await call_api(uri, "getBusInfo", "/test")).value:
            case [[_, *bus, str(_)]]:
                assert bus == [talker.uri, "i", "TCPROS", "/chatter", True]
            case other:
                pytest.fail(f"getBusInfo answers {other}")


async def test_the_uptime_does_not_follow_a_clock_that_is_set(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot without a battery for its clock starts in 1970, and gets the time from the network."""
    async with running(settings("a")) as (agent,):
        real = time.time
        monkeypatch.setattr(time, "time", lambda: real() + 1e9)
        assert 0 <= agent.operations.snapshot({}).agent.uptime < 3600


def strings(*texts: str) -> bytes:
    return b"".join(len(text).to_bytes(4, "little") + text.encode() for text in texts)


async def test_the_agents_log_is_turned_up_while_it_runs(
    settings: Callable[..., Settings],
    caplog: pytest.LogCaptureFixture,
) -> None:
    mesh, bridge = logging.getLogger("rmpa.mesh"), logging.getLogger("rmpa.bridge")
    caplog.set_level(logging.WARNING)
    async with running(settings("a")) as (agent,):
        uri = str(agent.core.call("lookupService", "/x", "/rmpa/set_logger_level").value)
        assert uri == agent.core.call("lookupService", "/x", "/rmpa/get_loggers").value
        turn = await ServiceConnection.open(uri, "/rmpa/set_logger_level", "/rqt")
        look = await ServiceConnection.open(uri, "/rmpa/get_loggers", "/rqt")
        try:
            assert await turn.call(strings("rmpa.mesh", "debug")) == (True, b"")
            assert (mesh.isEnabledFor(logging.DEBUG), bridge.isEnabledFor(logging.DEBUG)) == (True, False)
            ok, answer = await look.call(b"")
            assert ok
            assert strings("rmpa.mesh", "debug") in answer
            assert strings("rmpa.bridge", "warn") in answer
        finally:
            mesh.setLevel(logging.NOTSET)
        turn.close()
        look.close()
    assert "/rmpa/get_loggers" not in agent.core.state().services
