"""Whole agents in one process whose links stand on demand: what is used of a parked peer works as from any other."""

from __future__ import annotations

import asyncio
import random
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.session.peer_session import PeerState
from rmpa.core.errors import UnreachableError
from rmpa.core.links import Links
from rmpa.discovery.io.packet_filter import PacketFilter
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.connection import ConnectionProtocol
from tests.agent.test_agent import Sink, node, running, running_more, settings, until
from tests.agent.test_services import connect, provider, serving

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Sequence

    from rmpa.agent import Agent
    from rmpa.config.settings import Settings
    from rmpa.discovery.io.discovery import Discovery
    from rmpa.mesh.peering_events import SocketAddress

__all__ = ["settings"]


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Links rest and park within a moment."""
    monkeypatch.setattr(mesh_limits, "REST_AFTER", 0.2)
    monkeypatch.setattr(mesh_limits, "PARK_AFTER", 0.2)
    monkeypatch.setattr(mesh_limits, "IDLE_KEEPALIVE_INTERVAL", 0.1)
    monkeypatch.setattr(bridge_limits, "RECONCILE_INTERVAL", 0.1)
    monkeypatch.setattr(bridge_limits, "SERVICE_IDLE", 0.3)


@pytest.fixture
def on_demand(settings: Callable[..., Settings]) -> Callable[[str], Settings]:
    return lambda name: replace(settings(name), links=Links.DEMAND)


def states(*agents: Agent) -> set[PeerState]:
    return {session.state for agent in agents for session in agent.bridge.sessions}


async def call(agent: Agent, service: str, body: bytes) -> bytes:
    """Look a service up and call it, as a client without a persistent connection does; return the answer."""
    connection = await connect(agent, service)
    try:
        ok, answer = await connection.call(body, 20.0)
    finally:
        connection.close()
    assert ok, answer
    return bytes(answer)


async def speed(agent: Agent, peer: str) -> str:
    """The parameter of a peer."""
    return str(await agent.operations.param({"peer": peer, "what": "param.get", "args": {"key": "/speed"}}))


def slow_down(agent: Agent, rng: random.Random) -> None:
    """Let each connection of an agent that dials come up by chance some milliseconds later."""
    assert agent.network.endpoint is not None
    dialler = agent.network.endpoint.mesh.dialler
    dial = dialler.dial

    async def slow(endpoints: Sequence[SocketAddress]) -> tuple[socket.socket, SocketAddress]:
        opened = await dial(endpoints)
        await asyncio.sleep(rng.choice((0, 0.001, 0.002, 0.003)))
        return opened

    dialler.dial = slow  # type: ignore[method-assign]


def passing_all_but(discovery: Discovery, parse: Callable[..., object]) -> Callable[..., object]:
    """A parser of packets for all agents of this process, of which one hears nothing."""

    def pass_on(self: PacketFilter, *args: object, **more: object) -> object:
        return None if self is discovery._filter else parse(self, *args, **more)

    return pass_on


async def parked(*agents: Agent) -> None:
    await until(lambda: states(*agents) == {PeerState.PARKED})
    assert all(len(list(agent.bridge.sessions)) == len(agents) - 1 for agent in agents)


async def test_idle_modules_park_and_their_graphs_stay(on_demand: Callable[[str], Settings]) -> None:
    async with running(*map(on_demand, "abc")) as agents, node("talker", agents[0]) as talker:
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: all("/chatter" in agent.core.state().publishers for agent in agents))
        await parked(*agents)
        assert all("/chatter" in agent.core.state().publishers for agent in agents)
        meshes = [agent.network.endpoint.mesh for agent in agents if agent.network.endpoint is not None]
        await until(lambda: not any(mesh.connections() for mesh in meshes))


async def test_a_subscriber_of_a_parked_peer_gets_messages_and_the_latched_one(
    on_demand: Callable[[str], Settings],
) -> None:
    async with (
        running(*map(on_demand, "abc")) as (a, b, c),
        node("talker", a) as talker,
        node("hearer", b) as hearer,
    ):
        publisher = await talker.advertise("/map", "std_msgs/String", latch=True)
        publisher.publish(publisher.make({"data": "map"}))
        await until(lambda: "/map" in b.core.state().publishers)
        await parked(a, b, c)
        sink = Sink()
        subscriber = await hearer.subscribe("/map", "std_msgs/String", sink)
        await until(lambda: sink.heard == ["map"])
        assert not list(c.bridge.sessions.linked()), "others are not concerned"
        await asyncio.sleep(1.0)
        assert len(list(b.bridge.sessions.linked())) == 1, "the link stays while it is used"
        publisher.publish(publisher.make({"data": "more"}))
        await until(lambda: sink.heard == ["map", "more"])
        await subscriber.close()
        await parked(a, b, c)


async def test_a_service_of_a_parked_peer_is_looked_up_and_called(on_demand: Callable[[str], Settings]) -> None:
    async with running(*map(on_demand, "ab")) as (a, b), serving(a):
        await until(lambda: provider(b))
        await parked(a, b)
        connection = await connect(b)
        try:
            assert (await connection.call(b"hello")) == (True, b"hello")
        finally:
            connection.close()


async def test_a_request_to_a_parked_peer_is_answered(on_demand: Callable[[str], Settings]) -> None:
    async with running(*map(on_demand, "ab")) as (a, b):
        await parked(a, b)
        a.core.call("setParam", "/setter", "/speed", 3)
        told = await b.operations.param({"peer": "a", "what": "param.get", "args": {"key": "/speed"}})
        assert "3" in str(told)
        await parked(a, b)
        reply = await b.operations.ping({"peer": "a"})
        assert reply.times[0] is not None


async def test_both_want_each_other_at_the_same_moment(on_demand: Callable[[str], Settings]) -> None:
    async with (
        running(*map(on_demand, "ab")) as (a, b),
        node("one", a) as one,
        node("two", b) as two,
    ):
        here = await one.advertise("/here", "std_msgs/String", latch=True)
        there = await two.advertise("/there", "std_msgs/String", latch=True)
        here.publish(here.make({"data": "here"}))
        there.publish(there.make({"data": "there"}))
        await until(lambda: "/here" in b.core.state().publishers and "/there" in a.core.state().publishers)
        for _ in range(3):
            await parked(a, b)
            left, right = Sink(), Sink()
            subscribers = await asyncio.gather(
                one.subscribe("/there", "std_msgs/String", left), two.subscribe("/here", "std_msgs/String", right)
            )
            await until(lambda left=left, right=right: left.heard == ["there"] and right.heard == ["here"])  # type: ignore[misc]
            for subscriber in subscribers:
                await subscriber.close()


async def test_a_call_that_is_held_back_while_the_link_is_being_parked_is_made_over_the_next_one(
    on_demand: Callable[[str], Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_limits, "REST_AFTER", 60.0)
    async with running(*map(on_demand, "ab")) as (a, b), serving(a):
        await until(lambda: provider(b))
        (session,) = b.bridge.sessions
        link = session.link
        with monkeypatch.context() as agreed:  # this side has agreed to part, and the bye is on its way
            agreed.setattr(ConnectionProtocol, "holding", property(lambda _: True))
            calling = asyncio.create_task(call(b, "/add", b"hello"))
            await until(lambda: link.held)
        link.parked = True
        b.bridge.sessions.link_down(link)
        link.parked = False
        b.bridge.sessions.link_up(link)
        assert await calling == b"hello"


@pytest.mark.parametrize("seed", range(2))
async def test_calls_and_requests_of_both_sides_at_the_same_moment_are_answered(
    on_demand: Callable[[str], Settings], seed: int
) -> None:
    rng = random.Random(seed)
    async with running(*map(on_demand, "ab")) as (a, b), serving(a, "/in_a"), serving(b, "/in_b"):
        await until(lambda: provider(b, "/in_a") and provider(a, "/in_b"))
        for agent, value in ((a, 71), (b, 72)):
            agent.core.call("setParam", "/setter", "/speed", value)
            slow_down(agent, rng)
        for _ in range(4):
            await parked(a, b)
            in_b, in_a, of_b, of_a = await asyncio.gather(
                call(a, "/in_b", b"x"), call(b, "/in_a", b"y"), speed(a, "b"), speed(b, "a")
            )
            assert (in_b, in_a) == (b"x", b"y")
            assert "71" in of_a
            assert "72" in of_b


async def test_many_wants_at_once_of_one_and_of_several_parked_peers_are_served(
    on_demand: Callable[[str], Settings],
) -> None:
    async with (
        running(*map(on_demand, "abc")) as (a, b, c),
        serving(a, "/in_a"),
        serving(b, "/in_b"),
        node("talker", a) as talker,
        node("one", c) as one,
        node("two", c) as two,
    ):
        publisher = await talker.advertise("/map", "std_msgs/String", latch=True)
        publisher.publish(publisher.make({"data": "map"}))
        await until(lambda: provider(c, "/in_a") and provider(c, "/in_b") and "/map" in c.core.state().publishers)
        for agent, value in ((a, 71), (b, 72)):
            agent.core.call("setParam", "/setter", "/speed", value)
        await parked(a, b, c)
        sinks = {one: Sink(), two: Sink()}
        subscribing = (node.subscribe("/map", "std_msgs/String", sink) for node, sink in sinks.items())
        subscribers = await asyncio.gather(*subscribing)
        answers = await asyncio.gather(*(call(c, f"/in_{peer}", b"%d" % i) for i in range(10) for peer in "ab"))
        assert answers == [b"%d" % i for i in range(10) for _ in "ab"]
        told = await asyncio.gather(*(speed(c, peer) for _ in range(5) for peer in "ab"))
        assert all(value in answer for value, answer in zip(("71", "72") * 5, told, strict=True))
        await until(lambda: all(sink.heard == ["map"] for sink in sinks.values()))
        for subscriber in subscribers:
            await subscriber.close()
        await parked(a, b, c)
        told = await asyncio.gather(*(speed(c, peer) for _ in range(5) for peer in "ab"))
        assert all(value in answer for value, answer in zip(("71", "72") * 5, told, strict=True))


async def test_a_parked_peer_that_ends_is_gone_at_once(on_demand: Callable[[str], Settings]) -> None:
    async with running(on_demand("b")) as (b,):
        async with running_more(b, on_demand("a")) as a, node("talker", a) as talker:
            await talker.advertise("/chatter", "std_msgs/String")
            await until(lambda: "/chatter" in b.core.state().publishers)
            await parked(a, b)
        await until(lambda: "/chatter" not in b.core.state().publishers)
        assert not list(b.bridge.sessions)


async def test_a_parked_peer_that_cannot_be_reached_is_an_error_and_then_away(
    on_demand: Callable[[str], Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_limits, "WANT_GRACE", 1.0)
    async with running(*map(on_demand, "ab")) as (a, b), serving(a):
        await until(lambda: provider(b))
        await parked(a, b)
        assert b.network.endpoint is not None

        async def nowhere(*_: object) -> None:
            raise OSError("no route")

        monkeypatch.setattr(b.network.endpoint.mesh.dialler, "dial", nowhere)
        with pytest.raises(UnreachableError, match="it has no link"):
            await b.operations.agent({"peer": "a"})
        await until(lambda: not provider(b))
        monkeypatch.undo()
        await until(lambda: provider(b))


async def test_a_parked_peer_whose_datagrams_are_blocked_has_not_failed(
    on_demand: Callable[[str], Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(*map(on_demand, "abc")) as (a, b, c), node("talker", b) as talker:
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: all("/chatter" in agent.core.state().publishers for agent in (a, c)))
        await parked(a, b, c)
        lost: list[str] = []
        for agent in (a, c):
            monkeypatch.setattr(agent.bridge.sessions, "lost", lambda identity: lost.append(identity.name))
        assert b.network.endpoint is not None
        discovery = b.network.endpoint.discovery
        with monkeypatch.context() as firewall:  # it lets no datagram of this module pass, and all of its TCP
            firewall.setattr(PacketFilter, "parse", passing_all_but(discovery, PacketFilter.parse))
            for name in ("multicast", "unicast"):
                firewall.setattr(discovery._sender, name, lambda *_, **__: None)
            await until(lambda: len(list(b.bridge.sessions.linked())) == 2)
            await asyncio.sleep(8.0)  # a suspicion is over after 1.5 s, and an idle link is parked after 0.5 s
            assert len(list(b.bridge.sessions.linked())) == 2, "the links are the only sign of life"
        await parked(a, b, c)
        assert not lost
        assert all("/chatter" in agent.core.state().publishers for agent in (a, c))


async def test_a_small_mesh_keeps_all_links(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as agents:
        await asyncio.sleep(2.0)
        assert states(*agents) == {PeerState.LINKED}
        assert all(session.link.rests for agent in agents for session in agent.bridge.sessions)


async def test_one_module_that_wants_all_links_keeps_them(
    on_demand: Callable[[str], Settings], settings: Callable[..., Settings]
) -> None:
    async with running(on_demand("a"), settings("b")) as agents:
        await asyncio.sleep(2.0)
        assert states(*agents) == {PeerState.LINKED}


async def test_what_a_parked_peer_offers_anew_appears_and_what_it_withdraws_goes(
    on_demand: Callable[[str], Settings],
) -> None:
    async with running(*map(on_demand, "abc")) as agents, node("talker", agents[0]) as talker:
        await parked(*agents)
        publisher = await talker.advertise("/new", "std_msgs/String")
        await until(lambda: all("/new" in agent.core.state().publishers for agent in agents))
        async with serving(agents[0]):
            await until(lambda: all(provider(agent) for agent in agents))
            await parked(*agents)
        await until(lambda: not any(provider(agent) for agent in agents))
        await publisher.close()
        await until(lambda: not any("/new" in agent.core.state().publishers for agent in agents))
        await parked(*agents)
        held = {session.offers_held for session in agents[1].bridge.sessions if session.link.name == "a"}
        assert held == {agents[0].bridge.sessions.offers.version}


async def test_modules_of_an_earlier_release_stay_linked_and_get_no_probes(
    on_demand: Callable[[str], Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmpa.mesh.handshake.FEATURES", 0)  # what both say of themselves
    async with running(*map(on_demand, "ab")) as (a, b), node("talker", a) as talker:
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: "/chatter" in b.core.state().publishers)
        await asyncio.sleep(2.0)
        assert states(a, b) == {PeerState.LINKED}
        for agent in (a, b):
            endpoint = agent.network.endpoint
            assert endpoint is not None
            assert not any(link.rests for link in endpoint.mesh.links())
            view = endpoint.discovery.detector
            assert view.active
            assert view.members == 0
