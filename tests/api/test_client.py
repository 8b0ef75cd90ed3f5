"""``rmpa.client`` at a fake agent; ``tests/examples/test_nodes.py`` has it at a real one."""

from __future__ import annotations

import asyncio
import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from rmpa import client
from rmpa.core.errors import RmpaError, UnreachableError
from rmpa.core.facts import RouteInfo
from rmpa.observe.control_server import ControlServer
from rmpa.observe.graph import GraphRevision
from tests.observe.samples import SNAPSHOT

DEADLINE = 20.0
PEER = next(peer for peer in SNAPSHOT.peers if peer.state == "linked")
EMPTY = msgspec.structs.replace(SNAPSHOT, peers=(), topics=(), services=(), notes=())
CHATTER = client.TopicInfo(name="/chatter", routes=(RouteInfo(peer="base", node="/n", direction="in", state="open"),))


@pytest.fixture(autouse=True)
def place(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="rmpa-test-") as name:
        monkeypatch.setenv("RMPA_RUNTIME_DIR", name)
        monkeypatch.delenv("RMPA_AGENT", raising=False)
        yield Path(name)


def having(**parts: Any) -> client.Snapshot:
    return msgspec.structs.replace(EMPTY, **parts)


def told(before: client.Snapshot | None, after: client.Snapshot) -> list[client.AgentEvent]:
    return list(client.changes(before, after))


def test_what_comes_and_goes_between_two_snapshots() -> None:
    service = client.ServiceInfo(name="/add", node="/n", direction="out")
    full = having(peers=(PEER,), topics=(CHATTER,), services=(service,), notes=("a port is taken",))
    assert told(EMPTY, EMPTY) == told(full, full) == []
    come = [
        client.PeerLinked(PEER),
        client.TopicAppeared(CHATTER),
        client.ServiceAppeared(service),
        client.NoteRaised("a port is taken"),
    ]
    assert told(EMPTY, full) == told(None, full) == come
    assert told(full, EMPTY) == [
        client.PeerLost(PEER),
        client.TopicGone(CHATTER),
        client.ServiceGone(service),
        client.NoteCleared("a port is taken"),
    ]


def test_a_peer_is_lost_when_its_link_is_and_says_why() -> None:
    gone = msgspec.structs.replace(PEER, state="linking", last_error="it fell silent")
    assert told(having(peers=(PEER,)), having(peers=(gone,))) == [client.PeerLost(gone)]
    assert told(having(peers=(gone,)), having(peers=(PEER,))) == [client.PeerLinked(PEER)]
    relayed = msgspec.structs.replace(PEER, state="relayed")
    assert told(having(peers=(PEER,)), having(peers=(relayed,))) == []


def test_a_contract_that_is_broken_is_told_with_its_count() -> None:
    def counted(**events: int) -> client.Snapshot:
        route = msgspec.structs.replace(CHATTER.routes[0], events=events)
        return having(topics=(msgspec.structs.replace(CHATTER, routes=(route,)),))

    assert told(counted(deadline_missed=2), counted(deadline_missed=5, liveliness_restored=1)) == [
        client.ContractBroken("/chatter", "base", "deadline_missed", 3)
    ]
    assert told(counted(deadline_missed=5), counted(deadline_missed=1)) == []  # the route was opened anew


class FakeAgent:
    """Shows one snapshot after the other; a new one is a change of the graph."""

    def __init__(self, place: Path, name: str = "base", **handlers: Any) -> None:
        self.shown = EMPTY
        self.revision = 1
        self.changed = asyncio.Event()
        self.server = ControlServer(place, name, {"snapshot": lambda _: self.shown, "graph": self._graph, **handlers})

    def show(self, shown: client.Snapshot) -> None:
        self.shown = shown
        self.revision += 1
        self.changed.set()

    async def _graph(self, args: dict[str, Any]) -> GraphRevision:
        if args.get("after") == self.revision:
            self.changed.clear()
            async with asyncio.timeout(DEADLINE):
                await self.changed.wait()
        return GraphRevision(revision=self.revision)


async def test_events_begin_with_what_is_there_and_follow_each_change_at_once(place: Path) -> None:
    agent = FakeAgent(place)
    agent.shown = having(peers=(PEER,))
    await agent.server.start()
    async with asyncio.timeout(DEADLINE), client.AgentClient() as asked:
        assert asked.name == "base"
        snapshot = await asked.snapshot()
        assert snapshot == agent.shown
        events = asked.events(period=DEADLINE)
        assert await anext(events) == client.PeerLinked(PEER)
        waiting = asyncio.ensure_future(anext(events))
        agent.show(having(peers=(PEER,), topics=(CHATTER,)))
        assert await waiting == client.TopicAppeared(CHATTER)
        later = asked.events(since=snapshot)
        assert await anext(later) == client.TopicAppeared(CHATTER)
        await events.aclose()
        await later.aclose()
    await agent.server.close()


async def test_an_agent_that_ends_is_waited_for(place: Path) -> None:
    first, second = FakeAgent(place), FakeAgent(place)
    await first.server.start()
    async with asyncio.timeout(DEADLINE), client.AgentClient("base") as asked:
        events = asked.events(since=EMPTY, period=0.05)
        waiting = asyncio.ensure_future(anext(events))
        await asyncio.sleep(0)
        await first.server.close()
        lost = await waiting
        assert isinstance(lost, client.AgentLost)
        assert "no agent answers at" in lost.problem
        second.show(having(topics=(CHATTER,)))
        await second.server.start()
        assert await anext(events) == client.AgentReturned(EMPTY.agent)
        assert await anext(events) == client.TopicAppeared(CHATTER)
        await events.aclose()
    await second.server.close()


async def test_an_agent_without_a_graph_is_asked_once_a_period(place: Path) -> None:
    shown = itertools.chain((EMPTY, EMPTY), itertools.repeat(having(topics=(CHATTER,))))
    server = ControlServer(place, "hall", {"snapshot": lambda _: next(shown)})
    await server.start()
    async with asyncio.timeout(DEADLINE), client.AgentClient() as asked:
        events = asked.events(period=0.01)
        assert await anext(events) == client.TopicAppeared(CHATTER)
        await events.aclose()
    await server.close()


async def test_the_agent_is_chosen_as_the_commands_choose_it(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnreachableError, match="start one with `rmpa up`"):
        await client.AgentClient().__aenter__()
    with pytest.raises(RmpaError, match="async with AgentClient"):
        await client.AgentClient().snapshot()
    with pytest.raises(ValueError, match="the period of events is above 0 and finite, not 0"):
        await anext(client.AgentClient().events(period=0))
    agents = [FakeAgent(place, name) for name in ("arm", "base")]
    for agent in agents:
        await agent.server.start()
    monkeypatch.setenv("RMPA_AGENT", "arm")
    for name, expected in ((None, "arm"), ("base", "base")):
        async with client.AgentClient(name) as asked:
            assert asked.name == expected
    agents[0].shown = having(notes=("this is arm",))
    assert (await asyncio.to_thread(client.snapshot)).notes == ("this is arm",)
    for agent in agents:
        await agent.server.close()
