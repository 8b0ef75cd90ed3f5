"""Every operation of the control socket, as a client calls it on a whole agent."""

from __future__ import annotations

import asyncio
import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
import pytest

import rmpa
from rmpa.bridge.launched import ModuleResources
from rmpa.bridge.log_ring import ModuleLog
from rmpa.bridge.recordings import ModuleRecordings
from rmpa.config.read import Loaded
from rmpa.core.contract import ContractRule, Reliability
from rmpa.core.errors import PeerRefused
from rmpa.core.facts import ContractTerm, FollowedInfo
from rmpa.observe.control_client import ControlClient, ReloadReply
from rmpa.observe.graph import GraphRevision, TopicRow
from rmpa.observe.snapshot import ModuleFacts, PingReply, Snapshot
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.ros.environment import NodeFacts, PeerNodes
from rmpa.trust.permissions import TrustStatus
from tests.agent.test_agent import DEADLINE, node, running

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rmpa.config.settings import Settings

# All operations, each with its arguments and the type of its value; ``object``: it depends on the arguments.
OPERATIONS: Final[dict[str, tuple[dict[str, Any], object]]] = {
    "snapshot": ({}, Snapshot),
    "ping": ({"peer": "b"}, PingReply),
    "why": ({"name": "/chatter"}, tuple[Diagnosis, ...]),
    "reload": ({"check": True}, ReloadReply),
    "param": ({"peer": "b", "what": "param.names", "args": {}}, object),
    "followed": ({}, tuple[FollowedInfo, ...]),
    "graph": ({}, GraphRevision),
    "trust": ({"what": "status"}, TrustStatus),
    "agent": ({"peer": "b"}, ModuleFacts),
    "contract": ({"topic": "/chatter", "type_name": "std_msgs/String"}, dict[str, ContractTerm]),
    "log": ({"modules": ["a", "b"], "level": "warn", "most": 5}, tuple[ModuleLog, ...]),
    "log_level": ({"peer": "b", "node": "/rmpa"}, dict[str, str]),
    "rates": ({}, object),
    "launch": ({"what": "list"}, tuple[ModuleResources, ...]),
    "top": ({}, object),
    "record": ({"what": "list"}, tuple[ModuleRecordings, ...]),
    "node": ({"what": "node.list", "peer": "b"}, tuple[PeerNodes, ...]),
    "site": ({"what": "site.report", "args": {}}, object),
}


WRONG: Final[tuple[tuple[str, dict[str, Any], str], ...]] = (
    ("snapshot", {"topics": "/chatter"}, "is not a list of topics"),
    ("snapshot", {"most": "many"}, "is not a number of topics"),
    ("ping", {"peer": "b", "count": 0}, "is not between 1 and"),
    ("ping", {"peer": "bb"}, "did you mean b?"),
    ("why", {"name": "chatter"}, "is not a topic, nor a service"),
    ("param", {"peer": "b", "what": "param.nmes"}, "did you mean param.names?"),
    ("graph", {"wait": -1}, "is not between 0 and"),
    ("log", {"level": "loud"}, "'loud' is not a level; use one of debug"),
    ("log_level", {"node": "/nobody"}, "a has no node /nobody"),
    ("log_level", {"peer": "b", "node": "/rmpa/a/talker"}, "is no node of b: it is a's /talker: ask there"),
    ("node", {"what": "node.lst"}, "did you mean node.list?"),
    ("agent", {"peer": "c"}, "linked peer"),
    ("record", {"what": "lst"}, "is no question about recordings"),
    ("record", {"what": "read", "id": "../x"}, "is not the name of a recording"),
    ("contract", {"topic": "chatter"}, "is not a topic"),
    ("snapshots", {}, "did you mean snapshot?"),
)


async def test_each_operation_replies_with_its_type_and_refuses_wrong_arguments(
    settings: Callable[..., Settings], tmp_path: Path
) -> None:
    async with running(settings("a"), settings("b")) as (a, _b):
        a.reloader._load = lambda: Loaded(settings("a"))
        assert a.control._handlers.keys() == OPERATIONS.keys()

        def ask() -> list[str]:
            with ControlClient(tmp_path / "a.sock") as client:
                for name, (given, reply) in OPERATIONS.items():
                    client.call(name, cast("Any", reply), **given)
                refused = []
                for op, args, _ in WRONG:
                    with pytest.raises(PeerRefused) as error:
                        client.call(op, object, **args)
                    refused.append(str(error.value))
            return refused

        refused = await asyncio.to_thread(ask)
    assert [text for (_, _, text), said in zip(WRONG, refused, strict=True) if text not in said] == []


async def test_a_node_tells_its_connections_here_and_at_a_peer(settings: Callable[..., Settings]) -> None:
    async with (
        running(settings("a"), settings("b")) as (a, b),
        node("talker", a) as talker,
        node("listener", a) as listener,
    ):
        await talker.advertise("/chatter", "std_msgs/String")
        await listener.subscribe("/chatter", "std_msgs/String", lambda _: None)

        async def connections(name: str) -> set[tuple[str, bool, str]]:
            own = await a.operations.node({"what": "node.info", "node": name})
            theirs = msgspec.convert(
                await b.operations.node({"what": "node.info", "peer": "a", "node": name}), NodeFacts
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
        told = msgspec.convert(await a.operations.agent({"peer": "b"}), ModuleFacts)
        assert (told.version, told.core_uri, told.host) == (rmpa.__version__, b.core.uri, os.uname().nodename)
        assert told.rss
        answer = await a.operations.ping({"peer": "b", "count": 2})
        assert len(answer.times) == 2
        assert all(time is not None and 0 <= time < DEADLINE for time in answer.times)
        (peer,) = a.operations.snapshot({}).peers
        assert (peer.name, peer.state) == ("b", "linked")
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


async def test_a_change_of_the_graph_ends_the_wait_for_it_and_is_told(
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
        assert (await asyncio.to_thread(ask, after=first.revision, wait=0.01)).revision == first.revision
        waiting = asyncio.create_task(asyncio.to_thread(ask, after=first.revision, wait=20.0))
        a.core.call("registerPublisher", "/talker", "/chatter", "std_msgs/String", "http://127.0.0.1:9/")
        changed = await asyncio.wait_for(waiting, DEADLINE)
        assert changed.revision != first.revision
        again = await asyncio.to_thread(ask, after=first.revision, wait=20.0)  # it has changed before: at once
        assert again.revision == changed.revision
        assert changed.rows is not None
        assert not changed.rows.whole
        assert TopicRow("/chatter", "std_msgs/String", ("/talker",), ()) in changed.rows.topics
