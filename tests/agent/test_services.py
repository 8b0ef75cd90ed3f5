"""Services between whole agents in one process: registrations and calls when graphs and links change."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge.messages import ServiceOffer
from rmpa.core.errors import PeerRefused
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.tcpros import ServiceDescription
from tests.agent.test_agent import running, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable

    from rmpa.agent.agent import Agent
    from rmpa.bridge.sessions import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.mesh.io.link import PeerLink

MD5 = "6a2e34150c00229791cc89ff309fff21"


class Server:
    """A node with one service, which answers with what it was asked, or keeps the calls."""

    def __init__(self, agent: Agent, node: SlaveNode, service: str) -> None:
        self.agent = agent
        self.node = node
        self.service = service
        self.keeps = False
        self.calls: list[ServiceCall] = []
        endpoint = ServiceEndpoint(service, node.name, self._serve, description=ServiceDescription("a/Add", MD5))
        node.add_service(endpoint)
        self.agent.core.call("registerService", node.name, service, node.service_uri, node.uri)

    def _serve(self, call: ServiceCall) -> None:
        self.calls.append(call)
        if not self.keeps:
            call.reply(True, call.request)

    def unregister(self) -> None:
        self.agent.core.call("unregisterService", self.node.name, self.service, self.node.service_uri)


@asynccontextmanager
async def serving(agent: Agent, service: str = "/add", name: str = "/adder") -> AsyncIterator[Server]:
    node = SlaveNode(name, "127.0.0.1", agent.core.uri)
    await node.start()
    server = Server(agent, node, service)
    try:
        yield server
    finally:
        server.unregister()
        await node.close()


def provider(agent: Agent, service: str = "/add") -> str:
    """The node that provides a service in a module's graph; empty if there is none."""
    return next(iter(agent.core.state().services.get(service, {})), "")


async def connect(agent: Agent, service: str = "/add", md5sum: str = "*") -> ServiceConnection:
    (uri,) = agent.core.state().services[service].values()
    return await ServiceConnection.open(uri, service, "/client", md5sum=md5sum)


def fall_silent(*agents: Agent) -> list[tuple[Agent, PeerLink]]:
    """The link between two agents falls silent, as far as their bridges are told."""
    links = [(agent, session.link) for agent in agents for session in agent.bridge.sessions.linked()]
    for agent, link in links:
        link.connection.silent = True
        agent.bridge.sessions.link_down(link)
    return links


def come_back(links: Iterable[tuple[Agent, PeerLink]]) -> None:
    """They have a link again; what the first one sends may come before the second one knows of it: it is dropped."""
    for agent, link in links:
        link.connection.silent = False
        agent.bridge.sessions.link_up(link)


Served = tuple["Agent", "Agent", Server]


@pytest.fixture
async def served(settings: Callable[..., Settings]) -> AsyncIterator[Served]:
    """The agents of two modules, and a server in the first one that the second one has."""
    async with running(settings("a"), settings("b")) as (a, b), serving(a) as server:
        await until(lambda: provider(b) == "/rmpa/a/adder")
        yield a, b, server


async def test_a_call_is_counted_on_both_sides(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b), serving(a) as server:
        await until(lambda: provider(b) == "/rmpa/a/adder")
        connection = await connect(b, md5sum=MD5)
        assert connection.description.type == "a/Add"
        for body in (b"", b"1", b"x" * 10_000, b"y" * 3_000_000):
            assert await connection.call(body, 20.0) == (True, body)
        connection.close()
        assert len(server.calls) == 4
        (there,) = [i for i in a.operations.snapshot({}).services if i.name == "/add"]
        (here,) = [i for i in b.operations.snapshot({}).services if i.name == "/add"]
        assert (there.direction, there.state, there.callers, there.calls, there.failed) == (
            "out",
            "open",
            ("b",),
            4,
            0,
        )
        assert (here.direction, here.peer, here.state, here.type, here.md5) == ("in", "a", "open", "a/Add", MD5)
        assert (here.calls, here.failed, here.active) == (4, 0, 0)
        assert here.latency is not None
        assert there.latency is not None
        assert here.latency.max >= there.latency.min > 0
    assert provider(b) == ""


def offered(agent: Agent, session: PeerSession) -> None:
    """The peer offers the service again."""
    agent.services.imports.take_in(session.peer, "/add", ServiceOffer("/add", "/adder"), 0.0)


async def test_types_are_told_although_the_offer_came_again_since_the_service_was_opened(served: Served) -> None:
    """The catalogue of a new link comes at the same time as the first call opens a service."""
    _a, b, server = served
    (session,) = b.bridge.sessions
    for _ in range(2):
        connection = await connect(b)
        offered(b, session)
        other = await asyncio.wait_for(connect(b), 20.0)
        assert other.description.type == "a/Add"
        assert await other.call(b"1", 20.0) == (True, b"1")
        other.close()
        connection.close()
    connection = await connect(b)
    server.keeps = True
    asked = asyncio.create_task(connection.call(b"2", 20.0))
    await until(lambda: len(server.calls) == 3)
    offered(b, session)
    other = await asyncio.wait_for(connect(b), 20.0)
    assert other.description.type == "a/Add"
    server.calls[-1].reply(True, b"kept")
    assert await asked == (True, b"kept"), "a call under way is not disturbed"
    other.close()
    connection.close()


async def test_a_short_outage_keeps_services_and_answers_calls(served: Served) -> None:
    a, b, server = served
    connection = await connect(b)
    server.keeps = True
    asked = asyncio.create_task(connection.call(b"1", 20.0))
    await until(lambda: server.calls)
    changes = b.core.state().services
    links = fall_silent(a, b)
    ok, text = await asked
    assert not ok
    assert b"the link to a was lost" in text
    server.keeps = False
    waiting = asyncio.create_task(connection.call(b"2", 20.0))
    await asyncio.sleep(0.1)
    assert b.core.state().services == changes, "nobody was told of it"
    come_back(links)
    assert await waiting == (True, b"2")
    connection.close()


async def test_a_removed_proxy_comes_back(served: Served) -> None:
    _a, b, _server = served
    (uri,) = b.core.state().services["/add"].values()
    b.core.call("unregisterService", "/rmpa/a/adder", "/add", uri)
    assert provider(b) == ""
    b.services.reconcile()
    assert provider(b) == "/rmpa/a/adder"


async def test_a_service_without_a_server_is_refused_with_the_reason(
    settings: Callable[..., Settings],
) -> None:
    async with running(settings("a"), settings("b")) as (a, b), serving(a) as server:
        a.core.call("registerService", "/ghost", "/boo", "rosrpc://127.0.0.1:1", server.node.uri)
        await until(lambda: provider(b, "/boo"))
        with pytest.raises(PeerRefused, match=r"rosrpc://127\.0\.0\.1:1"):
            await connect(b, "/boo")
        a.core.call("unregisterService", "/ghost", "/boo", "rosrpc://127.0.0.1:1")
        await until(lambda: not provider(b, "/boo"))
