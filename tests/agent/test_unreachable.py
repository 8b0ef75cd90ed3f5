"""A node whose address nothing can connect to, and two whole agents."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge import limits as bridge_limits
from rmpa.core.errors import UnreachableError
from rmpa.ros import limits as ros_limits
from rmpa.ros.http import rpc as client
from rmpa.ros.node.publication import Publication
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.tcpros import TopicDescription
from tests.agent.test_agent import node, running, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings
    from rmpa.observe.why.diagnosis import Diagnosis

NAME = "nosuchhost.invalid"
MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"


class Resolver:
    """A name server that does not know the node's machine, until it does."""

    def __init__(self) -> None:
        self.knows = False
        self.asked = 0

    async def __call__(self, host: str, port: int) -> list[tuple[str, int]]:
        if host != NAME:
            return [(host, port)]
        self.asked += 1
        if not self.knows:
            raise UnreachableError("machine", host, "the name does not resolve here (as asked)")
        return [("127.0.0.1", port)]


@pytest.fixture
def resolver(monkeypatch: pytest.MonkeyPatch) -> Resolver:
    made = Resolver()
    monkeypatch.setattr(client, "_resolve", made)
    monkeypatch.setattr(ros_limits, "NODE_CHECK_INTERVAL", 0.05)
    monkeypatch.setattr(ros_limits, "NODE_UNREACHABLE_AFTER", 0.3)
    monkeypatch.setattr(bridge_limits, "RECONCILE_INTERVAL", 0.1)
    return made


@asynccontextmanager
async def registered_by_name(agent: Agent) -> AsyncIterator[None]:
    """A node that publishes and serves, and tells the core a host name that nobody knows."""
    cam = SlaveNode("/cam", "127.0.0.1", agent.core.uri, advertised_host=NAME)
    await cam.start()
    cam.add_publication(Publication("/image", "/cam", TopicDescription("std_msgs/String", MD5, "string data\n")))
    call, shoot = agent.core.call, cam.service_uri
    call("registerPublisher", "/cam", "/image", "std_msgs/String", cam.uri)
    call("registerService", "/cam", "/shoot", shoot, cam.uri)
    try:
        yield
    finally:
        call("unregisterPublisher", "/cam", "/image", cam.uri)
        call("unregisterService", "/cam", "/shoot", shoot)
        await cam.close()


async def why(agent: Agent, peer: str, name: str) -> Diagnosis:
    (found,) = await agent.why.answer({"name": name, "peer": peer})
    return found


async def test_it_is_told_withdrawn_and_back_when_it_can_be_reached(
    settings: Callable[..., Settings], resolver: Resolver
) -> None:
    async with running(settings("a"), settings("b")) as (a, b), registered_by_name(a):
        await until(lambda: "/cam" in a.core.unreachable())
        (info,) = a.snapshots.build().unreachable
        assert str(info).startswith(f"/cam cannot be reached at http://{NAME}:")
        await until(lambda: a.core.unreachable()["/cam"].withdrawn)
        await until(lambda: "/image" not in b.core.state().publishers and "/shoot" not in b.core.state().services)
        assert "/image" in a.core.state().publishers, "the registration stays, as at roscore"

        at = a.core.unreachable()["/cam"].api
        text = (
            f"/cam cannot be reached at {at} (the name does not resolve here (as asked)), so peers are not offered it"
        )
        (topic,) = [topic for topic in a.snapshots.build().topics if topic.name == "/image"]
        assert topic.unreachable == (text,)
        failed = (await why(b, "a", "/image")).failed
        assert failed is not None
        assert failed.name == "reachable"
        assert "/cam is registered on a, but cannot be reached at http://nosuchhost.invalid:" in failed.text
        assert "ROS_IP=127.0.0.1" in failed.remedy
        failed = (await why(b, "a", "/shoot")).failed
        assert failed is not None
        assert failed.name == "server"
        assert "cannot be reached at http://nosuchhost.invalid:" in failed.text

        resolver.knows = True
        await until(lambda: "/image" in b.core.state().publishers and "/shoot" in b.core.state().services)
        assert not a.core.unreachable()
        assert (await why(b, "a", "/image")).unasked, "all is well but for a reader"


async def test_what_flows_is_not_withdrawn(settings: Callable[..., Settings], resolver: Resolver) -> None:
    """Its network may be gone for new connections, and still carry those that stand."""
    resolver.knows = True
    async with running(settings("a"), settings("b")) as (a, b), registered_by_name(a), node("hearer", b) as hearer:
        subscriber = await hearer.subscribe("/image", "std_msgs/String")
        await until(lambda: subscriber.publishers)
        await until(lambda: any(flow.flowing for flow in a.bridge.topics.exports.flows.values()))
        resolver.knows = False
        await until(lambda: a.core.unreachable() and a.core.unreachable()["/cam"].withdrawn)
        before = resolver.asked
        await until(lambda: resolver.asked > before + 5)
        assert "/image" in b.core.state().publishers
        assert subscriber.publishers == 1
        await subscriber.close()
        await until(lambda: "/image" not in b.core.state().publishers)
