"""Whole agents in one process whose copy of a peer's offers is wrong, or right already."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.messages import Advertise, op_of
from rmpa.bridge.session.offer_versions import DIFFERED, SENT_AGAIN
from rmpa.core.links import Links
from rmpa.mesh import handshake
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.handshake import Feature
from rmpa.mesh.io.link import PeerLink
from tests.agent.test_agent import Sink, node, running, settings, until
from tests.agent.test_parked import on_demand, parked
from tests.agent.test_services import provider, serving

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.agent import Agent
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.config.settings import Settings

__all__ = ["on_demand", "settings"]


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Links rest and park, and copies are compared, within a moment."""
    monkeypatch.setattr(mesh_limits, "REST_AFTER", 0.2)
    monkeypatch.setattr(mesh_limits, "PARK_AFTER", 0.2)
    monkeypatch.setattr(mesh_limits, "IDLE_KEEPALIVE_INTERVAL", 0.1)
    monkeypatch.setattr(bridge_limits, "RECONCILE_INTERVAL", 0.1)
    monkeypatch.setattr(bridge_limits, "REFETCH_PAUSE", 0.3)


def session_of(agent: Agent, peer: str) -> PeerSession:
    return next(session for session in agent.bridge.sessions if session.link.name == peer)


async def right(*agents: Agent) -> None:
    """Each copy was compared with what its peer told of its present offers, and is right."""

    versions = {offers.instance: offers for offers in (agent.bridge.sessions.offers for agent in agents)}

    def copies() -> list[bool]:
        return [
            session.copy.right is True and session.offers_held == versions[session.link.identity.instance].version
            for agent in agents
            for session in agent.bridge.sessions
        ]

    await until(lambda: len(copies()) == len(agents) * (len(agents) - 1) and all(copies()))


def lose(agent: Agent, peer: str, topic: str) -> None:
    """Remove a topic of a peer from the copy and the graph, as an advertisement that was wrongly applied would."""
    topics, session = agent.bridge.topics, session_of(agent, peer)
    source = next(source for number, source in topics.imports.at(topic) if number == session.peer)
    topics._act(topics.imports.advertised(session.peer, Advertise(removed=(source,))))


def advertised(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The advertisements that are sent from now on, by any agent of this process."""
    seen: list[bytes] = []
    send = PeerLink.send_control

    def spy(link: PeerLink, payload: bytes) -> None:
        if op_of(payload) in ("advertise", "services"):
            seen.append(payload)
        send(link, payload)

    monkeypatch.setattr(PeerLink, "send_control", spy)
    return seen


def shown(agent: Agent, topic: str) -> bool:
    return topic in agent.core.state().publishers


@pytest.mark.parametrize("links", [Links.FULL, Links.DEMAND])
async def test_a_copy_that_differs_is_fetched_again(settings: Callable[..., Settings], links: Links) -> None:
    made = [replace(settings(name), links=links) for name in "ab"]
    async with running(*made) as (a, b), node("talker", a) as talker, serving(a):
        await talker.advertise("/chatter", "std_msgs/String")
        await talker.advertise("/more", "std_msgs/String")
        await until(lambda: shown(b, "/chatter") and shown(b, "/more") and provider(b) is not None)
        await right(a, b)
        if links is Links.DEMAND:
            await parked(a, b)
        lose(b, "a", "/chatter")
        await until(lambda: not shown(b, "/chatter"))
        await until(lambda: shown(b, "/chatter"))
        await right(a, b)
        assert session_of(b, "a").copy.differed == 1
        assert b.bridge.counters[DIFFERED] == 1
        info = next(info for info in b.snapshots.build().peers if info.name == "a")
        assert info.offers is not None
        assert (info.offers.right, info.offers.differed) == (True, 1)
        if links is Links.FULL:
            assert a.bridge.counters[SENT_AGAIN] == 1


async def test_a_lost_change_is_found_and_a_subscriber_goes_on(settings: Callable[..., Settings]) -> None:
    async with (
        running(settings("a"), settings("b")) as (a, b),
        node("talker", a) as talker,
        node("hearer", b) as hearer,
    ):
        publisher = await talker.advertise("/chatter", "std_msgs/String", latch=True)
        publisher.publish(publisher.make({"data": "first"}))
        sink = Sink()
        await hearer.subscribe("/chatter", "std_msgs/String", sink)
        await until(lambda: sink.heard == ["first"])
        await right(a, b)
        apply = b.bridge.topics.imports.take_in
        b.bridge.topics.imports.take_in = lambda *_: []  # type: ignore[method-assign]
        await talker.advertise("/new", "std_msgs/String")
        await until(lambda: session_of(b, "a").copy.differed > 0)
        assert not shown(b, "/new")
        b.bridge.topics.imports.take_in = apply  # type: ignore[method-assign]
        await until(lambda: shown(b, "/new"))
        await right(a, b)
        publisher.publish(publisher.make({"data": "second"}))
        await until(lambda: sink.heard == ["first", "second"])


async def test_a_catalogue_that_is_held_is_not_sent_again(
    on_demand: Callable[[str], Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(*map(on_demand, "ab")) as (a, b), node("talker", a) as talker, serving(a):
        publisher = await talker.advertise("/map", "std_msgs/String", latch=True)
        publisher.publish(publisher.make({"data": "map"}))
        for number in range(20):
            await talker.advertise(f"/topic{number}", "std_msgs/String")
        await until(lambda: shown(b, "/topic19") and provider(b) is not None)
        await right(a, b)
        await parked(a, b)
        seen = advertised(monkeypatch)
        async with node("hearer", b) as hearer:
            sink = Sink()
            subscriber = await hearer.subscribe("/map", "std_msgs/String", sink)
            await until(lambda: sink.heard == ["map"])
            unchanged = [payload for payload in seen if b'"unchanged":true' in payload]
            assert len(unchanged) == 4, "topics and services of both"
            assert not any(b"/topic" in payload for payload in seen)
            await talker.advertise("/later", "std_msgs/String")
            await until(lambda: shown(b, "/later"))
            await subscriber.close()
        await right(a, b)
        await parked(a, b)


async def test_what_changes_while_peers_are_parked_is_the_same_everywhere(
    on_demand: Callable[[str], Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(*map(on_demand, "abc")) as agents, node("talker", agents[0]) as talker:
        await talker.advertise("/old", "std_msgs/String")
        await until(lambda: all(shown(agent, "/old") for agent in agents))
        await right(*agents)
        await parked(*agents)
        seen = advertised(monkeypatch)
        publisher = await talker.advertise("/new", "std_msgs/String")
        await until(lambda: all(shown(agent, "/new") for agent in agents))
        await right(*agents)
        await parked(*agents)
        await publisher.close()
        await until(lambda: not any(shown(agent, "/new") for agent in agents))
        await right(*agents)
        assert not any(session.copy.differed for agent in agents for session in agent.bridge.sessions)
        assert any(b'"unchanged":true' in payload for payload in seen), "what the others offer was not sent again"


async def test_a_peer_of_an_earlier_release_is_told_and_tells_as_before(
    on_demand: Callable[[str], Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(handshake, "FEATURES", handshake.FEATURES & ~Feature.OFFERS)
    async with running(*map(on_demand, "ab")) as (a, b), node("talker", a) as talker:
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: shown(b, "/chatter"))
        await parked(a, b)
        seen = advertised(monkeypatch)
        await talker.advertise("/new", "std_msgs/String")
        await until(lambda: shown(b, "/new"))
        await parked(a, b)
        assert not any(b"unchanged" in payload for payload in seen)
        assert {session.copy.right for agent in (a, b) for session in agent.bridge.sessions} == {None}


async def test_a_peer_that_wants_its_copy_again_and_again_is_sent_it_at_a_bounded_rate(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(settings("a"), settings("b")) as (a, b), node("talker", a) as talker:
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: shown(b, "/chatter"))
        await right(a, b)
        monkeypatch.setattr(bridge_limits, "REFETCH_PAUSE", 3600.0)
        session = session_of(b, "a")
        for _ in range(10):
            b.bridge.rpc.notify(session, "offers.again", {"version": 1})
        await until(lambda: a.bridge.counters[SENT_AGAIN] == 1)
        await right(a, b)
        await asyncio.sleep(0.3)
        assert a.bridge.counters[SENT_AGAIN] == 1
