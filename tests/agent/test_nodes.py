"""Nodes across modules, in whole agents: listed, described, asked and ended."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from rmpa.bridge.nodes import NODES, Nodes
from rmpa.config.peer_rules import PeerRule, PolicySettings
from rmpa.config.settings import NodeSettings, Settings
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.environment import NodeFacts, NodePing, PeerNodes
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.node import Node
from rmpa.ros.node.service_client import ServiceConnection
from tests.agent.test_agent import node, running, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.agent.agent import Agent


async def ask(agent: Agent, kind: Any, what: str, name: str = "", peer: str | None = "b") -> Any:
    return msgspec.convert(
        msgspec.to_builtins(await agent.operations.node({"what": what, "peer": peer, "node": name})), kind
    )


@asynccontextmanager
async def mortal(name: str, agent: Agent) -> AsyncIterator[tuple[Node, asyncio.Event]]:
    """A node that ends when it is told to, as a program does."""
    ready, told, ended = asyncio.Event(), asyncio.Event(), asyncio.Event()
    made = Node(name, master_uri=agent.core.uri, on_shutdown=lambda _: told.set())

    async def live() -> None:
        async with made:
            ready.set()
            await told.wait()
        ended.set()

    life = asyncio.create_task(live())
    await asyncio.wait_for(ready.wait(), 20)
    try:
        yield made, ended
    finally:
        told.set()
        await life


def proxy(agent: Agent, name: str) -> str:
    """The slave API of what stands for a node of b."""
    return agent.core.state().nodes.get(f"/rmpa/b/{name}", "")


async def test_nodes_of_a_peer_are_listed_described_and_pinged(settings: Callable[..., Settings]) -> None:
    async with (
        running(settings("a"), settings("b")) as (a, b),
        node("talker", b) as talker,
        node("hearer", b) as hearer,
    ):
        await talker.advertise("/chatter", "std_msgs/String")
        await hearer.subscribe("/chatter", "std_msgs/String", lambda _: None)
        (told,) = await ask(a, tuple[PeerNodes, ...], "node.list", peer=None)
        assert (told.peer, told.problem) == ("b", "")
        assert [line.name for line in told.nodes] == ["/hearer", "/rosout", "/talker"]
        assert told == (await ask(a, tuple[PeerNodes, ...], "node.list"))[0]
        talks = told.nodes[2]
        assert (talks.publications, talks.subscriptions, talks.problem) == (1, 0, "")

        facts = await ask(a, NodeFacts, "node.info", "/talker")
        assert facts.uri == b.core.state().nodes["/talker"]
        assert facts.pid
        assert facts.publications["/chatter"] == "std_msgs/String"
        assert not facts.problem
        pong = await ask(a, NodePing, "node.ping", "/talker")
        assert (pong.uri, pong.pid) == (facts.uri, facts.pid)
        assert 0 < pong.time < 20

        with pytest.raises(PeerRefused, match="b has no node /tolker; did you mean /talker"):
            await ask(a, NodePing, "node.ping", "/tolker")
        with pytest.raises(PeerRefused, match="/rmpa is no node of b: it is its agent"):
            await ask(a, dict[str, bool], "node.kill", "/rmpa")
        with pytest.raises(PeerRefused, match="names no node"):
            await ask(a, dict[str, bool], "node.kill", "no name")
        with pytest.raises(UnreachableError, match="linked peer"):
            await ask(a, dict[str, bool], "node.kill", "/x", peer="c")
        with pytest.raises(RmpaError, match=r"did you mean node\.kill"):
            await ask(a, dict[str, bool], "node.kil", "/x")


async def test_an_older_agent_without_node_requests(settings: Callable[..., Settings]) -> None:
    """An older release: what stands here is shown, and the rest says why not."""
    async with running(settings("a"), settings("b")) as (a, b), node("talker", b) as talker:
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: proxy(a, "talker"))
        for what in [what for what in b.bridge.rpc.handlers if what.startswith("node.")]:
            del b.bridge.rpc.handlers[what]
        (told,) = await ask(a, tuple[PeerNodes, ...], "node.list")
        assert [line.name for line in told.nodes] == ["/talker"]
        assert "does not know the question 'node.list'" in told.problem
        with pytest.raises(PeerRefused, match="install the same release on both"):
            await ask(a, NodePing, "node.ping", "/talker")
        reply = await call_api(proxy(a, "talker"), "shutdown", "/rosnode", "user request")
        assert (reply.code, "does not know" in reply.status) == (0, True)


async def test_killing_a_proxy_ends_its_node(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b), mortal("talker", b) as (talker, ended):
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: proxy(a, "talker"))
        assert await call_api(proxy(a, "talker"), "shutdown", "/rosnode", "user request") == (1, "shutdown", 0)
        await asyncio.wait_for(ended.wait(), 20)
        await until(lambda: not proxy(a, "talker"))
        assert "/talker" not in b.core.state().nodes


async def test_a_node_is_not_ended_without_permission(settings: Callable[..., Settings]) -> None:
    b_settings = replace(settings("b"), nodes=NodeSettings(kill=("/demo/**",)))
    async with running(settings("a"), b_settings) as (a, b), mortal("talker", b) as (talker, ended):
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: proxy(a, "talker"))
        reply = await call_api(proxy(a, "talker"), "shutdown", "/rosnode", "user request")
        refusal = "no glob of nodes.kill in the rmpa.toml of b fits /talker"
        assert (reply.code, refusal in reply.status) == (0, True)
        with pytest.raises(PeerRefused, match=refusal):
            await ask(a, dict[str, bool], "node.kill", "/talker")
        assert not ended.is_set()
        b.apply_settings(replace(b_settings, nodes=NodeSettings()))
        assert (await ask(a, dict[str, bool], "node.kill", "/talker"))["gone"]


async def test_a_node_that_does_not_end(settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "NODE_KILL_WAIT", 0.3)
    async with running(settings("a"), settings("b")) as (a, b), node("stubborn", b) as stubborn:
        await stubborn.advertise("/chatter", "std_msgs/String")
        await until(lambda: proxy(a, "stubborn"))
        monkeypatch.setattr(stubborn.slave, "_on_shutdown", lambda _: None)
        assert not (await ask(a, dict[str, bool], "node.kill", "/stubborn"))["gone"]
        reply = await call_api(proxy(a, "stubborn"), "shutdown", "/rosnode", "user request")
        assert reply == (0, "it was asked, and is still there after 0.3 s", 0)


async def test_kill_all_ends_the_nodes_of_this_module_alone(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b), mortal("talker", b) as (talker, ended):
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: proxy(a, "talker"))
        nodes = a.core.state().nodes
        for name in sorted(nodes):  # as `rosnode kill -a` does
            await call_api(nodes[name], "shutdown", "/rosnode", "user request")
        assert not ended.is_set()
        assert a.core.state().nodes["/rmpa"] == nodes["/rmpa"], "the agent's own node stays"
        assert proxy(a, "talker") == nodes["/rmpa/b/talker"]
        await until(lambda: a.core.state().nodes.get("/rosout", nodes["/rosout"]) != nodes["/rosout"])
        # It was that caller's wish alone.
        assert (await call_api(proxy(a, "talker"), "shutdown", "/rqt", "user request")).code == 1
        await asyncio.wait_for(ended.wait(), 20)


async def test_taking_a_proxys_name_ends_no_node_elsewhere(
    settings: Callable[..., Settings],
) -> None:
    async with running(settings("a"), settings("b")) as (a, b), mortal("talker", b) as (talker, ended):
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: proxy(a, "talker"))
        reason = "[/rmpa/b/talker] Reason: new node registered with same name"
        assert await call_api(proxy(a, "talker"), "shutdown", "/master", reason) == (1, "shutdown", 0)
        assert (await ask(a, NodePing, "node.ping", "/talker")).pid
        assert not ended.is_set()


def loggers(agent: Agent, name: str) -> str:
    """The address of the one service by which a node stands in a module's graph; empty if it does not."""
    return next(iter(agent.core.state().services.get(f"/rmpa/b/{name}/get_loggers", {}).values()), "")


async def test_a_node_that_only_subscribes_stands_in_the_other_graphs(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b):
        async with node("viewer", b) as viewer, node("talker", b) as talker:
            await viewer.subscribe("/chatter", "std_msgs/String")
            await talker.advertise("/news", "std_msgs/String")
            await until(lambda: loggers(a, "viewer") and proxy(a, "talker"))
            assert not loggers(a, "talker"), "it is known by what crosses of it"
            assert "/rmpa/b/viewer" in a.core.state().nodes
            await until(lambda: "/chatter" in a.core.state().subscribers)
            assert a.core.state().subscribers["/chatter"].keys() == {"/rmpa/b/viewer"}
            connection = await ServiceConnection.open(loggers(a, "viewer"), "/rmpa/b/viewer/get_loggers", "/client")
            assert await connection.call(b"", 20.0) == (True, bytes(4))
            connection.close()
            reply = await call_api(a.core.state().nodes["/rmpa/b/viewer"], "getPid", "/rosnode")
            assert reply.code == 1
            assert "/rmpa/a/viewer" not in b.core.state().nodes, "proxies are not told on"

            await viewer.advertise("/seen", "std_msgs/String")
            await until(lambda: not loggers(a, "viewer"))
            assert "/rmpa/b/viewer" in a.core.state().nodes
        await until(lambda: not [name for name in a.core.state().nodes if name.startswith("/rmpa/b/")])


async def test_names_that_no_node_can_have_end_the_link(settings: Callable[..., Settings]) -> None:
    bad: tuple[object, ...] = (None, "/viewer", [7], ["viewer"])
    async with running(settings("a"), settings("b")) as (a, b):
        for names in bad:
            await until(lambda: list(a.bridge.sessions.linked()) and list(b.bridge.sessions.linked()))
            (session,) = b.bridge.sessions.linked()
            link = session.link
            b.bridge.rpc.notify(session, NODES, {"nodes": names})
            await until(lambda link=link: link not in [one.link for one in b.bridge.sessions.linked()])  # type: ignore[misc]
            assert not [name for name in a.core.state().nodes if name.startswith("/rmpa/b/")]


async def test_modules_that_ignore_each_other_do_not_show_their_nodes(settings: Callable[..., Settings]) -> None:
    strict = replace(settings("b"), peers=(PeerRule("a", policy=PolicySettings(deny=("/**",))),))
    async with running(settings("a"), strict) as (a, b), node("viewer", b) as viewer, node("other", a) as other:
        await viewer.subscribe("/chatter", "std_msgs/String")
        await other.subscribe("/chatter", "std_msgs/String")
        for each in (a, b):
            (presence,) = [part for part in each.bridge._parts if isinstance(part, Nodes)]
            presence._tell()
        await ask(a, tuple[PeerNodes, ...], "node.list")  # behind what was told, over the same link
        await ask(b, tuple[PeerNodes, ...], "node.list", peer="a")
        for each in (a, b):
            assert not [name for name in each.core.state().nodes if name.startswith(("/rmpa/a/", "/rmpa/b/"))]
