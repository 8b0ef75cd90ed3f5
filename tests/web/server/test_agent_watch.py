"""What the server knows of the agent: one snapshot for all clients, changes of the graph, and its trust."""

from __future__ import annotations

import asyncio
import functools
import secrets
import socket
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
import pytest

from rmpa.core.errors import UnreachableError
from rmpa.observe.control_client import ControlReply
from rmpa.observe.control_server import ControlServer
from rmpa.observe.graph import GraphRevision, GraphRevisions
from rmpa.observe.snapshot import Snapshot
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.trust.permissions import TrustStatus
from rmpa.web import limits
from rmpa.web.hub.hub import Hub
from rmpa.web.server.agent_watch import AgentFollower, AgentWatch, ControlReader
from tests.ros.node.peers import LATCHED
from tests.waiting import DEADLINE, until
from tests.web.hub.client import local_core, node
from tests.web.snapshots import FULL, Agent


def test_an_agent_that_hangs_is_waited_for_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "WEB_AGENT_TIMEOUT", 0.2)
    requests: list[bytes] = []
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "base.sock"))
        listener.listen()

        def answer_twice() -> None:
            connections = []
            while len(requests) < 3:
                connections.append(listener.accept()[0])
                with connections[-1].makefile("rb") as lines:
                    for line in lines:
                        requests.append(line)
                        if len(requests) > 2:
                            break
                        connections[-1].sendall(ControlReply(ok=True, value=FULL).serialize())
            released.wait(DEADLINE)
            for connection in connections:
                connection.close()

        released, thread = threading.Event(), threading.Thread(target=answer_twice)
        thread.start()
        reader = ControlReader({"RMPA_RUNTIME_DIR": str(tmp_path)}, "base")
        assert reader() == reader() == FULL
        with pytest.raises(UnreachableError, match="in time"):
            reader()
        released.set()
        thread.join()
        reader.close()
    assert len(requests) == 3


@pytest.fixture
async def watched() -> AsyncIterator[tuple[Agent, AgentWatch]]:
    agent = Agent()
    watch = AgentWatch(agent.read, agent.clock)
    yield agent, watch
    await watch.close()


Watched: TypeAlias = tuple[Agent, AgentWatch]


async def test_many_clients_cost_the_agent_one_question_and_one_that_leaves_takes_nothing_from_the_others(
    watched: Watched,
) -> None:
    agent, watch = watched
    agent.may_answer.clear()
    leaving, *asking = (asyncio.create_task(watch.reading()) for _ in range(100))
    await asyncio.sleep(0)
    leaving.cancel()
    await asyncio.sleep(0)
    agent.may_answer.set()
    assert all(reading.snapshot is agent.snapshot for reading in await asyncio.gather(*asking))
    for later, asked in ((0.9, 1), (1, 2)):
        agent.now += limits.WEB_SNAPSHOT_AGE * later
        await watch.reading()
        assert agent.asked == watch.reads == asked


async def test_an_agent_that_is_away_is_asked_no_more_often_and_found_again(watched: Watched) -> None:
    agent, watch = watched
    agent.up = False
    for _ in range(10):
        reading = await watch.reading()
        assert (reading.snapshot, "rmpa up" in reading.problem) == (None, True)
    assert agent.asked == 1
    agent.up = True
    agent.now += limits.WEB_SNAPSHOT_AGE
    assert (await watch.reading()).snapshot is agent.snapshot


async def test_all_of_a_large_graph_is_read_only_for_those_that_need_it() -> None:
    part = msgspec.structs.replace(FULL, topics=(), topics_left=len(FULL.topics))
    now, wholes, shown = 0.0, 0, part

    def read_whole() -> Snapshot:
        nonlocal wholes
        wholes += 1
        return FULL

    watch = AgentWatch(lambda: shown, lambda: now, read_whole)
    assert (await watch.reading()).snapshot == part
    for usual, asked in ((part, 1), (part, 2), (FULL, 2)):  # of the last one nothing is left out
        shown = usual
        readings = await asyncio.gather(*(watch.reading(whole=True) for _ in range(10)))
        assert all(reading.snapshot is FULL for reading in readings)
        assert wholes == asked
        now += limits.WEB_WHOLE_AGE
    await watch.close()


@pytest.fixture(autouse=True)
def _tried_again_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "NODE_RETRY", 0.05)


def fits(status: TrustStatus | None) -> bool:
    return status is None


def agent_of(place: Path, graph: Any) -> ControlServer:
    """The control socket of an open agent, with its answer to questions about the graph."""
    answers = {"trust": lambda _: TrustStatus(on=False, module="base"), "snapshot": lambda _: FULL, "graph": graph}
    return ControlServer(place, "base", answers)


@asynccontextmanager
async def following(hub: Hub, place: Path, graph: Any) -> AsyncIterator[None]:
    """An agent that answers questions about the graph so, and a server that follows it."""
    server, changes = agent_of(place, graph), AgentFollower({"RMPA_RUNTIME_DIR": str(place)}, "base", fits)
    await server.start()
    changes.start(hub.graph)
    yield
    await changes.close()
    await server.close()


def _has_topic(hub: Hub, name: str) -> bool:
    return name in hub.graph.topics


async def test_a_new_topic_is_seen_by_the_agents_word_and_again_after_its_restart(
    tmp_path: Path, core: RosCore, hub: Hub, talker: Node
) -> None:
    changes = AgentFollower({"RMPA_RUNTIME_DIR": str(tmp_path)}, "base", fits)
    changes.start(hub.graph)
    for name in ("/first", "/second"):
        server = agent_of(tmp_path, GraphRevisions(core, rows=True).after)
        await server.start()
        await until(lambda: hub.graph.taken)
        reads = hub.graph.reads
        await talker.advertise(name, LATCHED)
        await until(functools.partial(_has_topic, hub, name))
        assert hub.graph.taken
        assert hub.graph.reads == reads, "the change itself was told"
        await server.close()
        await until(lambda: not hub.graph.told)
        await talker.advertise(f"{name}_{secrets.token_hex(2)}", LATCHED)
        await until(lambda: len(hub.graph.topics) > 2)
    await changes.close()


async def test_an_agent_that_tells_only_that_there_is_a_change_has_the_master_read(
    tmp_path: Path, core: RosCore, hub: Hub, talker: Node
) -> None:
    async with following(hub, tmp_path, GraphRevisions(core, rows=False).after):
        await until(lambda: hub.graph.told)
        reads = hub.graph.reads
        await talker.advertise("/told", LATCHED)
        await until(functools.partial(_has_topic, hub, "/told"))
        assert hub.graph.reads > reads
        assert not hub.graph.taken


async def test_the_graph_of_another_core_is_not_taken(tmp_path: Path, hub: Hub) -> None:
    async with local_core() as other, node(other) as stranger:
        await stranger.advertise("/strange", LATCHED)
        asked = 0
        revisions = GraphRevisions(other, rows=True)

        async def answer(args: Any) -> GraphRevision:
            nonlocal asked
            asked += 1
            return await revisions.after(args)

        async with following(hub, tmp_path, answer):
            await until(lambda: asked > 1)  # the first answer was refused, and the question is asked anew
            assert not hub.graph.taken
            assert "/strange" not in hub.graph.topics


async def test_a_master_that_goes_while_the_agent_tells_the_graph_is_noticed(
    tmp_path: Path, core: RosCore, hub: Hub
) -> None:
    async with following(hub, tmp_path, GraphRevisions(core, rows=True).after):
        await until(lambda: hub.graph.taken)
        checked: list[bool] = []

        async def check() -> None:
            checked.append(True)

        hub.link.check_master = check  # type: ignore[method-assign]
        await core.close()
        await until(lambda: checked)


async def test_an_agent_that_does_not_know_the_question_is_no_error(tmp_path: Path, hub: Hub, talker: Node) -> None:
    asked: list[Any] = []

    def refuse(args: Any) -> str:
        asked.append(args)
        return "nothing"

    async with following(hub, tmp_path, refuse):
        await until(lambda: asked)
        await talker.advertise("/seen", LATCHED)
        hub.graph.active = True
        await until(lambda: "/seen" in hub.graph.topics)
        assert not hub.graph.told


async def test_a_server_is_made_anew_for_an_agent_that_is_secured_meanwhile(
    tmp_path: Path, core: RosCore, hub: Hub
) -> None:
    follower = AgentFollower({"RMPA_RUNTIME_DIR": str(tmp_path)}, None, fits)
    follower.start(hub.graph)
    agent = agent_of(tmp_path, GraphRevisions(core, rows=True).after)
    await agent.start()
    await until(lambda: hub.graph.taken)
    await agent.close()
    assert not follower.misfit.is_set()
    secured = {"trust": lambda _: TrustStatus(on=True, module="base"), "snapshot": lambda _: FULL}
    agent = ControlServer(tmp_path, "base", secured)
    await agent.start()
    await until(follower.misfit.is_set)
    await follower.close()
    await agent.close()
