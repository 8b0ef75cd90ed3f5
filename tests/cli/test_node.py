"""``rmpa node`` against our own core and nodes, without an agent and with one that knows a peer."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from rmpa.cli.node import _untold
from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.core.facts import UnreachableInfo
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.environment import NodeFacts, NodeLine, NodePing, PeerNodes
from rmpa.ros.node.node import Node
from tests.cli.conftest import Background, Place, Rmpa, compare, settled, with_core

GROUP = ("node",)
JOY = "http://10.0.0.2:1/"


@pytest.fixture
def talker(node: Callable[..., Node], background: Background) -> None:
    """A node that ends at ``shutdown``, and a proxy as a bridge makes them."""

    def close(_: object) -> None:
        tasks.append(asyncio.get_running_loop().create_task(made.close()))

    tasks: list[asyncio.Task[None]] = []
    made = node("/talker", on_shutdown=close)
    background.do(made.advertise("/chatter", "std_msgs/String"))
    background.do(node("/rmpa/joystick/joy").advertise("/joy", "std_msgs/String"))


@pytest.fixture
def peer(core: RosCore, agent: Callable[..., None]) -> list[dict[str, Any]]:
    """An agent with this core, whose peer joystick has a node /joy; and the questions that it got."""
    asked: list[dict[str, Any]] = []

    def node(args: dict[str, object]) -> object:
        asked.append(args)
        if args["peer"] not in (None, "joystick"):
            raise UnreachableError("linked peer", repr(args["peer"]), "did you mean joystick?")
        if args["what"] == "node.list":
            shown = PeerNodes(peer="older", nodes=(NodeLine(name="/x"),), problem="it is older")
            line = NodeLine(name="/joy", uri=JOY, publications=1, problem="no answer in 3 s")
            joystick = PeerNodes(peer="joystick", nodes=(line,))
            return (joystick,) if args["peer"] else (shown, joystick)
        if args["node"] != "/joy":
            raise PeerRefused("joystick", f"joystick has no node {args['node']}")
        if args["what"] == "node.info":
            return NodeFacts(name="/joy", uri=JOY, pid=7, publications={"/joy": "*"}, services=("/joy/get_loggers",))
        return NodePing(uri=JOY, time=0.0005, pid=7) if args["what"] == "node.ping" else {"gone": True}

    lost = UnreachableInfo(node="/talker", uri="http://nosuch:1/", problem="no such name", ago=3.0)
    agent("base", msgspec.structs.replace(with_core(core.uri), unreachable=(lost,)), node=node)
    return asked


@pytest.mark.usefixtures("talker")
def test_without_an_agent_the_graph_is_shown(rmpa: Rmpa, core: RosCore, place: Place) -> None:
    assert rmpa("list")[0] == 0  # sets the place up
    said = place.transcript(
        "list", "list joystick:/", "list /talk", "list /talker --json",
        "info joystick:/joy", "info talker", "info /talker --json", "info /talked",
        "ping /talker -c 2 -i 0.01", "ping /talked -c 1", "ping",
        group="node",
    )  # fmt: skip
    assert json.loads(rmpa("ping", "--all", "--json")[1])["node"] == "/talker"
    core.call("registerPublisher", "/gone", "/t", "std_msgs/String", "http://127.0.0.1:9/")
    compare("node", settled(said + place.transcript("info /gone", "ping /gone -c 1 --json", group="node")))


@pytest.mark.usefixtures("talker")
def test_kill(rmpa: Rmpa, core: RosCore) -> None:
    code, out, err = rmpa("kill", "/talker", "/nobody", "/rmpa")
    assert (code, out) == (1, "killed /talker\n")
    assert err.splitlines() == [
        "rmpa: /nobody: no node /nobody; `rmpa node list` shows all [unknown-name]",
        "rmpa: /rmpa: it is the agent itself; end `rmpa up` instead [refused]",
    ]
    assert "/talker" not in core.state().nodes
    assert rmpa("kill")[0] == rmpa("kill", "--all", "/x")[0] == 2


@pytest.mark.usefixtures("talker")
def test_kill_all_leaves_what_is_not_of_this_module(rmpa: Rmpa, core: RosCore) -> None:
    code, out, _ = rmpa("kill", "--all", "--json")
    assert (code, json.loads(out)) == (0, [{"node": "/talker", "killed": True, "error": None}])
    assert sorted(core.state().nodes) == ["/rmpa/joystick/joy", "/rosout"]


@pytest.mark.usefixtures("talker")
def test_nodes_of_peers(rmpa: Rmpa, place: Place, peer: list[dict[str, Any]]) -> None:
    assert rmpa("kill", "joystick:/joy") == (0, "killed joystick:/joy\n", "")
    assert peer[-1] == {"what": "node.kill", "peer": "joystick", "node": "/joy"}
    said = place.transcript(
        "list", "list -v joystick:/", "info joystick:/joy", "info /rmpa/joystick/joy", "ping joystick:/joy -c 1",
        "kill joystick:/jo joystik:/joy --json",
        group="node",
    )  # fmt: skip
    compare("node_of_peers", settled(said))


def test_many_modules_that_do_not_tell_their_nodes_take_one_line() -> None:
    silent = [PeerNodes(peer=f"arm{number}", nodes=(), problem="it is stopped") for number in range(1000)]
    told = [*silent, PeerNodes(peer="base", nodes=()), PeerNodes(peer="leg", nodes=(), problem="it is older")]
    assert list(_untold(told)) == [
        "1,000 modules (arm0, arm1, arm2, ...) do not list their nodes, only those with proxies here: it is stopped",
        "leg does not list its nodes, only those with proxies here: it is older",
    ]
    assert next(_untold(silent[:2])).startswith("arm0, arm1 do not list")
