"""The agent tells changes of the graph: they are seen at once, and without it by looking again and again."""

from __future__ import annotations

import asyncio
import functools
import secrets
from typing import TYPE_CHECKING, Any

from rmpa.observe.control_server import ControlServer
from rmpa.observe.operations import GraphRevisions
from rmpa.trust.permissions import TrustStatus
from rmpa.web.server.agent_watch import AgentFollower
from tests.ros.node.peers import DEADLINE, LATCHED, until
from tests.web.hub.client import local_core, node, running_hub
from tests.web.snapshots import FULL

if TYPE_CHECKING:
    from pathlib import Path

    from rmpa.observe.control import GraphRevision
    from rmpa.web.hub.hub import Hub


def fits(status: TrustStatus | None) -> bool:
    return status is None


def agent_of(place: Path, graph: Any) -> ControlServer:
    """The control socket of an open agent, with its answer to questions about the graph."""
    answers = {"trust": lambda _: TrustStatus(on=False, module="base"), "snapshot": lambda _: FULL, "graph": graph}
    return ControlServer(place, "base", answers)


def _has_topic(hub: Hub, name: str) -> bool:
    return name in hub.graph.topics


async def test_a_new_topic_is_seen_by_the_agents_word_and_again_after_its_restart(tmp_path: Path) -> None:
    environ = {"RMPA_RUNTIME_DIR": str(tmp_path)}
    async with local_core() as core, running_hub(core) as hub, node(core, "talker") as talker:
        changes = AgentFollower(environ, "base", fits)
        changes.start(hub.graph)
        for name in ("/first", "/second"):
            server = agent_of(tmp_path, GraphRevisions(core, rows=True).after)
            await server.start()
            await until(lambda: hub.graph.taken)
            reads = hub.graph.reads
            async with asyncio.timeout(DEADLINE):
                await talker.advertise(name, LATCHED)
                await until(functools.partial(_has_topic, hub, name))
            assert hub.graph.taken
            assert hub.graph.reads == reads, "the change itself was told"
            await server.close()
            await until(lambda: not hub.graph.told)
            await talker.advertise(f"{name}_{secrets.token_hex(2)}", LATCHED)
            await until(lambda: len(hub.graph.topics) > 2)
        await changes.close()


async def test_an_agent_that_tells_only_that_there_is_a_change_has_the_master_read(tmp_path: Path) -> None:
    async with local_core() as core, running_hub(core) as hub, node(core, "talker") as talker:
        server = agent_of(tmp_path, GraphRevisions(core, rows=False).after)
        await server.start()
        changes = AgentFollower({"RMPA_RUNTIME_DIR": str(tmp_path)}, "base", fits)
        changes.start(hub.graph)
        await until(lambda: hub.graph.told)
        reads = hub.graph.reads
        async with asyncio.timeout(DEADLINE):
            await talker.advertise("/told", LATCHED)
            await until(functools.partial(_has_topic, hub, "/told"))
        assert hub.graph.reads > reads
        assert not hub.graph.taken
        await changes.close()
        await server.close()


async def test_the_graph_of_another_core_is_not_taken(tmp_path: Path) -> None:
    async with local_core() as core, local_core() as other, running_hub(core) as hub, node(other) as stranger:
        await stranger.advertise("/strange", LATCHED)
        asked = asyncio.Event()
        revisions = GraphRevisions(other, rows=True)

        async def answer(args: Any) -> GraphRevision:
            asked.set()
            return await revisions.after(args)

        server = agent_of(tmp_path, answer)
        await server.start()
        changes = AgentFollower({"RMPA_RUNTIME_DIR": str(tmp_path)}, "base", fits)
        changes.start(hub.graph)
        await asked.wait()
        asked.clear()
        await asked.wait()  # the first answer was refused, and the question is asked anew
        assert not hub.graph.taken
        assert "/strange" not in hub.graph.topics
        await changes.close()
        await server.close()


async def test_a_master_that_goes_while_the_agent_tells_the_graph_is_noticed(tmp_path: Path) -> None:
    async with local_core() as core, running_hub(core) as hub:
        server = agent_of(tmp_path, GraphRevisions(core, rows=True).after)
        await server.start()
        changes = AgentFollower({"RMPA_RUNTIME_DIR": str(tmp_path)}, "base", fits)
        changes.start(hub.graph)
        await until(lambda: hub.graph.taken)
        checked = asyncio.Event()

        async def check() -> None:
            checked.set()

        hub.link.check_master = check  # type: ignore[method-assign]
        await core.close()
        async with asyncio.timeout(DEADLINE):
            await checked.wait()
        await changes.close()
        await server.close()


async def test_an_agent_that_does_not_know_the_question_is_no_error(tmp_path: Path) -> None:
    asked: list[Any] = []

    def refuse(args: Any) -> str:
        asked.append(args)
        return "nothing"

    async with local_core() as core, running_hub(core) as hub, node(core, "talker") as talker:
        server = agent_of(tmp_path, refuse)
        await server.start()
        changes = AgentFollower({"RMPA_RUNTIME_DIR": str(tmp_path)}, "base", fits)
        changes.start(hub.graph)
        await until(lambda: asked)
        await talker.advertise("/seen", LATCHED)
        hub.graph.active = True
        await until(lambda: "/seen" in hub.graph.topics)
        assert not hub.graph.told
        await changes.close()
        await server.close()


async def test_a_server_is_made_anew_for_an_agent_that_is_secured_meanwhile(tmp_path: Path) -> None:
    async with local_core() as core, running_hub(core) as hub:
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
        async with asyncio.timeout(DEADLINE):
            await follower.misfit.wait()
        await follower.close()
        await agent.close()
