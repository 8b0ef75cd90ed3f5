"""Every operation of the control socket, as a client calls it on a whole agent."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final, cast

import pytest

from rmpa.config.sources import Loaded
from rmpa.core.errors import PeerRefused
from rmpa.observe.graph_changes import GraphRevision
from rmpa.observe.io.control_client import ControlClient
from rmpa.observe.io.control_operations import OPERATIONS
from rmpa.ros.node_info import PeerNodes
from tests.agent.test_agent import running, settings, until
from tests.ros.node.peers import DEADLINE

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rmpa.config.settings import Settings

__all__ = ["settings"]

ARGS: Final[dict[str, dict[str, Any]]] = {
    "snapshot": {},
    "ping": {"peer": "b"},
    "why": {"name": "/chatter"},
    "reload": {"check": True},
    "param": {"peer": "b", "what": "param.names", "args": {}},
    "followed": {},
    "graph": {},
    "node": {"what": "node.list", "peer": "b"},
}


async def test_each_operation_replies_with_its_type(settings: Callable[..., Settings], tmp_path: Path) -> None:
    async with running(settings("a"), settings("b")) as (a, b):
        await until(lambda: list(a.bridge.sessions.linked()) and list(b.bridge.sessions.linked()))
        a.reloader._load = lambda: Loaded(settings("a"))

        def ask() -> dict[str, object]:
            with ControlClient(tmp_path / "a.sock") as client:
                return {
                    each.name: client.call(each.name, cast("Any", each.reply), **ARGS[each.name])
                    for each in OPERATIONS
                }

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
        ("param", {"peer": "b", "what": "param.names"}, "is no table"),
        ("graph", {"wait": -1}, "is not between 0 and"),
        ("node", {"what": "node.lst"}, r"did you mean node\.list\?"),
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
