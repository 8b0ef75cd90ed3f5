"""Whole agents in one process whose links stand on demand: what is used of a parked peer works as from any other."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.session.peer_session import PeerState
from rmpa.core.errors import UnreachableError
from rmpa.core.links import Links
from rmpa.mesh import limits as mesh_limits
from tests.agent.test_agent import Sink, node, running, running_more, settings, until
from tests.agent.test_services import connect, provider, serving

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.agent import Agent
    from rmpa.config.settings import Settings

__all__ = ["settings"]


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Links rest and park within a moment."""
    monkeypatch.setattr(mesh_limits, "REST_AFTER", 0.2)
    monkeypatch.setattr(mesh_limits, "PARK_AFTER", 0.2)
    monkeypatch.setattr(mesh_limits, "IDLE_KEEPALIVE_INTERVAL", 0.1)
    monkeypatch.setattr(bridge_limits, "RECONCILE_INTERVAL", 0.1)


@pytest.fixture
def on_demand(settings: Callable[..., Settings]) -> Callable[[str], Settings]:
    return lambda name: replace(settings(name), links=Links.DEMAND)


def states(*agents: Agent) -> set[PeerState]:
    return {session.state for agent in agents for session in agent.bridge.sessions}


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
