"""Every operation of the control socket, as a client calls it on a whole agent."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
import pytest

import rmpa
from rmpa.config.read import Loaded
from rmpa.core.contract import ContractRule, Reliability
from rmpa.core.errors import PeerRefused
from rmpa.observe.control import GraphRevision, TopicRow
from rmpa.observe.control_client import ControlClient
from rmpa.observe.operations import REPLIES
from rmpa.observe.peer_info import PeerAgent
from rmpa.ros.environment import NodeFacts, PeerNodes, RosEnvironment
from rmpa.ros.node.node import Node
from rmpa.ros.types.messages import MessageType
from tests.agent.test_agent import running, until
from tests.ros.node.peers import DEADLINE

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rmpa.config.settings import Settings

ARGS: Final[dict[str, dict[str, Any]]] = {
    "snapshot": {},
    "ping": {"peer": "b"},
    "why": {"name": "/chatter"},
    "reload": {"check": True},
    "param": {"peer": "b", "what": "param.names", "args": {}},
    "followed": {},
    "graph": {},
    "trust": {"what": "status"},
    "agent": {"peer": "b"},
    "contract": {"topic": "/chatter", "type_name": "std_msgs/String"},
    "node": {"what": "node.list", "peer": "b"},
    "site": {"what": "site.report", "args": {}},
}


async def test_each_operation_replies_with_its_type(settings: Callable[..., Settings], tmp_path: Path) -> None:
    async with running(settings("a"), settings("b")) as (a, b):
        await until(lambda: list(a.bridge.sessions.linked()) and list(b.bridge.sessions.linked()))
        a.reloader._load = lambda: Loaded(settings("a"))

        def ask() -> dict[str, object]:
            with ControlClient(tmp_path / "a.sock") as client:
                return {name: client.call(name, cast("Any", reply), **ARGS[name]) for name, reply in REPLIES.items()}

        replies = await asyncio.to_thread(ask)
    assert replies.keys() == ARGS.keys()


@pytest.mark.parametrize(
    ("op", "args", "text"),
    [
        ("snapshot", {"topics": "/chatter"}, "is not a list of topics"),
        ("ping", {"peer": "b", "count": 0}, "is not between 1 and"),
        ("ping", {"peer": "c"}, "linked peer"),
        ("why", {"name": "chatter"}, "is not a topic, nor a service"),
        ("param", {"peer": "b", "what": "param.nmes"}, r"did you mean param\.names\?"),
        ("graph", {"wait": -1}, "is not between 0 and"),
        ("node", {"what": "node.lst"}, r"did you mean node\.list\?"),
        ("agent", {"peer": "c"}, "linked peer"),
        ("contract", {"topic": "chatter"}, "is not a topic"),
        ("snapshots", {}, "did you mean snapshot?"),
    ],
)
async def test_wrong_arguments_are_refused(
    settings: Callable[..., Settings], tmp_path: Path, op: str, args: dict[str, Any], text: str
) -> None:
    async with running(settings("a"), settings("b")) as (a, _b):
        await until(lambda: list(a.bridge.sessions.linked()))

        def ask() -> object:
            with ControlClient(tmp_path / "a.sock") as client:
                return client.call(op, object, **args)

        with pytest.raises(PeerRefused, match=text):
            await asyncio.to_thread(ask)


async def test_nodes_of_all_peers_are_listed(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, _b):
        await until(lambda: list(a.bridge.sessions.linked()))
        (nodes,) = await a.operations.node({"what": "node.list"})
    assert isinstance(nodes, PeerNodes)
    assert (nodes.peer, nodes.problem) == ("b", "")


async def test_a_node_tells_its_connections_here_and_at_a_peer(settings: Callable[..., Settings]) -> None:
    text = MessageType("std_msgs/String")
    async with (
        running(settings("a"), settings("b")) as (a, b),
        Node("/talker", master_uri=a.core.uri, environment=RosEnvironment()) as talker,
        Node("/listener", master_uri=a.core.uri, environment=RosEnvironment()) as listener,
    ):
        await until(lambda: list(b.bridge.sessions.linked()))
        await talker.advertise("/chatter", text)
        await listener.subscribe("/chatter", text, lambda _: None)

        async def connections(node: str) -> set[tuple[str, bool, str]]:
            own = await a.operations.node({"what": "node.info", "node": node})
            theirs = msgspec.convert(
                await b.operations.node({"what": "node.info", "peer": "a", "node": node}), NodeFacts
            )
            assert isinstance(own, NodeFacts)
            assert own.connections is not None
            assert own.connections == theirs.connections
            return {(each.topic, each.inbound, each.other) for each in own.connections}

        async with asyncio.timeout(DEADLINE):
            while ("/chatter", False, "/listener") not in await connections("/talker"):
                await asyncio.sleep(0)
            assert ("/chatter", True, "/talker") in await connections("/listener")


async def test_a_peer_tells_of_itself_and_a_module_is_diagnosed(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b):
        await until(lambda: list(a.bridge.sessions.linked()) and list(b.bridge.sessions.linked()))
        told = msgspec.convert(await a.operations.agent({"peer": "b"}), PeerAgent)
        assert (told.version, told.core_uri) == (rmpa.__version__, b.core.uri)
        assert told.rss
        (peer,) = a.operations.snapshot({}).peers
        assert peer.link is not None
        assert [lane.name for lane in peer.link.lanes] == ["express", "bulk"]
        assert peer.link.lanes[0].bytes_in > 0
        (why,) = await a.why.answer({"module": "b"})
        assert (why.kind, why.flows) == ("module", True)
        assert [stage.name for stage in why.stages][:4] == ["peer", "link", "lanes", "answer"]
        b.bridge.rpc.handlers.pop("agent.info")  # as an agent of an earlier release
        (why,) = await a.why.answer({"module": "b"})
        assert [stage.level.value for stage in why.stages if stage.name == "answer"] == ["unknown"]


async def test_the_contract_of_a_topic_without_a_route_is_that_of_the_rules(
    settings: Callable[..., Settings],
) -> None:
    rule = ContractRule(("/cmd/**",), (), {"reliability": Reliability.RELIABLE})
    async with running(replace(settings("a"), contracts=(rule,))) as (a,):
        terms = a.operations.contract({"topic": "/cmd/vel"})
        assert (terms["reliability"].value, terms["reliability"].rule) == ("reliable", "rule 1: topics /cmd/**")
        assert terms["depth"].rule == "default"


async def test_a_change_of_the_graph_ends_the_wait_for_it(settings: Callable[..., Settings], tmp_path: Path) -> None:
    async with running(settings("a")) as (a,):

        def ask(**args: object) -> int:
            with ControlClient(tmp_path / "a.sock") as client:
                return client.call("graph", GraphRevision, **args).revision

        known = await asyncio.to_thread(ask)
        assert await asyncio.to_thread(ask, after=known, wait=0.01) == known
        waiting = asyncio.create_task(asyncio.to_thread(ask, after=known, wait=20.0))
        a.core.call("registerPublisher", "/talker", "/chatter", "std_msgs/String", "http://127.0.0.1:9/")
        changed = await asyncio.wait_for(waiting, DEADLINE)
        assert changed != known
        assert await asyncio.to_thread(ask, after=known, wait=20.0) == changed  # it has changed before: at once


async def test_the_agent_tells_what_has_changed_in_its_own_core(
    settings: Callable[..., Settings], tmp_path: Path
) -> None:
    async with running(settings("a")) as (a,):

        def ask(**args: object) -> GraphRevision:
            with ControlClient(tmp_path / "a.sock") as client:
                return client.call("graph", GraphRevision, rows=True, **args)

        first = await asyncio.to_thread(ask)
        assert first.core_uri == a.core.uri
        assert first.rows is not None
        assert first.rows.whole
        waiting = asyncio.create_task(asyncio.to_thread(ask, after=first.revision, wait=20.0))
        a.core.call("registerPublisher", "/talker", "/chatter", "std_msgs/String", "http://127.0.0.1:9/")
        changed = await asyncio.wait_for(waiting, DEADLINE)
        assert changed.rows is not None
        assert not changed.rows.whole
        assert TopicRow("/chatter", "std_msgs/String", ("/talker",), ()) in changed.rows.topics
