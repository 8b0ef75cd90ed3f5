"""Whole agents in one process, on loopback, with our own nodes on either side."""

from __future__ import annotations

import asyncio
import os
import socket
import time
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

from rmpa.agent.agent import Agent
from rmpa.bridge import limits
from rmpa.config.peer_rules import PolicySettings
from rmpa.core.errors import StartError, UnreachableError
from rmpa.core.identity import proxied_node
from rmpa.observe.control_client import ControlClient
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.node import Node
from rmpa.ros.node.slave_node import SlaveNode

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from rmpa.config.settings import Settings
    from rmpa.observe.snapshot import Snapshot
    from rmpa.ros.node.endpoints import Publisher, Received, Subscriber

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


def flows_to(agent: Agent, peers: int) -> bool:
    """Whether what the agent's module publishes goes to that many peers."""
    flows = agent.bridge.topics.outbound.flows
    return bool(flows) and all(len(agent.bridge.topics.exports.flowing(source)) == peers for source in flows)


def has_subscribers(publisher: Publisher) -> bool:
    return publisher.subscribers > 0


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


async def test_three_modules_hear_each_other_and_nothing_loops(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b"), settings("c")) as agents, AsyncExitStack() as stack:
        talkers = [await stack.enter_async_context(node(f"n{i}", agent)) for i, agent in enumerate(agents)]
        publishers = [await talker.advertise("/shared", "std_msgs/String") for talker in talkers]
        sinks = []
        for agent in agents:
            hearer = await stack.enter_async_context(node("hearer", agent))
            sinks.append(Sink())
            subscriber = await hearer.subscribe("/shared", "std_msgs/String", sinks[-1])
            await until(partial(hears, subscriber, 3))
        for i, (agent, publisher) in enumerate(zip(agents, publishers, strict=True)):
            await until(partial(flows_to, agent, 2))
            assert publisher.subscribers == 2  # the local hearer, and our agent for both others
            publisher.publish(publisher.make({"data": f"from {i}"}))
        await until(lambda: all(len(sink.heard) == 3 for sink in sinks))
        assert [sorted(sink.heard) for sink in sinks] == [["from 0", "from 1", "from 2"]] * 3


async def test_data_flows_only_with_a_subscriber(settings: Callable[..., Settings]) -> None:
    async with (
        running(settings("a"), settings("b")) as (a, b),
        node("talker", a) as talker,
        node("hearer", b) as hearer,
    ):
        publisher = await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: "/chatter" in b.core.state().publishers)
        assert publisher.subscribers == 0
        subscriber = await hearer.subscribe("/chatter")
        await until(lambda: publisher.subscribers == 1)
        await subscriber.close()
        await until(lambda: publisher.subscribers == 0)


async def test_one_copy_crosses_for_many_subscribers(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b), node("talker", a) as talker:
        publisher = await talker.advertise("/chatter", "std_msgs/String")
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
            [flow] = a.bridge.topics.outbound.flows.values()
            assert flow.messages == 1


async def test_a_latched_message_reaches_each_late_subscriber_once(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b), node("mapper", a) as mapper:
        publisher = await mapper.advertise("/map", "std_msgs/String", latch=True)
        publisher.publish(publisher.make({"data": "map"}))
        for name in ("one", "two"):
            async with node(name, b) as early, node(f"{name}_late", b) as late:
                first, second = Sink(), Sink()
                await early.subscribe("/map", "std_msgs/String", first)
                await until(partial(len, first.heard))
                await late.subscribe("/map", "std_msgs/String", second)
                await until(partial(len, second.heard))
                assert first.heard == second.heard == ["map"]


async def test_a_peer_that_is_gone_leaves_nothing_in_the_graph(settings: Callable[..., Settings]) -> None:
    async with running(settings("b")) as (b,):
        async with running_more(b, settings("a")) as a, node("talker", a) as talker:
            await talker.advertise("/chatter", "std_msgs/String")
            await until(lambda: "/chatter" in b.core.state().publishers)
            assert [proxied_node(n) for n in b.core.state().publishers["/chatter"]] == [("a", "/talker")]
        await until(lambda: "/chatter" not in b.core.state().publishers)
        assert not list(b.bridge.sessions.linked())


@asynccontextmanager
async def running_more(other: Agent, more: Settings) -> AsyncIterator[Agent]:
    agent = Agent(more)
    await agent.start()
    try:
        await until(lambda: list(agent.bridge.sessions.linked()) and list(other.bridge.sessions.linked()))
        yield agent
    finally:
        await agent.close()


async def test_policy_keeps_topics_home_on_either_side(settings: Callable[..., Settings]) -> None:
    strict = PolicySettings(deny=("/secret",))
    for first, second in ((strict, None), (None, strict)):
        async with running(settings("a", first), settings("b", second)) as (a, b), node("talker", a) as talker:
            await talker.advertise("/secret", "std_msgs/String")
            await talker.advertise("/open", "std_msgs/String")
            await until(lambda: "/open" in b.core.state().publishers)
            assert "/secret" not in b.core.state().publishers
            assert not any(n.startswith("/rmpa/a") for n in b.core.state().publishers.get("/rosout", {}))


async def test_another_md5_sum_is_refused_on_both_sides(settings: Callable[..., Settings]) -> None:
    async with (
        running(settings("a"), settings("b")) as (a, b),
        node("talker", a) as talker,
        node("hearer", b) as hearer,
    ):
        publisher = await talker.advertise("/chatter", "std_msgs/String")
        subscriber = await hearer.subscribe("/chatter", "std_msgs/Int32")
        await until(lambda: subscriber.refusals)
        assert "md5" in next(iter(subscriber.refusals.values()))
        await until(lambda: a.bridge.counters["mismatch.remote"])
        assert b.bridge.counters["mismatch.md5"] == 1
        for agent in (a, b):
            [topic] = [t for t in agent.snapshots.build().topics if t.name == "/chatter"]
            assert len(topic.mismatches) == 1
        await until(lambda: publisher.subscribers == 0)


async def test_a_local_topic_of_another_type_hides_the_remote_one(settings: Callable[..., Settings]) -> None:
    async with (
        running(settings("a"), settings("b")) as (a, b),
        node("talker", a) as talker,
        node("local", b) as local,
    ):
        mine = await local.advertise("/chatter", "std_msgs/Int32")
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: b.bridge.counters["mismatch.type"] and a.bridge.counters["mismatch.remote"])
        assert list(b.core.state().publishers["/chatter"]) == ["/local"]
        assert b.core.state().types["/chatter"] == "std_msgs/Int32"
        await mine.close()
        await until(lambda: list(b.core.state().publishers.get("/chatter", {})) == ["/rmpa/a/talker"])


async def test_a_publisher_that_restarts_is_found_again(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b), node("hearer", b) as hearer:
        sink = Sink()
        await hearer.subscribe("/chatter", "std_msgs/String", sink)
        for count, word in enumerate(("one", "two"), start=1):
            async with node("talker", a) as talker:
                publisher = await talker.advertise("/chatter", "std_msgs/String")
                await until(partial(has_subscribers, publisher))
                publisher.publish(publisher.make({"data": word}))
                await until(partial(sink.count, count))
            await until(lambda: "/chatter" not in b.core.state().publishers)
        assert sink.heard == ["one", "two"]


def core_port(agent: Agent) -> int:
    """The port of an agent's core."""
    return urlsplit(agent.core.uri).port or 0


async def test_a_second_agent_of_one_name_or_port_is_refused(settings: Callable[..., Settings]) -> None:
    async with running(settings("a")) as (a,):
        with pytest.raises(StartError, match="a"):
            await Agent(settings("a")).start()
        said = (
            rf"rmpa up: a runs already \(pid {os.getpid()}\); .*ROS_MASTER_URI=http://localhost:{core_port(a)}; a sec"
        )
        with pytest.raises(StartError, match=said):
            await Agent(settings("b", core_port=core_port(a))).start()


async def test_another_program_that_has_the_cores_port_is_named(settings: Callable[..., Settings]) -> None:
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


async def test_a_start_that_fails_leaves_nothing_open(settings: Callable[..., Settings]) -> None:
    async with running(settings("a")) as (a,):
        for _ in range(3):
            with pytest.raises(StartError):
                await Agent(settings("b", core_port=core_port(a))).start()
        async with running_more(a, settings("b")):
            pass


async def test_the_control_socket_answers(settings: Callable[..., Settings], tmp_path: Path) -> None:
    async with running(settings("a"), settings("b")) as (a, b), node("talker", a) as talker:
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: "/chatter" in b.core.state().publishers)

        def ask() -> Snapshot:
            with ControlClient(tmp_path / "b.sock") as client:
                return client.snapshot()

        snapshot = await asyncio.to_thread(ask)
        [peer] = snapshot.peers
        assert (peer.name, peer.state, peer.topics_in) == ("a", "linked", 1)
        assert peer.link is not None
        [topic] = [t for t in snapshot.topics if t.name == "/chatter"]
        assert (topic.type, topic.publishers, topic.peers) == ("std_msgs/String", (), ("a",))
        assert snapshot.agent.core_uri == b.core.uri
        answer = await b.operations.ping({"peer": "a", "count": 2})
        assert len(answer.times) == 2
        assert all(time is not None and 0 <= time < DEADLINE for time in answer.times)
        with pytest.raises(UnreachableError, match="did you mean a"):
            await b.operations.ping({"peer": "aa"})


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


async def test_a_proxy_that_could_not_be_made_is_made_later(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "RECONCILE_INTERVAL", 0.1)
    async with running(settings("a"), settings("b")) as (a, b), node("talker", a) as talker:
        start = SlaveNode.start
        refusals: list[str] = []

        async def refuse(proxy: SlaveNode) -> None:
            if proxy.name == "/rmpa/a/talker" and len(refusals) < 2:
                refusals.append(proxy.name)
                raise StartError("a socket", "there are too many open files")
            await start(proxy)

        monkeypatch.setattr(SlaveNode, "start", refuse)
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: "/chatter" in b.core.state().publishers)
        assert len(refusals) == 2


async def test_the_uptime_does_not_follow_a_clock_that_is_set(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot without a battery for its clock starts in 1970, and gets the time from the network."""
    async with running(settings("a")) as (agent,):
        real = time.time
        monkeypatch.setattr(time, "time", lambda: real() + 1e9)
        assert 0 <= agent.operations.snapshot({}).agent.uptime < 3600
